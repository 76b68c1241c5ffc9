(* Stated ends of a leading coefficient that is a quadratic polynomial of the inputs: it is between
   them on a box, by the S-procedure. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Claim Condition Definite Goal Funnel Tubes Increments Boxes.
Import ListNotations.
Open Scope R_scope.

(* c y_i y_j, i <= j, of y = [1; w] *)
Definition product := (nat * nat * num)%type.
Definition product_ok (k : nat) (t : product) : bool :=
  let '(i, j, _) := t in andb (Nat.leb i j) (Nat.ltb j k).
Fixpoint total_of (ts : list product) (y : list R) : R :=
  match ts with
  | [] => 0
  | (i, j, c) :: ts' => val c * nth i y 0 * nth j y 0 + total_of ts' y
  end.
(* as an upper triangle *)
Fixpoint zeros (k : nat) : list (list num) :=
  match k with O => [] | S j => repeat nzero k :: zeros j end.
Definition with_product (t : product) (M : list (list num)) : list (list num) :=
  let '(i, j, c) := t in
  update i (update (j - i) (nadd (if Nat.eqb i j then c else nmul (1%Z, 2%positive) c))) M.
Definition gram (k : nat) (ts : list product) : list (list num) := fold_right with_product (zeros k) ts.

Fixpoint places (e : list nat) (i : nat) : list nat :=
  match e with [] => [] | k :: e' => repeat i k ++ places e' (S i) end.
(* The leading coefficient; only its constant term has others beside it. *)
Fixpoint leading (size : nat) (ts : terms) : option (list product) :=
  match ts with
  | [] => Some []
  | (e, [c :: others]) :: ts' =>
      if andb (Nat.eqb (length e) size)
        (orb (forallb (Nat.eqb 0) e) (forallb (fun a => (fst a =? 0)%Z) others)) then
        match places e 1, leading size ts' with
        | [], Some l => Some ((O, O, c) :: l)
        | [i], Some l => Some ((O, i, c) :: l)
        | [i; j], Some l => Some ((i, j, c) :: l)
        | _, _ => None
        end
      else None
  | _ => None
  end.
Definition others_of (ts : terms) : list num :=
  fold_right (fun t acc => vadd (tl (hd [] (snd t))) acc) [] ts.
(* - the sum of a_i (w_i - lo_i) (hi_i - w_i) *)
Fixpoint sides (weights : list num) (box : list (num * num)) (i : nat) : list product :=
  match weights, box with
  | a :: weights', (lo, hi) :: box' =>
      (i, i, a) :: (O, i, nopp (nmul a (nadd lo hi))) :: (O, O, nmul a (nmul lo hi))
        :: sides weights' box' (S i)
  | _, _ => []
  end.
Definition negated (ts : list product) : list product :=
  map (fun t => let '(i, j, c) := t in (i, j, nopp c)) ts.

Section Ends.
Context {K : Ints}.

Definition above_end (box : list (num * num)) (weights : list num) (ts : list product) : bool :=
  let k := S (length box) in
  let all := ts ++ sides weights box 1 in
  andb (andb (Nat.eqb (length weights) (length box)) (forallb (fun a => (0 <=? fst a)%Z) weights))
    (andb (forallb (product_ok k) all) (semidefinite true (gram k all))).
Definition vertices_between (box : list (num * num)) (e : stated_ends) (ts : terms)
  : option (list matrix) :=
  match leading (length box) ts with
  | Some q =>
      if andb (above_end box (low_weights e) ((O, O, nopp (low_end e)) :: q))
        (above_end box (high_weights e) ((O, O, high_end e) :: negated q))
      then Some [[low_end e :: others_of ts]; [high_end e :: others_of ts]] else None
  | None => None
  end.

Lemma zeros_form k : forall y, triangular k (zeros k) /\ form (vals (zeros k)) y y = 0.
Proof.
  assert (Z : forall j y, dot (map val (repeat nzero j)) y = 0).
  { induction j as [|j IH]; intros [|y0 y]; cbn [repeat map dot]; auto. rewrite IH, val_nzero. ring. }
  induction k as [|k IH]; intros y; cbn [zeros triangular]; [auto|]. split.
  - split; [apply repeat_length|]. now destruct (IH []).
  - destruct y as [|y0 y]; [reflexivity|]. destruct (IH y) as [_ E].
    unfold vals in *. cbn [repeat map form]. rewrite Z, val_nzero, E. ring.
Qed.
Lemma dot_update c b : forall j y, (j < length b)%nat ->
  dot (map val (update j (nadd c) b)) y = dot (map val b) y + val c * nth j y 0.
Proof.
  induction b as [|b0 b IH]; intros [|j] [|y0 y] H; cbn [length] in H; try lia;
    cbn [update map dot nth]; try ring.
  - rewrite val_add. ring.
  - rewrite IH by lia. ring.
Qed.
Lemma triangular_update {A} i j (f : A -> A) : forall k M, triangular k M ->
  triangular k (update i (update j f) M).
Proof.
  revert i. assert (G : forall k i M, triangular k M -> triangular k (update i (update j f) M)).
  { induction k as [|k IH]; intros i [|row M] T; cbn [triangular] in T; try tauto; [now destruct i|].
    destruct T as [L T]. destruct i as [|i]; cbn [update triangular].
    - rewrite update_length. auto.
    - split; auto. }
  intros i k M. apply G.
Qed.
Lemma form_update c k : forall M i j y, triangular k M -> (i <= j < k)%nat -> length y = k ->
  form (vals (update i (update (j - i) (nadd c)) M)) y y
    = form (vals M) y y + (if Nat.eqb i j then 1 else 2) * (val c * nth i y 0 * nth j y 0).
Proof.
  induction k as [|k IH]; intros [|row M] i j y T Hij Ly; cbn [triangular] in T; try tauto; try lia.
  destruct T as [L T]. destruct row as [|a b]; [discriminate|]. destruct y as [|y0 y]; [discriminate|].
  injection L as L. injection Ly as Ly. destruct i as [|i].
  - rewrite Nat.sub_0_r. destruct j as [|j]; cbn [update vals map form nth Nat.eqb].
    + rewrite val_add. ring.
    + rewrite dot_update by lia. ring.
  - destruct j as [|j]; [lia|]. cbn [Nat.sub update vals map form nth Nat.eqb].
    pose proof (IH M i j y T ltac:(lia) Ly) as E. rewrite E. ring.
Qed.
Lemma gram_value k ts y : forallb (product_ok k) ts = true -> length y = k ->
  triangular k (gram k ts) /\ form (vals (gram k ts)) y y = total_of ts y.
Proof.
  intros H Ly. induction ts as [|[[i j] c] ts IH]; cbn [gram fold_right total_of].
  { apply zeros_form. }
  cbn [forallb product_ok] in H. apply andb_prop in H as [H1 H]. apply andb_prop in H1 as [A B].
  apply Nat.leb_le in A. apply Nat.ltb_lt in B. destruct (IH H) as [T E]. fold (gram k ts).
  cbn [with_product]. split; [now apply triangular_update|].
  rewrite (form_update _ k) by (auto; lia). rewrite E.
  destruct (Nat.eqb i j); [ring|]. rewrite val_mul.
  replace (val (1%Z, 2%positive)) with (1 / 2) by (unfold val; cbn; field). field.
Qed.
Lemma total_of_app a b y : total_of (a ++ b) y = total_of a y + total_of b y.
Proof. induction a as [|[[i j] c] a IH]; cbn [app total_of]; [ring|]. rewrite IH. ring. Qed.
Lemma total_negated a y : total_of (negated a) y = - total_of a y.
Proof. induction a as [|[[i j] c] a IH]; cbn [negated map total_of]; [ring|]. fold (negated a). rewrite IH, val_opp. ring. Qed.

Lemma sides_at_most box : forall weights w pre, in_box w box -> length weights = length box ->
  Forall (fun a => 0 <= val a) weights -> nth 0 (pre ++ w) 0 = 1 -> pre <> [] ->
  total_of (sides weights box (length pre)) (pre ++ w) <= 0.
Proof.
  induction box as [|[lo hi] box IH]; intros [|a weights] w pre Hw L Ha H1 Hp; try discriminate;
    cbn [sides total_of]; [lra|]. inversion Hw as [|w0 ? w' ? B Hw']; subst. inversion Ha; subst.
  cbn [fst snd] in B.
  pose proof (IH weights w' (pre ++ [w0]) Hw' ltac:(now injection L) H3) as A.
  rewrite <- app_assoc in A. cbn [app] in A. rewrite app_length in A. cbn [length] in A.
  rewrite Nat.add_1_r in A. specialize (A H1 ltac:(now destruct pre)).
  rewrite H1. rewrite app_nth2 by lia. rewrite Nat.sub_diag. cbn [nth].
  rewrite val_opp, !val_mul, val_add.
  assert (0 <= val a * ((w0 - val lo) * (val hi - w0))).
  { apply Rmult_le_pos; auto. apply Rmult_le_pos; lra. } lra.
Qed.
Lemma above_end_sound box weights ts w : above_end box weights ts = true -> in_box w box ->
  0 <= total_of ts (1 :: w).
Proof.
  unfold above_end. cbn zeta. intros H Hw. apply andb_prop in H as [H1 H2].
  apply andb_prop in H1 as [L Ha]. apply Nat.eqb_eq in L. apply andb_prop in H2 as [Hok Hs].
  assert (Lw : length (1 :: w) = S (length box)).
  { cbn. f_equal. now apply Condition.Forall2_length in Hw. }
  destruct (gram_value _ _ (1 :: w) Hok Lw) as [_ E].
  apply (semidefinite_sound true _ (1 :: w)) in Hs. rewrite E, total_of_app in Hs.
  assert (Hp : Forall (fun a => 0 <= val a) weights).
  { apply Forall_forall. intros a Hin. rewrite forallb_forall in Ha. specialize (Ha a Hin).
    apply Z.leb_le in Ha. now apply val_nonneg. }
  pose proof (sides_at_most box weights w [1] Hw L Hp eq_refl ltac:(discriminate)) as B.
  cbn [length app] in B. lra.
Qed.

Lemma power_places e : forall w pre, length e = length w ->
  power e w = fold_right (fun i acc => nth i (pre ++ w) 0 * acc) 1 (places e (length pre)).
Proof.
  induction e as [|k e IH]; intros [|w0 w] pre L; try discriminate; cbn [places power]; auto.
  rewrite fold_right_app. rewrite (IH w (pre ++ [w0]) ltac:(now injection L)).
  rewrite <- app_assoc, app_length, Nat.add_1_r. cbn [app].
  set (rest := fold_right _ 1 (places e (S (length pre)))). clearbody rest.
  clear L. induction k as [|k IHk]; cbn [repeat fold_right pow]; [ring|]. rewrite <- IHk.
  rewrite app_nth2 by lia. rewrite Nat.sub_diag. cbn [nth]. ring.
Qed.
Lemma leading_value n ts q w z0 z : leading (length w) ts = Some q ->
  forallb (fun t => shaped 1 (S n) (snd t)) ts = true ->
  weighted ts w (z0 :: z) 0 = total_of q (1 :: w) * z0 + dot (map val (others_of ts)) z.
Proof.
  revert q. induction ts as [|[e C] ts IH]; intros q H S; cbn [leading weighted others_of fold_right] in *.
  { injection H as <-. cbn. ring. }
  destruct C as [|[|c others] [|]]; try discriminate.
  destruct (andb _ _) eqn:E; [|discriminate]. apply andb_prop in E as [Le Ho]. apply Nat.eqb_eq in Le.
  cbn [forallb] in S. apply andb_prop in S as [_ S].
  cbn [snd hd tl nth map dot]. rewrite dot_vadd. fold (others_of ts).
  pose proof (power_places e w [1] Le) as P. cbn [length app] in P.
  assert (O : power e w * dot (map val others) z = dot (map val others) z).
  { apply Bool.orb_prop in Ho as [Ho|Ho].
    - assert (P1 : power e w = 1).
      { clear - Ho. revert w. induction e as [|k e IH]; intros [|w0 w]; cbn in *; auto.
        apply andb_prop in Ho as [A B]. destruct k; [|discriminate]. rewrite IH by auto. cbn. ring. }
      rewrite P1. ring.
    - assert (Z : dot (map val others) z = 0).
      { clear - Ho. revert z. induction others as [|a others IH]; intros [|z0 z]; cbn in *; auto.
        apply andb_prop in Ho as [A B]. apply Z.eqb_eq in A. rewrite IH by auto.
        unfold val at 1. rewrite A. unfold Rdiv. ring. }
      rewrite Z. ring. }
  destruct (places e 1) as [|i [|j [|k l]]]; try discriminate;
    (destruct (leading (length w) ts) as [q'|] eqn:El; [|discriminate]); injection H as <-;
    rewrite (IH q' eq_refl S); cbn [total_of fold_right nth] in *; cbn [nth] in P; 
    rewrite Rmult_plus_distr_l, O, P; cbn [nth]; ring.
Qed.

Lemma between_settled n box e ts vs w v x : vertices_between box e ts = Some vs -> in_box w box ->
  forallb (fun t => shaped 1 (S n) (snd t)) ts = true -> weighted ts w (v :: x) 0 = 0 ->
  settled false vs (v :: x).
Proof.
  unfold vertices_between. intros H Hw S Z c l _ B.
  destruct (leading (length box) ts) as [q|] eqn:El; [|discriminate].
  destruct (andb _ _) eqn:E; [|discriminate]. injection H as <-. apply andb_prop in E as [E1 E2].
  apply (above_end_sound _ _ _ w) in E1, E2; auto.
  cbn [total_of nth] in E1, E2. rewrite total_negated in E2. rewrite val_opp in E1.
  assert (Lw : length w = length box) by now apply Condition.Forall2_length in Hw.
  rewrite <- Lw in El. rewrite (leading_value n ts q w v x El S) in Z.
  pose proof (B _ (or_introl eq_refl)) as B1. pose proof (B _ (or_intror (or_introl eq_refl))) as B2.
  unfold at_, image, vals in B1, B2. cbn [map dot] in B1, B2.
  destruct l as [|l0 l]; [cbn in B1; lra|]. cbn [dot] in B1, B2. rewrite dot_nil_r in B1, B2.
  set (o := dot (map val (others_of ts)) x) in *. set (qv := total_of q (1 :: w)) in *.
  set (lo := val (low_end e)) in *. set (hi := val (high_end e)) in *.
  destruct (Req_dec lo hi) as [Eq|Ne].
  - assert (qv = lo) as Q by lra. rewrite Q in Z. replace (lo * v + o) with 0 in B1 by lra. lra.
  - assert (D : 0 < hi - lo) by lra. set (t := (qv - lo) / (hi - lo)).
    assert (Ht : 0 <= t <= 1).
    { unfold t. split.
      - apply Rmult_le_pos; [lra|]. left. now apply Rinv_0_lt_compat.
      - apply (Rmult_le_reg_r (hi - lo)); auto. unfold Rdiv. rewrite Rmult_assoc, Rinv_l; lra. }
    assert (Q : qv = (1 - t) * lo + t * hi) by (unfold t; field; lra).
    pose proof (Rmult_le_pos (1 - t) _ ltac:(lra) B1). pose proof (Rmult_le_pos t _ ltac:(lra) B2).
    assert (c = (1 - t) * (c + (l0 * (lo * v + o) + 0)) + t * (c + (l0 * (hi * v + o) + 0))
      - l0 * (qv * v + o)) as -> by (rewrite Q; ring).
    rewrite Z. lra.
Qed.
End Ends.
