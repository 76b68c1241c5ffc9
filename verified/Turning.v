(* How fast the policy's input turns along a solution in the funnel, where it is at no limit: what is
   decided of it, and why. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Positive Claim Calculus Condition Definite Pushed
  Funnel Stays Valid Moving.
Import ListNotations.
Open Scope R_scope.

(* h du/dt of input i before it is clipped, under an input u *)
Definition row_of (g : segment) (i : nat) : list (list num) := nth i (gains g) [].
Definition turn (g : segment) (s : R) (x u w : list R) (i : nat) : R :=
  curve' (map val (nth i (feed g) [])) s
  - dot (map (fun c => curve' (map val c) s) (row_of g i)) (deviation g s x)
  - dot (map (along s) (row_of g i)) (relative g s x u w).
(* either way *)
Definition signed (up : bool) (y : R) : R := if up then y else -1 * y.
Definition turning (room : num) (up : bool) (limits : list (option (num * num))) (mode : list Condition.side)
  (delta vertex : list num) (g : segment) (s : R) (x : list R) (i : nat) (taus : list R) : R :=
  let z := deviation g s x in
  let us := wanted g s z in
  duration g * val room - signed up (turn g s x (moved (map val delta) (applied limits mode us)) (map val vertex) i)
  - dot taus ((rho g s - form (P g s) z z) :: held limits mode us).

Definition nabs (a : num) : num := (Z.abs (fst a), snd a).
Definition nmax (a b : num) : num := if num_ltb a b then b else a.
Definition largest (l : list num) : num := fold_right nmax nzero l.
(* w_j is alone in every term that it is in. *)
Definition alone (j : nat) (e : equation) : bool :=
  forallb (fun t => orb (Nat.eqb (nth j (fst t) O) 0) (Nat.eqb (fold_right Nat.add O (fst t)) 1)) e.
(* What a unit of w_j adds to the rate of input i at most. *)
Definition shove (g : segment) (i j : nat) : num :=
  largest (map (fun row => nabs (ndot row (map (push j) (equations g)))) (rows_of (row_of g i))).

Section Turning.
Context {K : Ints}.

Definition fturning (room : num) (up : bool) (limits : list (option (num * num))) (mode : list Condition.side)
  (delta vertex : list num) (g : segment) (depth index : Z) (i : nat) (taus : list F) : F :=
  let B := fbernstein (fplace depth index) (fremaining depth index) in
  let z := fdeviation g in
  let h := fsub (fnum (time (stop g))) (fnum (time (start g))) in
  let v := frelative limits mode delta vertex g depth index in
  let t := fsub
    (fsub (fcurve' B (map fnum (nth i (feed g) [])))
      (fdot (map (fun c => fcurve' B (map fnum c)) (row_of g i)) z))
    (fdot (map (fun c => fcurve B (map fnum c)) (row_of g i)) v) in
  let gap := fsub (flevel B g) (fform (fshape B g) z z) in
  fsub (fsub (fmul h (fnum room)) (if up then t else fscale (-1) t))
    (fdot taus (gap :: fheld limits mode (fwanted B g))).

Lemma means_turning s r0 depth index room up limits mode delta vertex g x i taus ts :
  let z := deviation g s x in
  (0 <= depth)%Z -> s * IZR (2 ^ depth) = IZR index + r0 -> length x = length (nominal g) ->
  Forall2 (means r0 (env z)) taus ts ->
  means r0 (env z) (fturning room up limits mode delta vertex g depth index i taus)
    (turning room up limits mode delta vertex g s x i ts).
Proof.
  intros z Hd Hs Hx Ht. unfold fturning, turning. fold z. cbn zeta.
  pose proof (means_deviation s r0 z g x eq_refl Hx) as Hz.
  pose proof (means_relative s r0 z depth index Hd Hs limits mode delta vertex g x eq_refl Hx) as Hr.
  assert (Hturn : means r0 (env z) (fsub
    (fsub (fcurve' (fbernstein (fplace depth index) (fremaining depth index)) (map fnum (nth i (feed g) [])))
      (fdot (map (fun c => fcurve' (fbernstein (fplace depth index) (fremaining depth index)) (map fnum c)) (row_of g i)) (fdeviation g)))
    (fdot (map (fun c => fcurve (fbernstein (fplace depth index) (fremaining depth index)) (map fnum c)) (row_of g i))
      (frelative limits mode delta vertex g depth index)))
    (turn g s x (moved (map val delta) (applied limits mode (wanted g s z))) (map val vertex) i)).
  { unfold turn. fold z. apply means_sub; [apply means_sub|].
    - apply (means_curve' s r0 z depth index Hd Hs). apply Forall2_map2, means_fnum.
    - apply means_fdot; auto. apply Forall2_map2. intros c.
      apply (means_curve' s r0 z depth index Hd Hs). apply Forall2_map2, means_fnum.
    - apply means_fdot; auto. apply Forall2_map2. intros c. now apply means_along. }
  apply means_sub; [apply means_sub|].
  - apply means_mul; [apply means_sub; apply means_fnum|apply means_fnum].
  - unfold signed. destruct up; auto. now apply (means_scale _ _ (-1)).
  - apply means_fdot; auto. constructor.
    + apply means_sub; [now apply means_level|]. apply means_fform; auto. now apply means_shape.
    + apply means_held. now apply (means_wanted s r0 z depth index Hd Hs g x eq_refl Hx).
Qed.

(* A part of time for an input and a way of turning; its multipliers first of rho - W. *)
Record rate_piece := RatePiece { whose : nat; upward : bool; part : piece }.
Fixpoint mixed (pushing : list bool) (box : list (num * num)) : list (list num) :=
  match pushing, box with
  | true :: f, b :: box' => map (cons (middle b)) (mixed f box')
  | false :: f, (a, b) :: box' => map (cons a) (mixed f box') ++ map (cons b) (mixed f box')
  | _, _ => [[]]
  end.
(* Vertices of (delta, w): entries that only push are at their centre. *)
Definition rate_box (d : problem) (off : list num) : list (num * num) := around off ++ box d.
Definition rate_cases (d : problem) (pushing : list bool) (off : list num) : list (list num) :=
  mixed pushing (rate_box d off).
(* What these entries add. *)
Fixpoint shoved (pushing : list bool) (box : list (num * num)) (g : segment) (i j : nat) : num :=
  match pushing, box with
  | f :: pushing', b :: box' =>
      let rest := shoved pushing' box' g i (S j) in
      if f then nadd (nmul (Pushed.radius b) (shove g i j)) rest else rest
  | _, _ => nzero
  end.
Definition is_free (m : list Condition.side) (i : nat) : bool :=
  match nth i m Free with Free => true | _ => false end.
Definition rate_piece_ok (d : problem) (w : witness) (products : choices) (pushing : list bool)
  (g : segment) (off rates : list num) (q : rate_piece) : bool :=
  let p := part q in
  match nth_error (rate_cases d pushing off) (vertex p), nth_error (modes (limits d)) (mode p),
    all_expanded (sides w) (tau p) with
  | Some v, Some m, Some taus =>
      let delta := firstn (length off) v in
      let corner := skipn (length off) v in
      let room := nsub (nth (whose q) rates nzero)
        (shoved pushing (rate_box d off) g (whose q) (1 + length (nominal g))) in
      andb (0 <=? depth p)%Z
        (is_positive (basis w) products (columns p) (gram_factors p)
          (fturning room (upward q) (limits d) m delta corner g (depth p) (index p) (whose q) taus))
  | _, _, _ => false
  end.
Definition rates_covered (d : problem) (pushing : list bool) (off : list num) (qs : list rate_piece)
  : bool :=
  forallb (fun i => forallb (fun up =>
    let ps := map part (filter (fun q => andb (Nat.eqb (whose q) i) (Bool.eqb (upward q) up)) qs) in
    forallb (fun v => forallb (fun im =>
        if is_free (snd im) i then (2 ^ 16 <=? reached v (fst im) 0 ps)%Z else true)
      (combine (seq 0 (length (modes (limits d)))) (modes (limits d))))
      (seq 0 (length (rate_cases d pushing off)))) [true; false])
    (seq 0 (length (limits d))).
(* Which entries of (delta, w) only push; their equations, and the policy's curves. *)
Fixpoint pushing_ok (pushing : list bool) (es : list equation) (j : nat) : bool :=
  match pushing with
  | [] => true
  | f :: pushing' => andb (if f then forallb (alone j) es else true) (pushing_ok pushing' es (S j))
  end.
Definition rates_ok (d : problem) (w : witness) (pushing : list bool) (g : segment)
  (off rates : list num) (qs : list rate_piece) : bool :=
  andb (andb (andb (Nat.eqb (length off) (length (limits d)))
        (Nat.eqb (length pushing) (length (rate_box d off))))
      (andb (even_gains g) (pushing_ok pushing (equations g) (1 + length (nominal g)))))
    (andb (rates_covered d pushing off qs)
      (forallb (rate_piece_ok d w (products (basis w)) pushing g off rates) qs)).

(* Why. *)
Lemma val_nabs a : val (nabs a) = Rabs (val a).
Proof.
  unfold nabs, val; cbn [fst snd]. rewrite abs_IZR. unfold Rdiv. rewrite Rabs_mult.
  rewrite (Rabs_right (/ _)); auto. left. now apply Rinv_0_lt_compat, IZR_lt.
Qed.
Lemma nmax_above a b : val a <= val (nmax a b) /\ val b <= val (nmax a b).
Proof.
  unfold nmax. destruct (num_ltb a b) eqn:E.
  - apply num_ltb_lt in E. lra.
  - apply num_ltb_not in E. lra.
Qed.
Lemma largest_above l : 0 <= val (largest l) /\ forall a, In a l -> val a <= val (largest l).
Proof.
  induction l as [|b l [IH0 IH]]; cbn [largest fold_right].
  { split; [rewrite val_nzero; lra|intros a []]. }
  destruct (nmax_above b (fold_right nmax nzero l)) as [A B]. fold (largest l) in *. split; [lra|].
  intros a [<-|H]; auto. specialize (IH a H). lra.
Qed.

Lemma relative_affine n g s x u pre post a b l : Forall (linear_beyond n) (equations g) ->
  (1 + length (x ++ u))%nat = n ->
  relative g s x u (pre ++ ((1 - l) * a + l * b) :: post)
    = zip (fun a b => (1 - l) * a + l * b) (relative g s x u (pre ++ a :: post))
        (relative g s x u (pre ++ b :: post)).
Proof.
  intros He Hn. unfold relative, field.
  generalize (map (fun c => curve' (map val c) s) (nominal g)).
  set (t := line s _ _). induction He as [|e es He Hes IH]; intros [|d ds]; cbn; auto.
  f_equal; auto.
  pose proof (rate_affine n e (t :: x ++ u) pre post a b l He ltac:(cbn; auto)) as A.
  cbn [app] in A. rewrite <- !app_assoc in A. rewrite A. ring.
Qed.
Lemma relative_length g s x u w : length (equations g) = length (nominal g) ->
  length (relative g s x u w) = length (nominal g).
Proof. intros H. unfold relative, field. rewrite zip_length; rewrite !map_length; auto. Qed.
Lemma turn_affine n g s x u up i : Forall (linear_beyond n) (equations g) ->
  (1 + length (x ++ u))%nat = n -> length (equations g) = length (nominal g) ->
  affine (fun w => signed up (turn g s x u w i)).
Proof.
  intros He Hn Hl pre post a b l. cbn beta. unfold turn.
  rewrite (relative_affine n) by auto. rewrite dot_affine by now rewrite !relative_length.
  unfold signed. destruct up; ring.
Qed.
Lemma turn_affine_inputs n g s x a v up i : Forall (linear_beyond (1 + n)) (equations g) ->
  length x = n -> length (equations g) = length (nominal g) ->
  affine (fun delta => signed up (turn g s x (zip Rplus a delta) v i)).
Proof.
  intros He Hx Hl. assert (A : affine (fun w => signed up (turn g s x [] w i))).
  { apply (turn_affine (1 + n)); auto. rewrite app_nil_r. cbn. congruence. }
  assert (E : forall u, turn g s x u v i = turn g s x [] (u ++ v) i) by reflexivity.
  intros pre post p q l. cbn beta. rewrite !E.
  destruct (zip_split a pre) as [[b [b0 [c [_ H]]]]|[b H]].
  - rewrite !H, <- !app_assoc. cbn [app].
    replace (b0 + ((1 - l) * p + l * q)) with ((1 - l) * (b0 + p) + l * (b0 + q)) by ring.
    exact (A b (zip Rplus c post ++ v) (b0 + p) (b0 + q) l).
  - rewrite !H. ring.
Qed.

Lemma rate_alone L y c post e : alone (length L) e = true ->
  rate e (L ++ y :: post) = rate e (L ++ c :: post) + (y - c) * val (push (length L) e).
Proof.
  intros H. induction e as [|[k a] e IH]; cbn [rate push]; [rewrite val_nzero; ring|].
  cbn [alone forallb] in H. apply andb_prop in H as [H1 H2]. rewrite (IH H2). cbn [fst] in H1.
  destruct (Nat.eqb_spec (nth (length L) k O) 0) as [E|E].
  { destruct (power_split L k post) as [q Hq]. rewrite !Hq, E. cbn. ring. }
  cbn [orb] in H1. apply Nat.eqb_eq in H1. destruct (power_alone L k y post H1 E) as [-> _].
  destruct (power_alone L k c post H1 E) as [-> _]. rewrite val_add. ring.
Qed.
Lemma dot_rows_bound row m s q top : Forall (fun c => length c = m) row -> 0 <= s <= 1 ->
  (0 < m <= 4)%nat ->
  (forall k, (k < m)%nat -> Rabs (dot (map val (map (fun c => nth k c nzero) row)) q) <= top) ->
  Rabs (dot (map (along s) row) q) <= top.
Proof.
  intros Hm Hs H4 H. rewrite (gain_along m s row Hm q).
  destruct (bernstein_weights m s Hs H4) as [Lb [W S]].
  pose proof (dot_between (- top) top (bernstein (pred m) s) W
    (map (fun k => dot (map val (map (fun c => nth k c nzero) row)) q) (seq 0 m))) as B.
  rewrite S in B. apply Rabs_le. rewrite !Rmult_1_r in B. apply B.
  - now rewrite map_length, seq_length.
  - apply Forall_forall. intros v Hv. apply in_map_iff in Hv as [k [<- Hk]]. apply in_seq in Hk.
    specialize (H k ltac:(lia)). pose proof (Rle_abs (dot (map val (map (fun c => nth k c nzero) row)) q)).
    pose proof (Rle_abs (- dot (map val (map (fun c => nth k c nzero) row)) q)).
    rewrite Rabs_Ropp in *. lra.
Qed.
(* A row of gains has one number of control points. *)
Lemma even_row g i n : even_gains g = true -> length (nominal g) = n -> (i < length (gains g))%nat ->
  length (row_of g i) = n /\ ((row_of g i = [] /\ n = O) \/ exists m, (0 < m <= 4)%nat /\
    m = length (hd [] (row_of g i)) /\ Forall (fun c => length c = m) (row_of g i)).
Proof.
  intros He Ln Hi. assert (Hrow : In (row_of g i) (gains g)) by (apply nth_In; lia).
  unfold even_gains in He. rewrite forallb_forall in He. specialize (He _ Hrow).
  apply andb_prop in He as [Le He]. apply Nat.eqb_eq in Le. split; [congruence|].
  destruct (row_of g i) as [|c0 row]; [left; cbn in Le; split; auto; congruence|]. right.
  exists (length c0). cbn [hd] in *. split; [|split; auto].
  - cbn [forallb] in He. apply andb_prop in He as [He _]. apply andb_prop in He as [_ He].
    apply andb_prop in He as [A B]. apply Nat.ltb_lt in A. apply Nat.leb_le in B. auto.
  - apply Forall_forall. intros c Hin. rewrite forallb_forall in He. specialize (He c Hin).
    apply andb_prop in He as [He _]. now apply Nat.eqb_eq in He.
Qed.
Lemma shove_bound g i j s n : even_gains g = true -> length (nominal g) = n ->
  (i < length (gains g))%nat -> 0 <= s <= 1 ->
  Rabs (dot (map (along s) (row_of g i)) (map (fun e => val (push j e)) (equations g))) <= val (shove g i j).
Proof.
  intros He Ln Hi Hs. destruct (even_row g i n He Ln Hi) as [_ [[E _]|[m [Hm [Em Hrow]]]]].
  { rewrite E. cbn. rewrite Rabs_R0. unfold shove. apply largest_above. }
  apply (dot_rows_bound _ m); auto. intros k Hk. unfold shove.
  eapply Rle_trans; [|apply largest_above; apply in_map_iff;
    exists (map (fun c => nth k c nzero) (row_of g i)); split; [reflexivity|];
    apply in_map_iff; exists k; split; [reflexivity|]; apply in_seq; lia].
  rewrite val_nabs, val_dot, !map_map. lra.
Qed.
Lemma turn_alone g s x u pre y c post up i n : length (equations g) = length (nominal g) ->
  even_gains g = true -> length (nominal g) = n -> (i < length (gains g))%nat -> 0 <= s <= 1 ->
  0 <= duration g ->
  let j := (1 + length (x ++ u) + length pre)%nat in
  forallb (alone j) (equations g) = true ->
  signed up (turn g s x u (pre ++ y :: post) i) <= signed up (turn g s x u (pre ++ c :: post) i)
    + duration g * (Rabs (y - c) * val (shove g i j)).
Proof.
  intros Hl He Ln Hi Hs Hd j Ha.
  set (q := map (fun e => val (push j e)) (equations g)).
  assert (E : relative g s x u (pre ++ y :: post) =
    zip Rplus (relative g s x u (pre ++ c :: post)) (map (fun v => v * (duration g * (y - c))) q)).
  { unfold relative, field, q. set (t := line s _ _).
    assert (Lds : length (equations g)
      = length (map (fun c => curve' (map val c) s) (nominal g))) by (rewrite map_length; exact Hl).
    revert Lds Ha. generalize (map (fun c => curve' (map val c) s) (nominal g)). clear Hl q.
    induction (equations g) as [|e es IH]; intros [|d ds] Ld Ha; try discriminate; cbn [map zip]; auto.
    cbn [forallb] in Ha. apply andb_prop in Ha as [A1 A2].
    rewrite IH by (auto; now injection Ld). f_equal.
    assert (Ej : j = length (t :: x ++ u ++ pre)).
    { unfold j. cbn [length]. rewrite !app_length. lia. }
    rewrite Ej in A1.
    pose proof (rate_alone (t :: x ++ u ++ pre) y c post e A1) as A.
    cbn [app] in A. rewrite <- !app_assoc in A. rewrite A. rewrite Ej. ring. }
  unfold turn. rewrite E, dot_plus, dot_scaled_r.
  2:{ rewrite relative_length, map_length by auto. unfold q. rewrite map_length. auto. }
  pose proof (shove_bound g i j s n He Ln Hi Hs) as B. fold q in B.
  set (k := dot (map (along s) (row_of g i)) q) in *. set (A := dot _ (relative _ _ _ _ _)).
  assert (M : Rabs (k * (duration g * (y - c))) <= duration g * (Rabs (y - c) * val (shove g i j))).
  { rewrite !Rabs_mult, (Rabs_right (duration g)) by lra. pose proof (Rabs_pos (y - c)).
    pose proof (Rmult_le_pos _ _ Hd H).
    pose proof (Rmult_le_compat_r _ _ _ H0 B). lra. }
  pose proof (Rle_abs (k * (duration g * (y - c)))) as M1.
  pose proof (Rle_abs (- (k * (duration g * (y - c))))) as M2. rewrite Rabs_Ropp in M2.
  unfold signed. destruct up; lra.
Qed.

(* On the box, from entries at their centre and at the ends of the others. *)
Lemma below_mixed g i h : 0 <= h -> forall box pushing j G c,
  length pushing = length box -> affine G ->
  (forall pre y y' post, nth (length pre) pushing false = true ->
    G (pre ++ y :: post) <= G (pre ++ y' :: post) + h * (Rabs (y - y') * val (shove g i (j + length pre)))) ->
  (forall v, In v (mixed pushing box) -> G (map val v) < c - h * val (shoved pushing box g i j)) ->
  forall w, in_box w box -> G w < c.
Proof.
  intros Hh. induction box as [|[a b] box IH]; intros [|f pushing] j G c L HG HP Hv w Hw;
    try discriminate; inversion Hw as [|w0 ? w' ? H1 H2]; subst.
  { specialize (Hv [] (or_introl eq_refl)). cbn [map shoved] in Hv. rewrite val_nzero in Hv.
    rewrite Rmult_0_r, Rminus_0_r in Hv. exact Hv. }
  injection L as L. cbn [fst snd] in H1.
  assert (HG' : forall q, affine (fun w => G (q :: w))).
  { intros q pre post p p' l. exact (HG (q :: pre) post p p' l). }
  assert (HP' : forall q pre y y' post, nth (length pre) pushing false = true ->
    G (q :: pre ++ y :: post) <= G (q :: pre ++ y' :: post)
      + h * (Rabs (y - y') * val (shove g i (S j + length pre)))).
  { intros q pre y y' post Hn. pose proof (HP (q :: pre) y y' post Hn) as A. cbn [length] in A.
    rewrite <- Nat.add_succ_comm in A. exact A. }
  destruct f.
  - cbn [mixed shoved] in Hv. set (m := val (middle (a, b))).
    assert (B : G (m :: w') < c - h * (val (Pushed.radius (a, b)) * val (shove g i j))).
    { apply (IH pushing (S j) (fun w => G (m :: w)) _ L (HG' m) (HP' m)); auto. intros v Hin.
      specialize (Hv (middle (a, b) :: v) ltac:(now apply in_map)). cbn [map] in Hv. fold m in Hv.
      rewrite val_add, val_mul in Hv. lra. }
    pose proof (HP [] w0 m w' eq_refl) as A. cbn [app length] in A. rewrite Nat.add_0_r in A.
    assert (R1 : Rabs (w0 - m) <= val (Pushed.radius (a, b))).
    { unfold m, middle, Pushed.radius. rewrite !val_mul, val_add, val_sub. cbn [fst snd].
      replace (val (1%Z, 2%positive)) with (1 / 2) by (unfold val; cbn; field).
      apply Rabs_le. lra. }
    assert (S0 : 0 <= val (shove g i j)) by apply largest_above.
    pose proof (Rmult_le_compat_l h _ _ Hh (Rmult_le_compat_r _ _ _ S0 R1)). lra.
  - cbn [mixed shoved] in Hv.
    refine (below_on_box [(a, b)] (fun v => G (v ++ w')) c _ _ [w0] _).
    + intros pre post p q l. rewrite <- !app_assoc. exact (HG pre (post ++ w') p q l).
    + intros v Hin. cbn in Hin. destruct Hin as [<-|[<-|[]]]; cbn [map app].
      * apply (IH pushing (S j) (fun w => G (val a :: w)) _ L (HG' _) (HP' _)); auto. intros v Hin.
        apply (Hv (a :: v)). apply in_or_app. left. now apply in_map.
      * apply (IH pushing (S j) (fun w => G (val b :: w)) _ L (HG' _) (HP' _)); auto. intros v Hin.
        apply (Hv (b :: v)). apply in_or_app. right. now apply in_map.
    + constructor; [exact H1|constructor].
Qed.

(* Some mode holds in which an input that is at no limit is free. *)
Lemma free_mode_exists limits : Forall proper limits -> forall us, length us = length limits ->
  forall i, free (nth i limits None) (nth i us 0) ->
  exists im m, nth_error (modes limits) im = Some m /\ is_free m i = true /\
    applied limits m us = zip clip limits us /\ Forall (fun q => 0 <= q) (held limits m us).
Proof.
  intros Hp us H i Hf.
  assert (G : exists m, In m (modes limits) /\ is_free m i = true /\
    applied limits m us = zip clip limits us /\ Forall (fun q => 0 <= q) (held limits m us)).
  { clear - Hp H Hf. revert us H i Hf.
    induction Hp as [|l0 l Hp Hl IH]; intros [|u us] H i Hf; try discriminate.
    { exists []. cbn. split; auto. split; auto. unfold is_free. now destruct i. }
    injection H as H. destruct i as [|i].
    - cbn [nth] in Hf. destruct (mode_exists l Hl us H) as [m [Hm [Ha Hh]]]. exists (Free :: m).
      destruct l0 as [[a b]|]; cbn [modes free] in *.
      + split. { apply in_or_app. right. apply in_or_app. left. now apply in_map. }
        split; auto. cbn. rewrite Ha, Rmin_right, Rmax_right by lra. split; auto.
        constructor; auto. apply Rmult_le_pos; lra.
      + split; [now apply in_map|]. split; auto. cbn. rewrite Ha. auto.
    - cbn [nth] in Hf. destruct (IH us H i Hf) as [m [Hm [Hi [Ha Hh]]]].
      assert (One : exists e, In (e :: m) (modes (l0 :: l)) /\
        applied (l0 :: l) (e :: m) (u :: us) = zip clip (l0 :: l) (u :: us) /\
        Forall (fun q => 0 <= q) (held (l0 :: l) (e :: m) (u :: us))).
      { assert (Pl : Forall proper [l0]) by auto.
        destruct (mode_exists [l0] Pl [u] eq_refl) as [m0 [Hm0 [Ha0 Hh0]]].
        destruct l0 as [[a b]|]; cbn [modes] in *.
        - assert (E : m0 = [Low] \/ m0 = [Free] \/ m0 = [High]).
          { cbn in Hm0. intuition auto. }
          destruct E as [-> | [-> | ->]]; cbn in Ha0, Hh0.
          + exists Low. split; [apply in_or_app; left; now apply in_map|]. cbn. rewrite Ha.
            injection Ha0 as Ha0. split; [f_equal; exact Ha0|]. inversion Hh0; subst. constructor; auto.
          + exists Free. split; [apply in_or_app; right; apply in_or_app; left; now apply in_map|].
            cbn. rewrite Ha. injection Ha0 as Ha0. split; [f_equal; exact Ha0|].
            inversion Hh0; subst. constructor; auto.
          + exists High. split; [apply in_or_app; right; apply in_or_app; right; now apply in_map|].
            cbn. rewrite Ha. injection Ha0 as Ha0. split; [f_equal; exact Ha0|]. inversion Hh0; subst. constructor; auto.
        - exists Free. split; [now apply in_map|]. cbn. rewrite Ha. auto. }
      destruct One as [e [He [Hae Hhe]]]. exists (e :: m). auto. }
  destruct G as [m [Hm G]]. apply In_nth_error in Hm as [im Him]. exists im, m. auto.
Qed.

(* The same of an input, which is off by entry [length pre] of delta. *)
Lemma turn_alone_input g s x a v pre y c post up i n : length (equations g) = length (nominal g) ->
  even_gains g = true -> length (nominal g) = n -> (i < length (gains g))%nat -> 0 <= s <= 1 ->
  0 <= duration g -> length x = n ->
  forallb (alone (1 + n + length pre)) (equations g) = true ->
  signed up (turn g s x (zip Rplus a (pre ++ y :: post)) v i)
    <= signed up (turn g s x (zip Rplus a (pre ++ c :: post)) v i)
      + duration g * (Rabs (y - c) * val (shove g i (1 + n + length pre))).
Proof.
  intros Hl He Ln Hi Hs Hd Hx Ha.
  assert (E : forall u, turn g s x u v i = turn g s x [] (u ++ v) i) by reflexivity.
  rewrite !E. destruct (zip_split a pre) as [[b [b0 [r [Lb H]]]]|[b H]]; rewrite !H.
  - rewrite <- !app_assoc. cbn [app].
    replace (y - c) with ((b0 + y) - (b0 + c)) by ring.
    assert (Ej : (1 + length (x ++ @nil R) + length b)%nat = (1 + n + length pre)%nat).
    { rewrite app_nil_r. lia. }
    rewrite <- Ej in Ha |- *.
    now apply (turn_alone g s x [] b (b0 + y) (b0 + c) (zip Rplus r post ++ v) up i n).
  - assert (0 <= duration g * (Rabs (y - c) * val (shove g i (1 + n + length pre)))).
    { apply Rmult_le_pos; auto. apply Rmult_le_pos; [apply Rabs_pos|apply largest_above]. }
    lra.
Qed.
Lemma zip_beyond us : forall e w, length e = length us ->
  zip Rplus (us ++ map (fun _ => 0) w) (e ++ w) = zip Rplus us e ++ w.
Proof.
  induction us as [|u us IH]; intros [|p e] w H; try discriminate; cbn [app zip].
  - induction w as [|q w IHw]; auto. cbn [map zip]. rewrite IHw. f_equal. ring.
  - rewrite IH by (now injection H). reflexivity.
Qed.
Lemma moved_is us e : length e = length us -> moved e us = zip Rplus us e.
Proof. intros H. destruct e; auto. now destruct us. Qed.
Lemma mixed_length box : forall pushing v, length pushing = length box -> In v (mixed pushing box) ->
  length v = length box.
Proof.
  induction box as [|[a b] box IH]; intros [|f pushing] v L H; try discriminate.
  - destruct H as [<-|[]]. reflexivity.
  - injection L as L. destruct f; cbn [mixed] in H; [|apply in_app_or in H as [H|H]];
      apply in_map_iff in H as [v' [<- H]]; cbn; f_equal; now apply (IH pushing).
Qed.

Section Segment.
Variables (d : problem) (w : witness) (g : segment) (off rates : list num) (pushing : list bool)
  (qs : list rate_piece) (n : nat).
Hypothesis Hlimits : Forall proper (limits d).
Hypothesis Hok : segment_ok n d g = true.
Hypothesis Hoff : off_ok n d g off = true.
Hypothesis Hrates : rates_ok d w pushing g off rates qs = true.

Lemma rate_piece_at i up v im m s : 0 <= s <= 1 -> (i < length (limits d))%nat ->
  (v < length (rate_cases d pushing off))%nat -> nth_error (modes (limits d)) im = Some m ->
  is_free m i = true ->
  exists q, In q qs /\ whose q = i /\ upward q = up /\ vertex (part q) = v /\ mode (part q) = im /\
    holds (part q) s.
Proof.
  intros Hs Hi Hv Him Hf. unfold rates_ok in Hrates. apply andb_prop in Hrates as [_ H].
  apply andb_prop in H as [Hcov Hps].
  unfold rates_covered in Hcov. rewrite forallb_forall in Hcov.
  specialize (Hcov i ltac:(apply in_seq; lia)). rewrite forallb_forall in Hcov.
  specialize (Hcov up ltac:(destruct up; cbn; auto)). cbn zeta in Hcov.
  set (mine := filter (fun q => andb (Nat.eqb (whose q) i) (Bool.eqb (upward q) up)) qs) in *.
  rewrite forallb_forall in Hcov. specialize (Hcov v ltac:(apply in_seq; lia)).
  rewrite forallb_forall in Hcov. specialize (Hcov (im, m)).
  assert (Hin : In (im, m) (combine (seq 0 (length (modes (limits d)))) (modes (limits d)))).
  { clear - Him. revert im Him. generalize (modes (limits d)).
    assert (G : forall l k im o, nth_error l im = Some o ->
      In ((k + im)%nat, o) (combine (seq k (@length (list Condition.side) l)) l)).
    { induction l as [|y l IH]; intros k [|im] o H; cbn in *; try discriminate.
      - left. injection H as <-. f_equal. lia.
      - right. replace (k + S im)%nat with (S k + im)%nat by lia. now apply IH. }
    intros l im H. exact (G l O im m H). }
  specialize (Hcov Hin). cbn [fst snd] in Hcov. rewrite Hf in Hcov. apply Z.leb_le in Hcov.
  destruct (reached_covers v im (s * 65536) (map part mine) 0) as [p [Hp [E1 [E2 E3]]]].
  - apply Forall_forall. intros p Hp. apply in_map_iff in Hp as [q [<- Hq]].
    apply filter_In in Hq as [Hq _]. rewrite forallb_forall in Hps. specialize (Hps q Hq).
    unfold rate_piece_ok in Hps. destruct (nth_error _ _); [|discriminate].
    destruct (nth_error _ _); [|discriminate]. destruct (all_expanded _ _); [|discriminate].
    apply andb_prop in Hps as [X _]. now apply Z.leb_le in X.
  - apply IZR_le in Hcov. change (IZR (2 ^ 16)) with 65536 in Hcov. lra.
  - change (2 ^ 16)%Z with 65536%Z in Hcov. lia.
  - replace (s * 65536 / 65536) with s in E3 by field.
    apply in_map_iff in Hp as [q [<- Hq]]. apply filter_In in Hq as [Hq Hk].
    apply andb_prop in Hk as [K1 K2]. apply Nat.eqb_eq in K1. apply Bool.eqb_prop in K2.
    exists q. auto 8.
Qed.

(* In the funnel, an input that is at no limit turns by less than its rate. *)
Lemma turn_bounded s x u w0 i : 0 <= s <= 1 -> length x = n -> in_box w0 (box d) ->
  within_off off (input d g s x) u -> (i < length (limits d))%nat ->
  let z := deviation g s x in
  form (P g s) z z <= rho g s ->
  free (nth i (limits d) None) (nth i (wanted g s z) 0) ->
  Rabs (turn g s x u w0 i) < duration g * val (nth i rates nzero).
Proof.
  intros Hs Hx Hw Hu Hi z Hin Hfree. destruct (segment_facts d g n Hok).
  pose proof Hrates as HR. unfold rates_ok in HR. apply andb_prop in HR as [HR HR2].
  apply andb_prop in HR2 as [_ Hps]. apply andb_prop in HR as [HR1 HR3].
  apply andb_prop in HR1 as [Loff Lpush]. apply Nat.eqb_eq in Loff, Lpush.
  apply andb_prop in HR3 as [Heven Hpushing].
  set (us := wanted g s z) in *.
  assert (Hus : length us = length (limits d)).
  { unfold us, wanted. rewrite zip_length; congruence. }
  destruct (free_mode_exists (limits d) Hlimits us Hus i Hfree) as [im [m [Him [Hmi [Happ Hheld]]]]].
  assert (Hinp : input d g s x = applied (limits d) m us) by (unfold input; now rewrite Happ).
  rewrite Hinp in Hu.
  assert (Lapp : length (applied (limits d) m us) = length (limits d)).
  { rewrite Happ. rewrite zip_length; congruence. }
  assert (Hdur : 0 < duration g) by (unfold duration; lra).
  set (a := applied (limits d) m us) in *.
  (* What it is off by, and w: one point of one box. *)
  assert (Hoffs : exists delta, in_box delta (around off) /\ u = zip Rplus a delta).
  { unfold within_off in Hu. destruct off as [|o os]; auto. exists []. split; [constructor|].
    subst u. destruct a; auto. cbn in *. congruence. }
  destruct Hoffs as [delta [Hdelta ->]].
  assert (Ldelta : length delta = length a).
  { pose proof (Forall2_length _ _ _ Hdelta) as E. unfold around in E. rewrite map_length in E. congruence. }
  assert (Hlinear : Forall (linear_beyond (1 + n)) (equations g)).
  { unfold off_ok in Hoff. destruct off as [|o os].
    - replace (1 + n)%nat with (1 + n + length (limits d))%nat; auto. cbn [length] in Loff. lia.
    - apply andb_prop in Hoff as [_ Ha]. apply Forall_forall. intros e He.
      unfold linear_beyond. rewrite forallb_forall in Ha. specialize (Ha e He).
      apply Forall_forall. intros t Ht. rewrite forallb_forall in Ha. specialize (Ha t Ht).
      apply Forall_forall. intros k Hk. rewrite forallb_forall in Ha. specialize (Ha k Hk).
      now apply Nat.leb_le in Ha. }
  set (still := a ++ map (fun _ => 0) w0).
  set (c := duration g * val (nth i rates nzero)).
  assert (Way : forall up, signed up (turn g s x (zip Rplus a delta) w0 i) < c).
  { intros up. set (G := fun v => signed up (turn g s x (zip Rplus still v) [] i)).
    assert (HG : forall e v, length e = length a -> length v = length w0 ->
      G (e ++ v) = signed up (turn g s x (zip Rplus a e) v i)).
    { intros e v Le Lv. unfold G, still.
      assert (Ez : map (fun _ : R => 0) w0 = map (fun _ => 0) v).
      { clear - Lv. revert v Lv. induction w0 as [|q l IH]; intros [|r v] L; try discriminate; auto.
        cbn. f_equal. apply IH. now injection L. }
      rewrite Ez, zip_beyond by auto. unfold turn, relative, field. now rewrite app_nil_r. }
    rewrite <- HG by auto.
    apply (below_mixed g i (duration g) ltac:(lra) (rate_box d off) pushing (1 + n) G c Lpush).
    - apply (turn_affine_inputs n); auto; congruence.
    - intros pre y y' post Hflag. unfold G.
      apply (turn_alone_input g s x still [] pre y y' post up i n); auto; try congruence; try lra.
      rewrite f_nominal in Hpushing. clear - Hpushing Hflag. revert Hpushing Hflag.
      generalize (1 + n)%nat. revert pushing.
      induction pre as [|p pre IH]; intros [|f l] j H Hf; cbn [length nth] in *; try discriminate;
        cbn [pushing_ok] in H; apply andb_prop in H as [A B].
      + subst f. now rewrite Nat.add_0_r.
      + rewrite <- Nat.add_succ_comm. exact (IH l (S j) B Hf).
    - intros v Hv.
      assert (Case : exists iv, nth_error (rate_cases d pushing off) iv = Some v)
        by now apply In_nth_error.
      destruct Case as [iv Hiv].
      destruct (rate_piece_at i up iv im m s Hs Hi) as [q [Hq [E1 [E2 [E3 [E4 Hh]]]]]]; auto.
      { apply nth_error_Some. congruence. }
      rewrite forallb_forall in Hps. specialize (Hps q Hq). unfold rate_piece_ok in Hps.
      rewrite E3, E4, Hiv, Him in Hps.
      destruct (all_expanded (sides w) (tau (part q))) as [taus|] eqn:Etau; [|discriminate].
      rewrite f_nominal, E1, E2 in Hps. cbn zeta in Hps. apply andb_prop in Hps as [A1 B].
      apply Z.leb_le in A1. set (p := part q) in *.
      set (e := firstn (length off) v) in *. set (v' := skipn (length off) v) in *.
      pose proof (mixed_length _ _ _ Lpush Hv) as Lv. unfold rate_box, around in Lv.
      rewrite app_length, map_length in Lv.
      assert (Lw : length w0 = length (box d)) by exact (Forall2_length _ _ _ Hw).
      assert (Le : length (map val e) = length a).
      { unfold e. rewrite map_length, firstn_length_le by lia. congruence. }
      assert (Lv' : length (map val v') = length w0).
      { unfold v'. rewrite map_length, skipn_length. lia. }
      set (r0 := s * IZR (2 ^ depth p) - IZR (index p)).
      assert (Hr : 0 <= r0 <= 1) by (unfold r0; destruct Hh; lra).
      destruct (all_expanded_val r0 z _ _ Hr _ Etau) as [ts [Hts Hns]].
      pose proof (means_turning s r0 (depth p) (index p)
        (nsub (nth i rates nzero) (shoved pushing (rate_box d off) g i (1 + n))) up
        (limits d) m e v' g x i taus ts A1 ltac:(unfold r0; ring) ltac:(congruence) Hts) as Hc.
      fold z in Hc.
      pose proof (is_positive_sound r0 (env z) _ _ _ _ _ Hr B Hc) as Hpos.
      unfold turning in Hpos. fold z in Hpos. fold us in Hpos. fold a in Hpos.
      rewrite (moved_is a) in Hpos by auto.
      assert (Hdot : 0 <= dot ts ((rho g s - form (P g s) z z) :: held (limits d) m us)).
      { apply dot_nonneg; auto. constructor; auto. lra. }
      rewrite <- (firstn_skipn (length off) v), map_app. fold e v'. rewrite HG by auto.
      rewrite val_sub in Hpos. unfold c. lra.
    - apply Forall2_app; auto. }
  pose proof (Way true) as U. pose proof (Way false) as D. unfold signed in U, D.
  apply Rabs_def1; lra.
Qed.
End Segment.
End Turning.
