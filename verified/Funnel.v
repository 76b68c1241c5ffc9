(* A continuous funnel: what is decided about it, and why solutions then stay inside. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Positive Claim Calculus Condition Definite Pushed.
Import ListNotations.
Open Scope R_scope.

Section Funnel.
Context {K : Ints}.

(* The part [index, index + 1] / 2^depth of a segment, at a corner of w and in a mode (by their
   places in [corners] and [modes]), with its multipliers and squares; [kappa]: of every w, if w is
   at its centre and bounded by what it adds at most. *)
Record piece := Piece {
  depth : Z; index : Z; vertex : nat; mode : nat; kappa : list num;
  mu : list (Z * (I * I)); columns : list Z; gram_factors : squares;
  tau : list (list Z * squares) }.
Record witness := Witness {
  margin : num; basis : list mono; multiplier : list mono; sides : list mono;
  pieces : list (list piece);
  pushed : bool; goal_multiplier : num }.
Definition corners (w : witness) (box : list (num * num)) : list (list num) :=
  if pushed w then [map middle box] else vertices box.

(* What the inputs are off by at most, at its corners, and w at its own; nothing is off: []. *)
Definition around (off : list num) : list (num * num) := map (fun e => (nopp e, e)) off.
Definition cases (w : witness) (box : list (num * num)) (off : list num)
  : list (list num * list num) :=
  flat_map (fun delta => map (pair delta) (corners w box)) (vertices (around off)).

Definition num_eqb (a b : num) : bool :=
  andb (Z.eqb (fst a) (fst b)) (Pos.eqb (snd a) (snd b)).
Definition num_ltb (a b : num) : bool := (fst a * Zpos (snd b) <? fst b * Zpos (snd a))%Z.
Definition num_leb (a b : num) : bool := negb (num_ltb b a).
Fixpoint list_eqb {A : Type} (f : A -> A -> bool) (a b : list A) : bool :=
  match a, b with
  | [], [] => true
  | x :: a', y :: b' => andb (f x y) (list_eqb f a' b')
  | _, _ => false
  end.
Definition knot_eqb (a b : knot) : bool :=
  andb (num_eqb (time a) (time b))
    (andb (list_eqb (list_eqb num_eqb) (shape a) (shape b)) (num_eqb (level a) (level b))).

(* mu, linear in s on the part *)
Definition fmu (rows : list mono) (mu : list (Z * (I * I))) : F :=
  let lowest := fold_right (fun e acc => Z.min (fst e) acc) 0%Z mu in
  Frac (sorted badd (zip (fun m e =>
          let c := itwo_to (fst e - lowest) in
          (m, [imul c (fst (snd e)); imul c (snd (snd e))])) rows mu))
    (itwo_to (- lowest)) 1.
Fixpoint all_expanded (rows : list mono) (l : list (list Z * squares)) : option (list F) :=
  match l with
  | [] => Some []
  | (c, sq) :: l' =>
      match expanded rows c sq, all_expanded rows l' with
      | Some f, Some fs => Some (f :: fs)
      | _, _ => None
      end
  end.

Definition kappa_ok (d : problem) (g : segment) (p : piece) (skipped : nat) : bool :=
  andb (forallb (pushes_only skipped) (equations g))
    (andb (Nat.eqb (length (kappa p)) (length (box d))) (forallb (num_ltb (0%Z, xH)) (kappa p))).
(* What has to be positive on a piece. *)
Definition falling (d : problem) (w : witness) (g : segment) (m : list side) (p : piece) (most : F)
  (taus : list F) : option F :=
  let f := fmu (multiplier w) (mu p) in
  if ipos (den f)
  then Some (fcondition (margin w) (limits d) m g (depth p) (index p) most f taus) else None.
Definition piece_ok (d : problem) (w : witness) (products : choices) (g : segment) (off : list num)
  (p : piece) : bool :=
  match nth_error (cases w (box d) off) (vertex p), nth_error (modes (limits d)) (mode p),
    all_expanded (sides w) (tau p) with
  | Some (delta, v), Some m, Some taus =>
      let skipped := (1 + length (nominal g) + length (limits d))%nat in
      let growth := fgrowth (limits d) m delta v g (depth p) (index p) in
      let most := if pushed w
        then fadd growth (fpushed (kappa p) (box d) g (depth p) (index p) skipped) else growth in
      andb (andb (0 <=? depth p)%Z (if pushed w then kappa_ok d g p skipped else true))
        match falling d w g m p most taus with
        | Some c => is_positive (basis w) products (columns p) (gram_factors p) c
        | None => false
        end
  | _, _, _ => false
  end.

(* How far, in units of 2^-16, the pieces of a vertex and a mode cover [0, 1]. *)
Fixpoint reached (v m : nat) (sofar : Z) (ps : list piece) : Z :=
  match ps with
  | [] => sofar
  | p :: ps' =>
      if andb (andb (Nat.eqb (vertex p) v) (Nat.eqb (mode p) m))
           (andb (depth p <=? 16) (index p * 2 ^ (16 - depth p) <=? sofar))%Z
      then reached v m (Z.max sofar ((index p + 1) * 2 ^ (16 - depth p))) ps'
      else reached v m sofar ps'
  end.
Definition covered (d : problem) (w : witness) (off : list num) (ps : list piece) : bool :=
  forallb (fun v => forallb (fun m => (2 ^ 16 <=? reached v m 0 ps)%Z)
    (seq 0 (length (modes (limits d))))) (seq 0 (length (cases w (box d) off))).

Fixpoint triangle_ok {A : Type} (k : nat) (M : list (list A)) : bool :=
  match k, M with
  | O, [] => true
  | S j, row :: M' => andb (Nat.eqb (length row) k) (triangle_ok j M')
  | _, _ => false
  end.
