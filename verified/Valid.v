(* In a funnel, x and u stay within the bounds inside which the equations are valid. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Claim Calculus Condition Definite Funnel Stays.
Import ListNotations.
Open Scope R_scope.

Section Valid.
Context {K : Ints}.

Definition nmin (a b : num) : num := if num_ltb a b then a else b.
(* the upper triangle of q P - rho g g' *)
Fixpoint spread (q rho : num) (P : list (list num)) (g : list num) : list (list num) :=
  match P, g with
  | row :: P', y :: g' =>
      zip (fun a b => nsub (nmul q a) (nmul rho (nmul y b))) row g :: spread q rho P' g'
  | _, _ => []
  end.
(* |g'z| is at most the room wherever W <= rho, at a knot. *)
Definition fits (n : nat) (room : num) (h : knot) (g : list num) : bool :=
  andb (Nat.eqb (length g) n)
    (semidefinite false (spread (nmul room room) (level h) (shape h) g)).

Definition unit_row (n j : nat) : list num :=
  map (fun i => if Nat.eqb i j then none else nzero) (seq 0 n).
Definition rows_of (row : list (list num)) : list (list num) :=
  map (fun k => map (fun c => nth k c nzero) row) (seq 0 (length (hd [] row))).
(* The centre by its control points, what z is multiplied by, and the limits of entry j of (x, u). *)
Definition entry (d : problem) (g : segment) (j : nat)
  : list num * list (list num) * option (num * num) :=
  let n := length (nominal g) in
  if Nat.ltb j n then (nth j (nominal g) [], [unit_row n j], None)
  else (nth (j - n) (feed g) [], rows_of (nth (j - n) (gains g) []), nth (j - n) (limits d) None).
(* What it is off by at most: only inputs are. *)
Definition slack (n : nat) (off : list num) (j : nat) : num :=
  if Nat.ltb j n then nzero else nth (j - n) off nzero.
Definition bound_ok (d : problem) (g : segment) (off : list num) (b : nat * (num * num)) : bool :=
  let n := length (nominal g) in
  let '(j, (low, high)) := b in
  let '(centre, rows, limit) := entry d g j in
  let least_wanted := nadd low (slack n off j) in
  let most_wanted := nsub high (slack n off j) in
  let need_low := match limit with Some (least, _) => num_ltb least low | None => true end in
  let need_high := match limit with Some (_, most) => num_ltb high most | None => true end in
  let rooms := (if need_low then map (fun c => nsub c least_wanted) centre else [])
    ++ (if need_high then map (fun c => nsub most_wanted c) centre else []) in
  andb (andb (Nat.ltb j (n + length (limits d)))
    (andb (Nat.ltb 0 (length centre)) (Nat.leb (length centre) 4)))
  (andb match limit with
    | Some (least, most) => andb (if need_low then num_leb least_wanted most else true)
        (if need_high then num_leb least most_wanted else true)
    | None => true end
  match rooms with
  | [] => true
  | first :: rest =>
      let room := fold_right nmin first rest in
      andb (num_leb nzero room)
        (forallb (fun g' => andb (fits n room (start g) g') (fits n room (stop g) g')) rows)
  end).
(* Gains of one input have one degree. *)
Definition even_gains (g : segment) : bool :=
  forallb (fun row => andb (Nat.eqb (length row) (length (nominal g)))
    (forallb (fun c => andb (Nat.eqb (length c) (length (hd [] row)))
       (andb (Nat.ltb 0 (length c)) (Nat.leb (length c) 4))) row)) (gains g).
Definition bounds_ok (d : problem) (offs : list (list num)) : bool :=
  forallb (fun e => andb (even_gains (fst e)) (forallb (bound_ok d (fst e) (snd e)) (bounds (fst e))))
    (combine (segments d) offs).

(* Why. *)
Lemma num_leb_le a b : num_leb a b = true -> val a <= val b.
Proof.
  destruct a as [p q], b as [p' q']. unfold num_leb, num_ltb, val; cbn. intros H.
  apply Bool.negb_true_iff, Z.ltb_ge, IZR_le in H. rewrite !mult_IZR in H.
  assert (0 < IZR (Zpos q)) by now apply IZR_lt. assert (0 < IZR (Zpos q')) by now apply IZR_lt.
  apply (Rmult_le_reg_r (IZR (Zpos q) * IZR (Zpos q'))). { now apply Rmult_lt_0_compat. }
  replace (IZR p / _ * _) with (IZR p * IZR (Zpos q')) by (field; lra).
  replace (IZR p' / _ * _) with (IZR p' * IZR (Zpos q)) by (field; lra). exact H.
Qed.
Lemma num_ltb_not a b : num_ltb a b = false -> val b <= val a.
Proof. intros H. apply num_leb_le. unfold num_leb. now rewrite H. Qed.
Lemma nmin_below a b : val (nmin a b) <= val a /\ val (nmin a b) <= val b.
Proof.
  unfold nmin. destruct (num_ltb a b) eqn:E.
  - apply num_ltb_lt in E. lra.
  - apply num_ltb_not in E. lra.
Qed.
Lemma least_below first rest : forall c, In c (first :: rest) ->
  val (fold_right nmin first rest) <= val c.
Proof.
  induction rest as [|a rest IH]; intros c H.
  - destruct H as [<-|[]]. cbn. lra.
  - cbn [fold_right]. destruct (nmin_below a (fold_right nmin first rest)) as [A B].
    destruct H as [<-|[<-|H]]; [|lra|].
    + specialize (IH first (or_introl eq_refl)). lra.
    + specialize (IH c (or_intror H)). lra.
Qed.

Lemma spread_val q rho k : forall P g z, triangular k P -> length g = k -> length z = k ->
  form (vals (spread q rho P g)) z z =
    val q * form (vals P) z z - val rho * (dot (map val g) z * dot (map val g) z).
Proof.
  induction k as [|k IH]; intros [|row P] [|y g] [|z0 z] HP Hg Hz; cbn [triangular] in *;
    try tauto; try discriminate.
  { cbn. ring. }
  destruct HP as [Lr HP]. injection Hg as Hg. injection Hz as Hz.
  destruct row as [|a b]; [discriminate|]. injection Lr as Lr.
  cbn [spread zip vals map form dot]. rewrite val_sub, !val_mul.
  assert (D : dot (map val (zip (fun a b => nsub (nmul q a) (nmul rho (nmul y b))) b g)) z
    = val q * dot (map val b) z - val rho * (val y * dot (map val g) z)).
  { assert (L : length b = length g) by congruence. clear - L. revert g z L.
    induction b as [|b0 b IH]; intros [|g0 g] [|z0 z] L; try discriminate; cbn [zip map dot];
      try ring. rewrite val_sub, !val_mul, IH by (now injection L). ring. }
  rewrite D. pose proof (IH P g z HP Hg Hz) as E. unfold vals in *. rewrite E. ring.
Qed.
Lemma form_line k s : forall A B y z, triangular k A -> triangular k B ->
  form (zip (zip (line s)) A B) y z = (1 - s) * form (vals A) y z + s * form (vals B) y z.
Proof.
  induction k as [|k IH]; intros [|a A] [|b B] y z HA HB; cbn [triangular] in *; try tauto.
  { cbn. ring. }
  destruct HA as [La HA], HB as [Lb HB]. destruct a as [|a0 a], b as [|b0 b]; try discriminate.
  injection La as La. injection Lb as Lb.
  assert (D : forall v, dot (zip (line s) a b) v
    = (1 - s) * dot (map val a) v + s * dot (map val b) v).
  { assert (L : length a = length b) by congruence. clear - L. revert b L.
    induction a as [|a0 a IH]; intros [|b0 b] L [|v0 v]; try discriminate; cbn [zip map dot];
      try ring. rewrite IH by (now injection L). unfold line. ring. }
  cbn [zip vals map]. destruct y as [|y0 y], z as [|z0 z]; cbn [form]; try ring.
  rewrite !D, IH by auto. unfold line, vals. ring.
Qed.
Lemma dot_unit j : forall n a z, length z = n ->
  dot (map val (map (fun i => if Nat.eqb i (a + j) then none else nzero) (seq a n))) z = nth j z 0.
Proof.
  induction j as [|j IH]; intros n a z Hz; destruct z as [|z0 z]; subst; cbn [length seq map dot nth];
    auto.
  - rewrite Nat.add_0_r, Nat.eqb_refl, val_none.
    assert (G : forall k b y, (a < b)%nat ->
      dot (map val (map (fun i => if Nat.eqb i a then none else nzero) (seq b k))) y = 0).
    { induction k as [|k IHk]; intros b [|y0 y] Hb; cbn [seq map dot]; auto.
      rewrite (proj2 (Nat.eqb_neq b a)), val_nzero, IHk by lia. ring. }
    rewrite G by lia. ring.
  - rewrite (proj2 (Nat.eqb_neq a (a + S j))), val_nzero by lia.
    rewrite <- Nat.add_succ_comm, IH by auto. ring.
Qed.

Lemma bernstein_weights n s : 0 <= s <= 1 -> (0 < n <= 4)%nat ->
  let b := bernstein (pred n) s in
  length b = n /\ Forall (fun w => 0 <= w) b /\ fold_right Rplus 0 b = 1.
Proof.
  intros Hs Hn. assert (A : 0 <= s * (1 - s)) by (apply Rmult_le_pos; lra).
  assert (B : 0 <= (1 - s) * (1 - s)) by (apply Rmult_le_pos; lra).
  assert (C : 0 <= s * s) by (apply Rmult_le_pos; lra).
  destruct n as [|[|[|[|[|n]]]]]; try lia; cbn [pred bernstein length fold_right]; (split; [auto|]);
    (split; [repeat first [apply Forall_nil | apply Forall_cons]|ring]); try lra.
  - apply Rmult_le_pos; lra.
  - pose proof (Rmult_le_pos s _ ltac:(lra) B). lra.
  - pose proof (Rmult_le_pos (1 - s) _ ltac:(lra) C). lra.
  - apply Rmult_le_pos; lra.
Qed.
Lemma dot_between a b w : Forall (fun c => 0 <= c) w -> forall c, length c = length w ->
  Forall (fun y => a <= y <= b) c ->
  a * fold_right Rplus 0 w <= dot w c <= b * fold_right Rplus 0 w.
Proof.
  induction 1 as [|w0 w Hw HW IH]; intros [|c0 c] L H; try discriminate; cbn [dot fold_right];
    [lra|]. inversion H as [|? ? H1 H2]; subst. specialize (IH c ltac:(now injection L) H2).
  pose proof (Rmult_le_compat_l _ _ _ Hw (proj1 H1)).
  pose proof (Rmult_le_compat_l _ _ _ Hw (proj2 H1)). lra.
Qed.
Lemma curve_between a b c s : 0 <= s <= 1 -> (0 < length c <= 4)%nat ->
  Forall (fun y => a <= y <= b) c -> a <= curve c s <= b.
Proof.
  intros Hs Hc H. destruct (bernstein_weights (length c) s Hs Hc) as [L [W S]].
  pose proof (dot_between a b _ W c ltac:(auto) H) as B. rewrite S in B. unfold curve. lra.
Qed.
Lemma along_above low c s : 0 <= s <= 1 -> (0 < length c <= 4)%nat ->
  (forall y, In y c -> low <= val y) -> low <= along s c.
Proof.
  intros Hs Hc H. unfold along.
  set (top := fold_right Rmax low (map val c)).
  assert (T : forall y, In y (map val c) -> y <= top).
  { unfold top. generalize (map val c). clear. induction l as [|y l IH]; intros q Hq; [destruct Hq|].
    cbn. destruct Hq as [<-|Hq]; [apply Rmax_l|].
    eapply Rle_trans; [now apply IH|apply Rmax_r]. }
  apply (curve_between low top); auto; [now rewrite map_length|].
  apply Forall_forall. intros y Hy. split; auto. apply in_map_iff in Hy as [q [<- Hq]]. auto.
Qed.
Lemma along_below high c s : 0 <= s <= 1 -> (0 < length c <= 4)%nat ->
  (forall y, In y c -> val y <= high) -> along s c <= high.
Proof.
  intros Hs Hc H.
  assert (E : forall l b, dot b (map (fun v => -1 * v) l) = - dot b l).
  { induction l as [|y l IH]; intros [|b0 b]; cbn; try ring. rewrite IH. ring. }
  assert (G : - high <= - along s c); [|lra].
  unfold along, curve. rewrite <- E.
  set (low := fold_right Rmin high (map val c)).
  assert (T : forall y, In y (map val c) -> low <= y).
  { unfold low. generalize (map val c). clear. induction l as [|y l IH]; intros q Hq; [destruct Hq|].
    cbn. destruct Hq as [<-|Hq]; [apply Rmin_l|].
    eapply Rle_trans; [apply Rmin_r|now apply IH]. }
  pose proof (curve_between (- high) (- low) (map (fun v => -1 * v) (map val c)) s Hs) as B.
  unfold curve in B. rewrite !map_length in *.
  apply B; auto. apply Forall_forall. intros y Hy.
  apply in_map_iff in Hy as [q [<- Hq]]. pose proof (T q Hq).
  apply in_map_iff in Hq as [p [<- Hp]]. specialize (H p Hp). lra.
Qed.

(* The gain between knots, applied to z, is between its control points applied to z. *)
Lemma dot_zeros b : forall l : list nat, dot b (map (fun _ => 0) l) = 0.
Proof. induction b as [|b0 b IH]; intros [|k l]; cbn; auto. rewrite IH. ring. Qed.
Lemma dot_sum b f h : forall l : list nat,
  dot b (map (fun k => f k + h k) l) = dot b (map f l) + dot b (map h l).
Proof. induction b as [|b0 b IH]; intros [|k l]; cbn; try ring. rewrite IH. ring. Qed.
Lemma dot_by b f c : forall l : list nat, dot b (map (fun k => f k * c) l) = dot b (map f l) * c.
Proof. induction b as [|b0 b IH]; intros [|k l]; cbn; try ring. rewrite IH. ring. Qed.
Lemma nth_seq (c : list num) : map val c = map (fun k => val (nth k c nzero)) (seq 0 (length c)).
Proof.
  induction c as [|a c IH]; cbn [length seq map]; auto. f_equal. rewrite <- seq_shift, map_map.
  exact IH.
Qed.
Lemma gain_along m s row : Forall (fun c => length c = m) row -> forall z,
  dot (map (along s) row) z =
    dot (bernstein (pred m) s)
      (map (fun k => dot (map val (map (fun c => nth k c nzero) row)) z) (seq 0 m)).
Proof.
  induction 1 as [|c row Hc H IH]; intros z; cbn [map dot].
  { now rewrite dot_zeros. }
  destruct z as [|z0 z]; [now rewrite dot_zeros|].
  rewrite dot_sum, IH, dot_by. f_equal. f_equal. unfold along, curve. rewrite map_length, Hc.
  f_equal. rewrite nth_seq, Hc. reflexivity.
Qed.

Section Segment.
Variables (d : problem) (g : segment) (n : nat).
Hypothesis Hok : segment_ok n d g = true.
Let F := segment_facts d g n Hok.

Lemma within room gv s z : 0 <= s <= 1 -> 0 <= val room -> length z = n ->
  form (P g s) z z <= rho g s ->
  fits n room (start g) gv = true -> fits n room (stop g) gv = true ->
  - val room <= dot (map val gv) z <= val room.
Proof.
  intros Hs Hroom Hz HW H0 H1. destruct F as [_ _ _ _ _ _ R0 R1 [S0 S1] _].
  unfold fits in *. apply andb_prop in H0 as [L0 H0]. apply andb_prop in H1 as [_ H1].
  apply Nat.eqb_eq in L0.
  apply (semidefinite_sound _ _ z) in H0, H1.
  rewrite (spread_val _ _ n _ _ _ S0 L0 Hz), val_mul in H0.
  rewrite (spread_val _ _ n _ _ _ S1 L0 Hz), val_mul in H1.
  unfold P in HW. rewrite (form_line n s _ _ z z S0 S1) in HW.
  pose proof (rho_pos d g n Hok s Hs) as Hrho. unfold rho, line in *.
  set (c := dot (map val gv) z) in *. set (w0 := form _ z z) in *. set (w1 := form _ z z) in *.
  set (r0 := val (level (start g))) in *. set (r1 := val (level (stop g))) in *.
  set (q := val room) in *.
  pose proof (Rmult_le_compat_l (1 - s) _ _ ltac:(lra) H0) as A0.
  pose proof (Rmult_le_compat_l s _ _ ltac:(lra) H1) as A1.
  pose proof (Rmult_le_compat_l (q * q) _ _ ltac:(now apply Rmult_le_pos) HW) as A2.
  assert (C : c * c <= q * q).
  { apply (Rmult_le_reg_l ((1 - s) * r0 + s * r1)); auto. lra. }
  apply (Rsqr_incr_0_var (Rabs c) q) in Hroom as G; [|rewrite <- Rsqr_abs; exact C].
  split; [|exact (Rle_trans _ _ _ (Rle_abs c) G)].
  pose proof (Rle_abs (- c)). rewrite Rabs_Ropp in *. lra.
Qed.

(* Either side of an entry: centre + a multiple of z, which is at most the room. *)
Lemma side room centre low s y : 0 <= s <= 1 -> (0 < length centre <= 4)%nat ->
  - val room <= y <= val room ->
  (forall c, In c centre -> val room <= val (nsub c low)) -> val low <= along s centre + y.
Proof.
  intros Hs Hc Hy H. assert (val low + val room <= along s centre); [|lra].
  apply along_above; auto. intros c Hin. specialize (H c Hin). rewrite val_sub in H. lra.
Qed.
Lemma side' room centre high s y : 0 <= s <= 1 -> (0 < length centre <= 4)%nat ->
  - val room <= y <= val room ->
  (forall c, In c centre -> val room <= val (nsub high c)) -> along s centre + y <= val high.
Proof.
  intros Hs Hc Hy H. assert (along s centre <= val high - val room); [|lra].
  apply along_below; auto. intros c Hin. specialize (H c Hin). rewrite val_sub in H. lra.
Qed.

Lemma zip_nth {A B C} (f : A -> B -> C) a0 b0 c0 a : forall b j, (j < length a)%nat ->
  (j < length b)%nat -> nth j (zip f a b) c0 = f (nth j a a0) (nth j b b0).
Proof.
  induction a as [|x a IH]; intros [|y b] [|j] Ha Hb; cbn in *; try lia; auto.
  apply IH; lia.
Qed.

Definition limit_of (j : nat) : option (num * num) :=
  if Nat.ltb j n then None else nth (j - n) (limits d) None.
(* An entry that is off by at most the slack, and within its limits. *)
Lemma bound_kept off s x b got : Forall proper (limits d) -> even_gains g = true ->
  bound_ok d g off b = true -> 0 <= s <= 1 -> length x = n ->
  (let z := deviation g s x in form (P g s) z z <= rho g s) ->
  Rabs (got - nth (fst b) (x ++ input d g s x) 0) <= val (slack n off (fst b)) ->
  match limit_of (fst b) with Some (least, most) => val least <= got <= val most | None => True end ->
  val (fst (snd b)) <= got <= val (snd (snd b)).
Proof.
  intros Hp He Hb Hs Hx HW Hgot Hclip. destruct F as [Ln _ Lf Lg Hc _ _ _ _ _].
  destruct b as [j [low high]]. cbn [fst snd] in *. unfold bound_ok in Hb. rewrite Ln in Hb.
  set (z := deviation g s x) in *. cbn zeta in HW.
  assert (Lz : length z = n).
  { unfold z, deviation. rewrite zip_length; rewrite ?map_length; congruence. }
  assert (El : snd (entry d g j) = limit_of j).
  { unfold entry, limit_of. rewrite Ln. now destruct (Nat.ltb j n). }
  destruct (entry d g j) as [[centre rows] limit] eqn:E. cbn [snd] in El. rewrite <- El in Hclip.
  set (e := slack n off j) in *. set (low' := nadd low e) in *. set (high' := nsub high e) in *.
  assert (Vl : val low' = val low + val e) by apply val_add.
  assert (Vh : val high' = val high - val e) by apply val_sub.
  assert (Room : forall room gv, 0 <= val room -> In gv rows ->
    forallb (fun g' => andb (fits n room (start g) g') (fits n room (stop g) g')) rows = true ->
    - val room <= dot (map val gv) z <= val room).
  { intros room gv H0 Hin H. rewrite forallb_forall in H. specialize (H gv Hin).
    apply andb_prop in H as [A B]. now apply (within room gv s z). }
  (* the entry before it is clipped *)
  assert (Mid : exists y, (forall room, 0 <= val room ->
      forallb (fun g' => andb (fits n room (start g) g') (fits n room (stop g) g')) rows = true ->
      - val room <= y <= val room) /\
    nth j (x ++ input d g s x) 0 = clip limit (along s centre + y) /\
    match limit with Some (a, b) => val a < val b | None => True end).
  { unfold entry in E. rewrite Ln in E. apply andb_prop in Hb as [Hb _].
    apply andb_prop in Hb as [Hj _]. apply Nat.ltb_lt in Hj.
    destruct (Nat.ltb j n) eqn:Ej; injection E as <- <- <-.
    - apply Nat.ltb_lt in Ej. exists (nth j z 0). split; [|split; auto].
      + intros room H0 H. rewrite <- (dot_unit j n 0 z Lz). apply Room; auto. now left.
      + rewrite app_nth1 by lia. cbn [clip]. unfold z, deviation.
        rewrite (zip_nth _ 0 0) by (rewrite ?map_length; lia).
        rewrite (nth_indep (map (along s) (nominal g)) 0 (along s [])) by (rewrite map_length; lia).
        rewrite map_nth. ring.
    - apply Nat.ltb_ge in Ej. set (i := (j - n)%nat) in *. assert (Hi : (i < length (limits d))%nat) by lia.
      set (row := nth i (gains g) []).
      exists (- dot (map (along s) row) z). split; [|split].
      + intros room H0 H.
        assert (Hrow : In row (gains g)) by (apply nth_In; lia).
        unfold even_gains in He. rewrite forallb_forall in He. specialize (He row Hrow).
        apply andb_prop in He as [Le He]. apply Nat.eqb_eq in Le. rewrite Ln in Le.
        assert (Hm : Forall (fun c => length c = length (hd [] row)) row).
        { apply Forall_forall. intros c Hin. rewrite forallb_forall in He. specialize (He c Hin).
          apply andb_prop in He as [He _]. now apply Nat.eqb_eq in He. }
        rewrite (gain_along _ s row Hm z).
        destruct row as [|c0 row'] eqn:Er.
        { cbn. lra. }
        assert (Hm0 : (0 < length c0 <= 4)%nat).
        { cbn [forallb] in He. apply andb_prop in He as [He _]. apply andb_prop in He as [_ He].
          apply andb_prop in He as [A B]. apply Nat.ltb_lt in A. apply Nat.leb_le in B. auto. }
        cbn [hd] in *. rewrite <- Er in *.
        destruct (bernstein_weights (length c0) s Hs Hm0) as [Lb [W S]].
        assert (B : - val room * 1 <= dot (bernstein (pred (length c0)) s)
          (map (fun k => dot (map val (map (fun c => nth k c nzero) row)) z) (seq 0 (length c0)))
          <= val room * 1); [|lra].
        rewrite <- S. apply dot_between; auto.
        { now rewrite map_length, seq_length. }
        apply Forall_forall. intros v Hv. apply in_map_iff in Hv as [k [<- Hk]].
        apply Room; auto. unfold rows_of. fold row. rewrite Er. cbn [hd]. rewrite <- Er.
        apply in_map_iff. now exists k.
      + rewrite app_nth2 by lia. rewrite Hx. fold i. unfold input, wanted.
        rewrite (zip_nth _ None 0) by (rewrite ?zip_length; lia). f_equal.
        rewrite (zip_nth _ [] []) by lia. fold row. fold z. ring.
      + rewrite Forall_forall in Hp. assert (Hin : In (nth i (limits d) None) (limits d)) by (apply nth_In; lia).
        specialize (Hp _ Hin). destruct (nth i (limits d) None) as [[a b]|]; auto. }
  destruct Mid as [y [Hy [Ey Hl]]]. rewrite Ey in Hgot.
  pose proof (Rle_abs (got - clip limit (along s centre + y))) as V1.
  pose proof (Rle_abs (- (got - clip limit (along s centre + y)))) as V2. rewrite Rabs_Ropp in V2.
  apply andb_prop in Hb as [Hb1 Hb2]. apply andb_prop in Hb1 as [_ Hb1].
  apply andb_prop in Hb1 as [C1 C2]. apply Nat.ltb_lt in C1. apply Nat.leb_le in C2.
  apply andb_prop in Hb2 as [Hb2 Hb3].
  assert (Sides : forall (nl nh : bool),
    match (if nl then map (fun c => nsub c low') centre else [])
      ++ (if nh then map (fun c => nsub high' c) centre else []) with
    | [] => true
    | first :: rest =>
        let room := fold_right nmin first rest in
        andb (num_leb nzero room)
          (forallb (fun g' => andb (fits n room (start g) g') (fits n room (stop g) g')) rows)
    end = true ->
    (nl = true -> val low' <= along s centre + y) /\ (nh = true -> along s centre + y <= val high')).
  { intros nl nh.
    destruct ((if nl then map (fun c => nsub c low') centre else [])
      ++ (if nh then map (fun c => nsub high' c) centre else [])) as [|first rest] eqn:Er; intros H.
    { split; intros ->.
      - apply app_eq_nil in Er as [Er _]. clear - C1 Er. destruct centre; cbn in *; [lia|discriminate].
      - apply app_eq_nil in Er as [_ Er]. clear - C1 Er. destruct centre; cbn in *; [lia|discriminate]. }
    cbn zeta in H. apply andb_prop in H as [H0 H]. apply num_leb_le in H0. rewrite val_nzero in H0.
    set (room := fold_right nmin first rest) in *.
    pose proof (least_below first rest) as Least. fold room in Least. rewrite <- Er in Least.
    split; intros ->.
    - apply (side room); auto. intros c Hin. apply Least. apply in_or_app. left.
      apply in_map_iff. now exists c.
    - apply (side' room); auto. intros c Hin. apply Least. apply in_or_app. right.
      apply in_map_iff. now exists c. }
  destruct limit as [[least most]|].
  - apply andb_prop in Hb2 as [M1 M2].
    destruct (Sides _ _ Hb3) as [A B]. cbn [clip] in *. set (c := along s centre + y) in *.
    split.
    + destruct (num_ltb least low) eqn:E1; [|apply num_ltb_not in E1; lra].
      apply num_leb_le in M1. specialize (A eq_refl).
      pose proof (Rmax_r (val least) (Rmin (val most) c)). pose proof (Rmin_glb _ _ _ M1 A). lra.
    + destruct (num_ltb high most) eqn:E2; [|apply num_ltb_not in E2; lra].
      apply num_leb_le in M2. specialize (B eq_refl).
      pose proof (Rmin_r (val most) c). pose proof (Rmax_lub (val least) (Rmin (val most) c) (val high')).
      lra.
  - destruct (Sides true true Hb3) as [A B]. cbn [clip] in *. specialize (A eq_refl).
    specialize (B eq_refl). lra.
Qed.
End Segment.

Lemma clip_within l u : proper l ->
  match l with Some (least, most) => val least <= clip l u <= val most | None => True end.
Proof.
  destruct l as [[a b]|]; auto. cbn. intros H. split; [apply Rmax_l|]. apply Rmax_lub; [lra|].
  apply Rmin_l.
Qed.

Theorem valid_kept d w x t : checked d w -> bounds_ok d (unmoved d) = true -> length x = first_size d ->
  begin d <= t <= finish d -> inside d x t -> in_bounds d x t.
Proof.
  intros Hc Hb Lx Ht Hin g b Hg Hgt Hbg.
  destruct Hc as [_ Hlim _ Hok _ _]. rewrite Forall_forall in Hok.
  pose proof (Hok g Hg) as Okg. set (n := first_size d) in *.
  destruct (segment_facts d g n Okg) as [Ln _ Lf Lg _ T _ _ _ _].
  unfold bounds_ok in Hb. rewrite forallb_forall in Hb.
  assert (Hp : In (g, []) (combine (segments d) (unmoved d))).
  { unfold unmoved. clear - Hg. induction (segments d) as [|h hs IH]; [destruct Hg|]. cbn.
    destruct Hg as [->|Hg]; auto. }
  specialize (Hb _ Hp). cbn [fst snd] in Hb.
  apply andb_prop in Hb as [He Hb]. rewrite forallb_forall in Hb.
  set (s := place g t). assert (Hs : 0 <= s <= 1) by now apply (place_in d g n Okg).
  assert (Lat : length (at_time x t) = n) by (unfold at_time; now rewrite map_length).
  assert (Es : slack n [] (fst b) = nzero) by (unfold slack; destruct (Nat.ltb _ _); auto; now destruct (_ - _)%nat).
  apply (bound_kept d g n Okg [] s (at_time x t) b); auto.
  - exact (Hin g Hg Hgt).
  - rewrite Es, val_nzero, Rminus_diag_eq, Rabs_R0; auto. lra.
  - unfold limit_of. destruct (Nat.ltb (fst b) n) eqn:Ej; auto. apply Nat.ltb_ge in Ej.
    rewrite app_nth2 by lia. rewrite Lat. set (i := (fst b - n)%nat).
    destruct (Nat.lt_ge_cases i (length (limits d))) as [Hi|Hi]; [|now rewrite nth_overflow].
    unfold input, wanted.
    rewrite (zip_nth _ None 0) by (rewrite ?zip_length; lia). apply clip_within.
    rewrite Forall_forall in Hlim. apply Hlim, nth_In; auto.
Qed.
End Valid.