Definition segment_ok (n : nat) (d : problem) (g : segment) : bool :=
  let m := length (limits d) in
  andb (andb (andb (Nat.eqb (length (nominal g)) n) (Nat.eqb (length (equations g)) n))
    (andb (Nat.eqb (length (feed g)) m) (Nat.eqb (length (gains g)) m)))
  (andb (andb (forallb (fun c => andb (Nat.ltb 0 (length c)) (Nat.leb (length c) 4)) (nominal g))
      (andb (num_ltb (time (start g)) (time (stop g)))
        (andb (triangle_ok n (shape (start g))) (triangle_ok n (shape (stop g))))))
    (andb (andb (num_ltb (0%Z, xH) (level (start g))) (num_ltb (0%Z, xH) (level (stop g))))
      (forallb (forallb (fun t => forallb (fun k => Nat.leb k 1) (skipn (1 + n + m) (fst t))))
         (equations g)))).
(* Inputs that are off need equations that are affine in each. *)
Definition off_ok (n : nat) (d : problem) (g : segment) (off : list num) : bool :=
  match off with
  | [] => true
  | _ => andb (Nat.eqb (length off) (length (limits d)))
      (forallb (forallb (fun t => forallb (fun k => Nat.leb k 1) (skipn (1 + n) (fst t))))
        (equations g))
  end.
Definition last_of (c : list num) : num := last c (0%Z, xH).
Definition first_of (c : list num) : num := hd (0%Z, xH) c.
Fixpoint linked (gs : list segment) : bool :=
  match gs with
  | g :: ((g' :: _) as rest) =>
      andb (andb (knot_eqb (stop g) (start g'))
        (list_eqb num_eqb (map last_of (nominal g)) (map first_of (nominal g')))) (linked rest)
  | _ => true
  end.

(* [offs]: by segment, what the inputs are off by at most. *)
Definition check (d : problem) (offs : list (list num)) (w : witness) : bool :=
  let n := match segments d with [] => O | g :: _ => length (nominal g) end in
  let products := products (basis w) in
  andb (andb (andb (num_ltb (0%Z, xH) (margin w)) (linked (segments d)))
         (forallb (fun l => match l with Some (a, b) => num_ltb a b | None => true end) (limits d)))
    (andb (andb (Nat.eqb (length (pieces w)) (length (segments d)))
        (Nat.eqb (length offs) (length (segments d))))
      (forallb (fun e => let '(g, off, ps) := e in
          andb (andb (andb (segment_ok n d g) (off_ok n d g off)) (covered d w off ps))
            (forallb (piece_ok d w products g off) ps))
        (combine (combine (segments d) offs) (pieces w)))).
(* Nothing is off. *)
Definition unmoved (d : problem) : list (list num) := map (fun _ => []) (segments d).

(* Why. *)
Lemma num_eqb_eq a b : num_eqb a b = true -> a = b.
Proof.
  destruct a, b. unfold num_eqb; cbn. intros H. apply andb_prop in H as [H1 H2].
  apply Z.eqb_eq in H1 as ->. apply Pos.eqb_eq in H2 as ->. reflexivity.
Qed.
Lemma list_eqb_eq {A} (f : A -> A -> bool) : (forall a b, f a b = true -> a = b) ->
  forall a b, list_eqb f a b = true -> a = b.
Proof.
  intros H. induction a as [|x a IH]; intros [|y b]; cbn; try discriminate; auto.
  intros E. apply andb_prop in E as [E1 E2]. f_equal; auto.
Qed.
Lemma knot_eqb_eq a b : knot_eqb a b = true -> a = b.
Proof.
  destruct a, b. unfold knot_eqb; cbn. intros H. apply andb_prop in H as [H1 H2].
  apply andb_prop in H2 as [H2 H3]. apply num_eqb_eq in H1 as ->. apply num_eqb_eq in H3 as ->.
  apply (list_eqb_eq _ (list_eqb_eq _ num_eqb_eq)) in H2 as ->. reflexivity.
Qed.
Lemma num_ltb_lt a b : num_ltb a b = true -> val a < val b.
Proof.
  destruct a as [p q], b as [p' q']. unfold num_ltb, val; cbn. intros H. apply Z.ltb_lt in H.
  apply IZR_lt in H. rewrite !mult_IZR in H.
  assert (0 < IZR (Zpos q)) by now apply IZR_lt. assert (0 < IZR (Zpos q')) by now apply IZR_lt.
  apply (Rmult_lt_reg_r (IZR (Zpos q) * IZR (Zpos q'))). { now apply Rmult_lt_0_compat. }
  replace (IZR p / _ * _) with (IZR p * IZR (Zpos q')) by (field; lra).
  replace (IZR p' / _ * _) with (IZR p' * IZR (Zpos q)) by (field; lra). exact H.
Qed.
Lemma val_zero : val (0%Z, xH) = 0.
Proof. unfold val; cbn. field. Qed.

(* Some mode holds, in it the clipped input is the applied one, and its side is kept. *)
Definition proper (l : option (num * num)) : Prop :=
  match l with Some (a, b) => val a < val b | None => True end.
Lemma mode_exists limits : Forall proper limits -> forall us, length us = length limits ->
  exists m, In m (modes limits) /\ applied limits m us = zip clip limits us /\
    Forall (fun q => 0 <= q) (held limits m us).
Proof.
  induction 1 as [|[[a b]|] l Hp Hl IH]; intros [|u us] H; try discriminate; cbn [modes].
  - exists []. cbn; auto.
  - injection H as H. destruct (IH us H) as [m [Hm [Ha Hh]]]. cbn in Hp.
    destruct (Rlt_le_dec u (val a)) as [C|C]; [|destruct (Rlt_le_dec (val b) u) as [E|E]].
    + exists (Low :: m). split. { apply in_or_app. left. now apply in_map. }
      cbn. rewrite Ha, Rmin_right, Rmax_left by lra. split; auto. constructor; auto; lra.
    + exists (High :: m). split. { rewrite app_assoc. apply in_or_app. right. now apply in_map. }
      cbn. rewrite Ha, Rmin_left, Rmax_right by lra. split; auto. constructor; auto; lra.
    + exists (Free :: m). split.
      { apply in_or_app. right. apply in_or_app. left. now apply in_map. }
      cbn. rewrite Ha, Rmin_right, Rmax_right by lra. split; auto. constructor; auto.
      apply Rmult_le_pos; lra.
  - injection H as H. destruct (IH us H) as [m [Hm [Ha Hh]]].
    exists (Free :: m). split; [now apply in_map|]. cbn. now rewrite Ha.
Qed.

(* A function that is affine in each entry of w is below c on the box if it is at the vertices. *)
Definition affine (G : list R -> R) : Prop := forall pre post a b l,
  G (pre ++ ((1 - l) * a + l * b) :: post) =
    (1 - l) * G (pre ++ a :: post) + l * G (pre ++ b :: post).
Lemma below_on_box box : forall G c, affine G ->
  (forall v, In v (vertices box) -> G (map val v) < c) ->
  forall w, in_box w box -> G w < c.
Proof.
  induction box as [|[a b] box IH]; intros G c HG Hv w Hw;
    inversion Hw as [|w0 ? w' ? H1 H2]; subst.
  { exact (Hv [] (or_introl eq_refl)). }
  cbn in H1.
  assert (HG' : affine (fun w => G (w0 :: w))).
  { intros pre post p q l. exact (HG (w0 :: pre) post p q l). }
  apply (IH (fun w => G (w0 :: w)) c HG'); auto. intros v Hin.
  pose proof (Hv (a :: v)) as Ha. pose proof (Hv (b :: v)) as Hb. cbn [map] in Ha, Hb.
  specialize (Ha ltac:(cbn; apply in_or_app; left; now apply in_map)).
  specialize (Hb ltac:(cbn; apply in_or_app; right; now apply in_map)).
  destruct (Req_dec (val a) (val b)) as [E|E].
  { replace w0 with (val a) by lra. exact Ha. }
  set (l := (w0 - val a) / (val b - val a)).
  assert (0 < val b - val a) by lra.
  assert (Hl : 0 <= l <= 1).
  { unfold l. split.
    - apply Rmult_le_pos; [lra|]. left. now apply Rinv_0_lt_compat.
    - apply (Rmult_le_reg_r (val b - val a)); auto.
      unfold Rdiv. rewrite Rmult_assoc, Rinv_l; lra. }
  pose proof (HG [] (map val v) (val a) (val b) l) as A. cbn [app] in A.
  replace ((1 - l) * val a + l * val b) with w0 in A by (unfold l; field; lra).
  cbn beta. rewrite A. set (ga := G (val a :: _)) in *. set (gb := G (val b :: _)) in *.
  pose proof (Rmax_lub_lt _ _ _ Ha Hb). pose proof (Rmax_l ga gb). pose proof (Rmax_r ga gb).
  assert ((1 - l) * ga <= (1 - l) * Rmax ga gb) by (apply Rmult_le_compat_l; lra).
  assert (l * gb <= l * Rmax ga gb) by (apply Rmult_le_compat_l; lra). lra.
Qed.

(* The equations are affine in w, and so is the growth of W. *)
Definition linear_beyond (n : nat) (e : equation) : Prop :=
  Forall (fun t => Forall (fun k => (k <= 1)%nat) (skipn n (fst t))) e.
Lemma rate_affine n e L pre post a b l : linear_beyond n e -> length L = n ->
  rate e (L ++ pre ++ ((1 - l) * a + l * b) :: post) =
    (1 - l) * rate e (L ++ pre ++ a :: post) + l * rate e (L ++ pre ++ b :: post).
Proof.
  intros He HL. induction He as [|[k c] e Hk He IH]; cbn [rate]; [ring|]. rewrite IH.
  rewrite !app_assoc. destruct (power_split (L ++ pre) k post) as [d Hd]. rewrite !Hd.
  assert (Hn : (nth (length (L ++ pre)) k O <= 1)%nat).
  { cbn [fst] in Hk. rewrite app_length, HL.
    destruct (Nat.lt_ge_cases (n + length pre) (length k)) as [C|C].
    - rewrite <- (firstn_skipn n k) at 1. rewrite app_nth2; rewrite firstn_length_le; try lia.
      rewrite Forall_forall in Hk. apply Hk. apply nth_In. rewrite skipn_length. lia.
    - rewrite nth_overflow by lia. lia. }
  destruct (nth _ k O) as [|[|j]]; [| |lia]; cbn; ring.
Qed.
Lemma dot_affine y l : forall p q, length p = length q ->
  dot y (zip (fun a b => (1 - l) * a + l * b) p q) = (1 - l) * dot y p + l * dot y q.
Proof.
  induction y as [|y0 y IH]; intros [|a p] [|b q] H; try discriminate; cbn; try ring.
  rewrite IH by (now injection H). ring.
Qed.
Lemma form_affine M l : forall y p q, length p = length q ->
  form M y (zip (fun a b => (1 - l) * a + l * b) p q) = (1 - l) * form M y p + l * form M y q.
Proof.
  induction M as [|[|m0 m] M IH]; intros [|y0 y] [|a p] [|b q] H; try discriminate; cbn; try ring.
  rewrite IH, dot_affine by (now injection H). ring.
Qed.
Lemma growth_affine n g s x u : Forall (linear_beyond n) (equations g) ->
  (1 + length (x ++ u))%nat = n -> affine (growth g s x u).
Proof.
  intros He Hn pre post a b l. unfold growth.
  enough (E : form (P g s) (deviation g s x) (relative g s x u (pre ++ ((1 - l) * a + l * b) :: post))
    = (1 - l) * form (P g s) (deviation g s x) (relative g s x u (pre ++ a :: post))
      + l * form (P g s) (deviation g s x) (relative g s x u (pre ++ b :: post))).
  { rewrite E. ring. }
  rewrite <- form_affine.
  - f_equal. unfold relative, field.
    generalize (map (fun c => curve' (map val c) s) (nominal g)).
    set (t := line s _ _). induction He as [|e es He Hes IH]; intros [|d ds]; cbn; auto.
    f_equal; auto.
    pose proof (rate_affine n e (t :: x ++ u) pre post a b l He ltac:(cbn; auto)) as A.
    cbn [app] in A. rewrite <- !app_assoc in A. rewrite A. ring.
  - unfold relative, field. generalize (map (fun c => curve' (map val c) s) (nominal g)).
    clear. induction (equations g) as [|e es IH]; intros [|d ds]; cbn; auto.
Qed.

(* The same of what is added to the inputs: they come before w. *)
Lemma zip_split a : forall pre, (exists b b0 c, length b = length pre /\ forall y post,
    zip Rplus a (pre ++ y :: post) = b ++ (b0 + y) :: zip Rplus c post) \/
  (exists b, forall y post, zip Rplus a (pre ++ y :: post) = b).
Proof.
  induction a as [|a0 a IH]; intros [|p pre]; cbn [app zip].
  - right. now exists [].
  - right. now exists [].
  - left. now exists [], a0, a.
  - destruct (IH pre) as [[b [b0 [c [L H]]]]|[b H]].
    + left. exists (a0 + p :: b), b0, c. split; [cbn; congruence|]. intros y post. now rewrite H.
    + right. exists (a0 + p :: b). intros y post. now rewrite H.
Qed.
Lemma growth_affine_inputs n g s x a v : Forall (linear_beyond (1 + n)) (equations g) ->
  length x = n -> affine (fun delta => growth g s x (zip Rplus a delta) v).
Proof.
  intros He Hx. assert (A : affine (growth g s x [])).
  { apply (growth_affine (1 + n)); auto. rewrite app_nil_r. cbn. congruence. }
  assert (E : forall u, growth g s x u v = growth g s x [] (u ++ v)) by reflexivity.
  intros pre post p q l. cbn beta. rewrite !E.
  destruct (zip_split a pre) as [[b [b0 [c [_ H]]]]|[b H]].
  - rewrite !H, <- !app_assoc. cbn [app].
    replace (b0 + ((1 - l) * p + l * q)) with ((1 - l) * (b0 + p) + l * (b0 + q)) by ring.
    rewrite (A b (zip Rplus c post ++ v)). reflexivity.
  - rewrite !H. ring.
Qed.

(* Pieces cover every place. *)
Definition holds (p : piece) (s : R) : Prop :=
  IZR (index p) <= s * IZR (2 ^ depth p) <= IZR (index p) + 1.
Lemma reached_covers v m S : forall ps sofar, Forall (fun p => (0 <= depth p)%Z) ps ->
  IZR sofar <= S <= IZR (reached v m sofar ps) -> (sofar < reached v m sofar ps)%Z ->
  exists p, In p ps /\ vertex p = v /\ mode p = m /\ holds p (S / 65536).
Proof.
  induction ps as [|p ps IH]; intros sofar HD [H1 H2] Hlt; cbn [reached] in *; [lia|].
  inversion HD as [|? ? Hd HD']; subst.
  destruct (andb _ _) eqn:E.
  - apply andb_prop in E as [E1 E2]. apply andb_prop in E1 as [Ev Em]. apply andb_prop in E2 as [E2 E3].
    apply Nat.eqb_eq in Ev. apply Nat.eqb_eq in Em. apply Z.leb_le in E2, E3.
    set (stop := ((index p + 1) * 2 ^ (16 - depth p))%Z) in *.
    destruct (Rle_lt_dec S (IZR stop)) as [C|C].
    + exists p. split; [now left|]. split; [auto|]. split; [auto|]. split.
      * apply IZR_le in E3. rewrite mult_IZR in E3.
        assert (T : IZR (2 ^ (16 - depth p)) * IZR (2 ^ depth p) = 65536).
        { rewrite <- mult_IZR, <- Z.pow_add_r by lia.
          replace (16 - depth p + depth p)%Z with 16%Z by lia. reflexivity. }
        assert (0 < IZR (2 ^ (16 - depth p))) by (apply IZR_lt, Z.pow_pos_nonneg; lia).
        apply (Rmult_le_reg_r (IZR (2 ^ (16 - depth p)))); auto.
        replace (S / 65536 * IZR (2 ^ depth p) * IZR (2 ^ (16 - depth p))) with S; [lra|].
        rewrite Rmult_assoc, (Rmult_comm (IZR (2 ^ depth p))), T. field.
      * unfold stop in C. rewrite mult_IZR, plus_IZR in C.
        assert (T : IZR (2 ^ (16 - depth p)) * IZR (2 ^ depth p) = 65536).
        { rewrite <- mult_IZR, <- Z.pow_add_r by lia.
          replace (16 - depth p + depth p)%Z with 16%Z by lia. reflexivity. }
        assert (0 < IZR (2 ^ (16 - depth p))) by (apply IZR_lt, Z.pow_pos_nonneg; lia).
        apply (Rmult_le_reg_r (IZR (2 ^ (16 - depth p)))); auto.
        replace (S / 65536 * IZR (2 ^ depth p) * IZR (2 ^ (16 - depth p))) with S; [lra|].
        rewrite Rmult_assoc, (Rmult_comm (IZR (2 ^ depth p))), T. field.
    + destruct (Z.max_spec sofar stop) as [[X Y]|[X Y]]; rewrite Y in *.
      * assert (Z : (stop < reached v m stop ps)%Z) by (apply lt_IZR; lra).
        destruct (IH stop HD' ltac:(split; lra) Z) as [p' [Hin Hp]]. exists p'. split; [now right|auto].
      * destruct (IH sofar HD' ltac:(split; lra) Hlt) as [p' [Hin Hp]]. exists p'. split; [now right|auto].
  - destruct (IH sofar HD' ltac:(split; lra) Hlt) as [p' [Hin Hp]]. exists p'. split; [now right|auto].
Qed.

Lemma all_expanded_val r z rows l : 0 <= r <= 1 -> forall fs, all_expanded rows l = Some fs ->
  exists ts, Forall2 (means r (env z)) fs ts /\ Forall (fun q => 0 <= q) ts.
Proof.
  intros Hr. induction l as [|[c sq] l IH]; cbn; intros fs.
  - intros [= <-]. exists []. auto.
  - destruct (expanded rows c sq) as [f|] eqn:E; [|discriminate].
    destruct (all_expanded rows l) as [fs'|]; [|discriminate]. intros [= <-].
    destruct (expanded_val r (env z) rows c sq f Hr E) as [t [Ht Hn]].
    destruct (IH fs' eq_refl) as [ts [Hts Hns]]. exists (t :: ts). auto.
Qed.
Lemma dot_nonneg a : Forall (fun q => 0 <= q) a -> forall b, Forall (fun q => 0 <= q) b ->
  0 <= dot a b.
Proof.
  induction 1 as [|x a Hx Ha IH]; intros b Hb; cbn; [lra|]. destruct Hb as [|y b Hy Hb]; [lra|].
  pose proof (Rmult_le_pos _ _ Hx Hy). pose proof (IH b Hb). lra.
Qed.

(* The multiplier of rho - W at a place, and a bound on all of them that is continuous *)
Definition outer_at (w : witness) (p : piece) (s : R) (z : list R) : R :=
  pval (s * IZR (2 ^ depth p) - IZR (index p)) (env z)
      (Polynomials.num (fmu (multiplier w) (mu p)))
    / r (den (fmu (multiplier w) (mu p))).
Fixpoint outer_bound (w : witness) (ps : list piece) (s : R) (z : list R) : R :=
  match ps with
  | [] => 0
  | p :: ps' => 1 + outer_at w p s z * outer_at w p s z + outer_bound w ps' s z
  end.
Lemma outer_bound_nonneg w ps s z : 0 <= outer_bound w ps s z.
Proof.
  induction ps as [|p ps IH]; cbn; [lra|]. pose proof (Rle_0_sqr (outer_at w p s z)).
  unfold Rsqr in *. lra.
Qed.
Lemma outer_bound_above w ps p s z : In p ps ->
  Rabs (outer_at w p s z) <= outer_bound w ps s z.
Proof.
  induction ps as [|q ps IH]; cbn; [tauto|]. intros [->|H].
  - pose proof (outer_bound_nonneg w ps s z). apply Rabs_le.
    pose proof (Rle_0_sqr (outer_at w p s z + 1)). pose proof (Rle_0_sqr (outer_at w p s z - 1)).
    unfold Rsqr in *. nra.
  - specialize (IH H). pose proof (Rle_0_sqr (outer_at w q s z)). unfold Rsqr in *. lra.
Qed.
(* The heart: where W is above rho, it grows relative to rho by less than a bounded multiple of the
   excess. *)
Section Segment.
Variables (d : problem) (w : witness) (g : segment) (off : list num) (ps : list piece) (n : nat).
Hypothesis Hlimits : Forall proper (limits d).
Hypothesis Hmargin : 0 < val (margin w).
Hypothesis Hok : segment_ok n d g = true.
Hypothesis Hoff : off_ok n d g off = true.
Hypothesis Hcov : covered d w off ps = true.
Hypothesis Hps : forallb (piece_ok d w (products (basis w)) g off) ps = true.

Record facts : Prop := {
  f_nominal : length (nominal g) = n;
  f_equations : length (equations g) = n;
  f_feed : length (feed g) = length (limits d);
  f_gains : length (gains g) = length (limits d);
  f_curves : Forall (fun c => (0 < length c <= 4)%nat) (nominal g);
  f_time : begins g < ends g;
  f_start : 0 < val (level (start g));
  f_stop : 0 < val (level (stop g));
  f_shapes : triangular n (shape (start g)) /\ triangular n (shape (stop g));
  f_affine : Forall (linear_beyond (1 + n + length (limits d))) (equations g) }.
Lemma triangle_ok_is {A : Type} k : forall M : list (list A), triangle_ok k M = true ->
  triangular k M.
Proof.
  induction k as [|k IH]; intros [|row M]; cbn [triangle_ok triangular]; try discriminate; auto.
  intros H. apply andb_prop in H as [H1 H2]. apply Nat.eqb_eq in H1. auto.
Qed.
Lemma segment_facts : facts.
Proof.
  unfold segment_ok in Hok.
  apply andb_prop in Hok as [A B]. apply andb_prop in A as [A1 A2].
  apply andb_prop in A1 as [A1 A3]. apply andb_prop in A2 as [A2 A4].
  apply andb_prop in B as [B1 B2]. apply andb_prop in B1 as [B1 B3].
  apply andb_prop in B3 as [B3 B6]. apply andb_prop in B6 as [B6 B7].
  apply triangle_ok_is in B6, B7.
  apply andb_prop in B2 as [B2 B4]. apply andb_prop in B2 as [B2 B5].
  apply Nat.eqb_eq in A1, A2, A3, A4. apply num_ltb_lt in B3, B2, B5. rewrite val_zero in *.
  constructor; auto.
  - apply Forall_forall. intros c Hc. rewrite forallb_forall in B1. specialize (B1 c Hc).
    apply andb_prop in B1 as [X Y]. apply Nat.ltb_lt in X. apply Nat.leb_le in Y. auto.
  - apply Forall_forall. intros e He. rewrite forallb_forall in B4. specialize (B4 e He).
    unfold linear_beyond. apply Forall_forall. intros t Ht. rewrite forallb_forall in B4.
    specialize (B4 t Ht). apply Forall_forall. intros k Hk. rewrite forallb_forall in B4.
    specialize (B4 k Hk). now apply Nat.leb_le in B4.
Qed.

Lemma rho_pos s : 0 <= s <= 1 -> 0 < rho g s.
Proof.
  intros Hs. destruct segment_facts. unfold rho, line.
  destruct (Req_dec s 1) as [->|N]; [nra|].
  pose proof (Rmult_lt_0_compat (1 - s) _ ltac:(lra) f_start0).
  pose proof (Rmult_le_pos s (val (level (stop g))) ltac:(lra) ltac:(lra)). lra.
Qed.

Lemma piece_at v m s : 0 <= s <= 1 -> (v < length (cases w (box d) off))%nat ->
  (m < length (modes (limits d)))%nat ->
  exists p, In p ps /\ vertex p = v /\ mode p = m /\ holds p s.
Proof.
  intros Hs Hv Hm. unfold covered in Hcov. rewrite forallb_forall in Hcov.
  specialize (Hcov v ltac:(apply in_seq; lia)). rewrite forallb_forall in Hcov.
  specialize (Hcov m ltac:(apply in_seq; lia)). apply Z.leb_le in Hcov.
  destruct (reached_covers v m (s * 65536) ps 0) as [p Hp].
  - apply Forall_forall. intros p Hp. rewrite forallb_forall in Hps. specialize (Hps p Hp).
    unfold piece_ok in Hps. destruct (nth_error _ _) as [[? ?]|]; [|discriminate].
    destruct (nth_error _ _); [|discriminate]. destruct (all_expanded _ _); [|discriminate].
    apply andb_prop in Hps as [X _]. apply andb_prop in X as [X _].
    now apply Z.leb_le in X.
  - apply IZR_le in Hcov. change (IZR (2 ^ 16)) with 65536 in Hcov. lra.
  - change (2 ^ 16)%Z with 65536%Z in Hcov. lia.
  - exists p. replace (s * 65536 / 65536) with s in Hp by field. exact Hp.
Qed.

(* u is what the policy applies, or off by at most so much. *)
Definition within_off (a u : list R) : Prop :=
  match off with [] => u = a | _ => exists delta, in_box delta (around off) /\ u = zip Rplus a delta end.

Lemma falling_enough s x z m p most a taus ts fc : 0 <= s <= 1 -> z = deviation g s x ->
  length x = n -> In p ps -> (0 <= depth p)%Z ->
  means (s * IZR (2 ^ depth p) - IZR (index p)) (env z) most a ->
  Forall2 (means (s * IZR (2 ^ depth p) - IZR (index p)) (env z)) taus ts ->
  Forall (fun q => 0 <= q) ts -> Forall (fun q => 0 <= q) (held (limits d) m (wanted g s z)) ->
  falling d w g m p most taus = Some fc ->
  (forall c, means (s * IZR (2 ^ depth p) - IZR (index p)) (env z) fc c -> 0 < c) ->
  0 < form (P g s) z z - rho g s ->
  a < outer_bound w ps s z * (form (P g s) z z - rho g s).
Proof.
  intros Hs Hz Hx Hp Hd Ha Hts Hns Hheld Hf Hpos Hgap. destruct segment_facts.
  set (r0 := s * IZR (2 ^ depth p) - IZR (index p)) in *.
  pose proof (rho_pos s Hs) as Hrho.
  assert (Hdur : 0 < duration g) by (unfold duration; lra).
  pose proof (outer_bound_above w ps p s z Hp) as Hab.
  assert (Lx : length x = length (nominal g)) by congruence.
  unfold falling in Hf.
  destruct (ipos (den (fmu (multiplier w) (mu p)))) eqn:Eden; [|discriminate]. injection Hf as <-.
  apply r_pos in Eden.
  assert (Hmu : means r0 (env z) (fmu (multiplier w) (mu p)) (outer_at w p s z)).
  { unfold outer_at. split; auto. fold r0. field. lra. }
  subst z. pose proof (means_condition s r0 _ (depth p) (index p) Hd ltac:(unfold r0; ring) (limits d) m
    g x eq_refl Lx (margin w) _ _ _ _ _ _ Ha Hmu Hts) as Hc.
  specialize (Hpos _ Hc). unfold condition in Hpos.
  pose proof (dot_nonneg _ Hns _ Hheld) as Hdot.
  pose proof (Rmult_lt_0_compat _ _ Hmargin (Rmult_lt_0_compat _ _ Hdur Hrho)) as Hm0.
  set (W := form (P g s) _ _) in *. set (ob := outer_bound _ _ _ _) in *.
  set (mu0 := outer_at _ _ _ _) in *.
  assert (N1 : - mu0 * (W - rho g s) <= ob * (W - rho g s)).
  { apply Rmult_le_compat_r; [lra|]. pose proof (Rle_abs (- mu0)). rewrite Rabs_Ropp in *. lra. }
  lra.
Qed.

Lemma growth_bounded s x u w0 : 0 <= s <= 1 -> length x = n -> in_box w0 (box d) ->
  within_off (input d g s x) u ->
  let z := deviation g s x in
  0 < form (P g s) z z - rho g s ->
  growth g s x u w0 < outer_bound w ps s z * (form (P g s) z z - rho g s).
Proof.
  intros Hs Hx Hw Hu z Hgap. pose proof segment_facts as SF. destruct SF.
  set (us := wanted g s z).
  assert (Hus : length us = length (limits d)).
  { unfold us, wanted. rewrite zip_length; congruence. }
  destruct (mode_exists (limits d) Hlimits us Hus) as [m [Hm [Happ Hheld]]].
  assert (Hin : input d g s x = applied (limits d) m us) by (unfold input; now rewrite Happ).
  rewrite Hin in Hu.
  assert (Lapp : length (applied (limits d) m us) = length (limits d)).
  { rewrite Happ. rewrite zip_length; congruence. }
  apply In_nth_error in Hm as [im Him].
  set (target := outer_bound w ps s z * (form (P g s) z z - rho g s)).
  assert (At : forall iv delta v, nth_error (cases w (box d) off) iv = Some (delta, v) -> exists p,
    (pushed w = true -> kappa_ok d g p (1 + n + length (limits d)) = true) /\
    growth g s x (moved (map val delta) (applied (limits d) m us)) (map val v)
      + (if pushed w then cost (kappa p) (box d) g s z (1 + n + length (limits d)) else 0) < target).
  { intros iv delta v Hiv. destruct (piece_at iv im s Hs) as [p [Hp [Ev [Em Hh]]]].
    { apply nth_error_Some. congruence. } { apply nth_error_Some. congruence. }
    exists p. pose proof Hps as Hps'. rewrite forallb_forall in Hps'. specialize (Hps' p Hp).
    unfold piece_ok in Hps'. rewrite Ev, Em, Hiv, Him in Hps'.
    destruct (all_expanded (sides w) (tau p)) as [taus|] eqn:Etau; [|discriminate].
    cbn zeta in Hps'. rewrite f_nominal0 in Hps'. set (skipped := (1 + n + length (limits d))%nat) in *.
    apply andb_prop in Hps' as [A B]. apply andb_prop in A as [A1 A3]. apply Z.leb_le in A1.
    split. { intros E. now rewrite E in A3. }
    destruct (falling _ _ _ _ _ _ _) as [fc|] eqn:Ef; [|discriminate].
    set (r0 := s * IZR (2 ^ depth p) - IZR (index p)).
    assert (Hr : 0 <= r0 <= 1) by (unfold r0; destruct Hh; lra).
    destruct (all_expanded_val r0 z _ _ Hr _ Etau) as [ts [Hts Hns]].
    pose proof (means_growth s r0 z (depth p) (index p) A1 ltac:(unfold r0; ring)
      (limits d) m delta v g x eq_refl ltac:(congruence)) as Hg0. fold us in Hg0.
    set (top := growth g s x (moved (map val delta) (applied (limits d) m us)) (map val v)
      + (if pushed w then cost (kappa p) (box d) g s z skipped else 0)).
    refine (falling_enough s x z m p _ top taus ts fc Hs eq_refl Hx Hp A1 _ Hts Hns Hheld Ef _ Hgap).
    - unfold top. destruct (pushed w).
      + apply means_add; [exact Hg0|]. apply means_fpushed; auto; try congruence.
        { unfold r0. ring. }
        unfold kappa_ok in A3. apply andb_prop in A3 as [_ A3]. apply andb_prop in A3 as [_ A3].
        apply Forall_forall. intros k Hk. rewrite forallb_forall in A3. specialize (A3 k Hk).
        apply num_ltb_lt in A3. now rewrite val_zero in A3.
      + eapply means_equal; [exact Hg0|ring].
    - intros c Hc. exact (is_positive_sound r0 (env z) _ _ _ _ _ Hr B Hc). }
  (* at a corner of what the inputs are off by, for every w *)
  assert (Corner : forall delta, In delta (vertices (around off)) ->
    growth g s x (moved (map val delta) (applied (limits d) m us)) w0 < target).
  { intros delta Hd.
    assert (Case : forall v, In v (corners w (box d)) -> exists iv,
      nth_error (cases w (box d) off) iv = Some (delta, v)).
    { intros v Hv. apply In_nth_error. unfold cases. apply in_flat_map. exists delta.
      split; auto. now apply in_map. }
    assert (Lmov : length (moved (map val delta) (applied (limits d) m us)) = length (limits d)).
    { destruct delta as [|e l] eqn:Ed; auto. cbn [moved map]. rewrite zip_length; auto.
      rewrite Lapp. unfold off_ok in Hoff. destruct off as [|o os]; [destruct Hd as [|[]]; discriminate|].
      apply andb_prop in Hoff as [L _]. apply Nat.eqb_eq in L. rewrite <- L.
      assert (V : forall b v, In v (vertices b) -> length v = length b).
      { clear. induction b as [|[p q] b IH]; cbn; intros v [<-|[]] || intros v H; auto.
        apply in_app_or in H as [H|H]; apply in_map_iff in H as [v' [<- H]]; cbn; auto. }
      pose proof (V _ _ Hd) as Lv. unfold around in Lv. rewrite map_length in Lv.
      cbn [length] in *. rewrite map_length. congruence. }
    set (um := moved (map val delta) (applied (limits d) m us)) in *.
    unfold corners in Case. destruct (pushed w).
    - destruct (Case _ (or_introl eq_refl)) as [iv Hiv].
      destruct (At iv _ _ Hiv) as [p [Hk Hg]]. specialize (Hk eq_refl). unfold kappa_ok in Hk.
      apply andb_prop in Hk as [K1 K2]. apply andb_prop in K2 as [K2 K3]. apply Nat.eqb_eq in K2.
      eapply Rle_lt_trans; [|exact Hg].
      apply (below_pushed g s z (duration g)); auto.
      + unfold duration. lra.
      + apply Forall_forall. intros k Hk'. rewrite forallb_forall in K3. specialize (K3 k Hk').
        apply num_ltb_lt in K3. now rewrite val_zero in K3.
      + intros pre y c post. apply growth_push; try congruence.
        * apply Forall_forall. intros e He. rewrite forallb_forall in K1. now apply K1.
        * rewrite app_length. fold um. rewrite Lmov. lia.
    - apply (below_on_box (box d)); auto.
      { apply (growth_affine (1 + n + length (limits d))); auto. rewrite app_length.
        fold um. rewrite Lmov. lia. }
      intros v Hv. destruct (Case v Hv) as [iv Hiv]. destruct (At iv _ _ Hiv) as [p [_ Hg]].
      fold um in Hg. lra. }
  unfold within_off in Hu. destruct off as [|o os] eqn:Eo.
  - subst u. exact (Corner [] (or_introl eq_refl)).
  - destruct Hu as [delta [Hd ->]]. unfold off_ok in Hoff. apply andb_prop in Hoff as [_ Ha].
    apply (below_on_box (around (o :: os))
      (fun delta => growth g s x (zip Rplus (applied (limits d) m us) delta) w0)); auto.
    + apply (growth_affine_inputs n); auto. apply Forall_forall. intros e He.
      unfold linear_beyond. rewrite forallb_forall in Ha. specialize (Ha e He).
      apply Forall_forall. intros t Ht. rewrite forallb_forall in Ha. specialize (Ha t Ht).
      apply Forall_forall. intros k Hk. rewrite forallb_forall in Ha. specialize (Ha k Hk).
      now apply Nat.leb_le in Ha.
    + intros v Hv. specialize (Corner v Hv). destruct v as [|e l]; [|exact Corner].
      exfalso. cbn [around map vertices] in Hv. apply in_app_or in Hv as [H|H];
        apply in_map_iff in H as [? [? _]]; discriminate.
Qed.
End Segment.
End Funnel.
