(* Networks of maps that are linear between knots, or cubic splines: how such a map differs between
   two points, and what is left of the differences at the corners of its slopes. *)
From Coq Require Import ZArith Reals List Lra Lia Psatz.
From Verified Require Import Integers Forms Claim Condition Definite Goal Funnel Valid Tubes Increments Boxes.
Import ListNotations.
Open Scope R_scope.

Definition point := (num * num)%type.
Definition slope (a b : point) : num := ndiv (nsub (snd b) (snd a)) (nsub (fst b) (fst a)).
Fixpoint slopes (a : point) (rest : list point) : list num :=
  match rest with [] => [] | b :: rest' => slope a b :: slopes b rest' end.
Fixpoint ascending (a : point) (rest : list point) : bool :=
  match rest with
  | [] => true
  | b :: rest' => andb (0 <? fst (nsub (fst b) (fst a)))%Z (ascending b rest')
  end.
Definition nmost (a b : num) : num := if num_ltb a b then b else a.
Fixpoint steps_of (h a : num) (rest : list num) : list num :=
  match rest with [] => [] | b :: rest' => ndiv (nsub b a) h :: steps_of h b rest' end.
Definition slopes_of (f : mapping) : list num :=
  match f with
  | Broken (a :: rest) => slopes a rest
  | Spline _ h (a :: rest) => steps_of h a rest
  | _ => []
  end.
Definition slope_range (f : mapping) : num * num :=
  match slopes_of f with
  | a :: rest => (fold_right nmin a rest, fold_right nmost a rest)
  | [] => (nzero, nzero)
  end.
Definition map_ok (f : mapping) : bool :=
  match f with
  | Broken (a :: b :: rest) => ascending a (b :: rest)
  | Spline _ h cs => andb (0 <? fst h)%Z (Nat.leb 4 (length cs))
  | _ => false
  end.

Lemma not_less a b : num_ltb a b = false -> val b <= val a.
Proof.
  destruct a as [p q], b as [p' q']. unfold num_ltb, val; cbn [fst snd]. intros H. apply Z.ltb_ge in H.
  apply IZR_le in H. rewrite !mult_IZR in H.
  assert (0 < IZR (Zpos q)) by now apply IZR_lt. assert (0 < IZR (Zpos q')) by now apply IZR_lt.
  apply (Rmult_le_reg_r (IZR (Zpos q) * IZR (Zpos q'))). { now apply Rmult_lt_0_compat. }
  replace (IZR p' / _ * _) with (IZR p' * IZR (Zpos q)) by (field; lra).
  replace (IZR p / _ * _) with (IZR p * IZR (Zpos q')) by (field; lra). exact H.
Qed.
Lemma less a b : num_ltb a b = true -> val a <= val b.
Proof.
  intros H. apply not_less. destruct a as [p q], b as [p' q']. unfold num_ltb in *. cbn [fst snd] in *.
  apply Z.ltb_lt in H. apply Z.ltb_ge. lia.
Qed.
Lemma least_of s : forall k, Forall (fun e => val (fold_right nmin k s) <= val e) (k :: s).
Proof.
  induction s as [|a s IH]; intros k; [repeat constructor; cbn; lra|]. specialize (IH k).
  inversion IH as [|? ? H1 H2]; subst. cbn [fold_right]. set (m := fold_right nmin k s) in *.
  assert (val (nmin a m) <= val a /\ val (nmin a m) <= val m) as [A M].
  { unfold nmin. destruct (num_ltb a m) eqn:E; [apply less in E|apply not_less in E]; lra. }
  constructor; [lra|]. constructor; auto. eapply Forall_impl; [|exact H2]. cbn. intros; lra.
Qed.
Lemma most_of s : forall k, Forall (fun e => val e <= val (fold_right nmost k s)) (k :: s).
Proof.
  induction s as [|a s IH]; intros k; [repeat constructor; cbn; lra|]. specialize (IH k).
  inversion IH as [|? ? H1 H2]; subst. cbn [fold_right]. set (m := fold_right nmost k s) in *.
  assert (val a <= val (nmost a m) /\ val m <= val (nmost a m)) as [A M].
  { unfold nmost. destruct (num_ltb a m) eqn:E; [apply less in E|apply not_less in E]; lra. }
  constructor; [lra|]. constructor; auto. eapply Forall_impl; [|exact H2]. cbn. intros; lra.
Qed.

Lemma later a b : (0 < fst (nsub (fst b) (fst a)))%Z -> val (fst a) < val (fst b) /\
  val (slope a b) = (val (snd b) - val (snd a)) / (val (fst b) - val (fst a)).
Proof.
  intros H. unfold slope. rewrite val_div, !val_sub by auto. split; [|reflexivity].
  assert (0 < val (nsub (fst b) (fst a))); [|rewrite val_sub in *; lra].
  unfold val at 1. apply Rmult_lt_0_compat; [now apply (IZR_lt 0)|].
  now apply Rinv_0_lt_compat, IZR_lt.
Qed.
Lemma through_start rest : forall a, rest <> [] -> ascending a rest = true ->
  through a rest (val (fst a)) = val (snd a).
Proof.
  destruct rest as [|b rest]; intros a Hn H; [easy|]. cbn in H. apply andb_prop in H as [H _].
  apply Z.ltb_lt, later in H as [H _]. cbn [through].
  destruct rest; [|destruct (Rle_dec (val (fst a)) (val (fst b))); [|lra]]; ring.
Qed.
Lemma through_slope lo hi rest : forall a s t, rest <> [] -> ascending a rest = true ->
  Forall (fun k => lo <= val k <= hi) (slopes a rest) -> s <= t ->
  lo * (t - s) <= through a rest t - through a rest s <= hi * (t - s).
Proof.
  induction rest as [|b rest IH]; intros a s t Hn Ha Hk Hst; [easy|]. cbn in Ha.
  apply andb_prop in Ha as [H Ha]. apply Z.ltb_lt, later in H as [H Es].
  inversion Hk as [|? ? K Hk']; subst. rewrite Es in K. cbn [through].
  set (k := (val (snd b) - val (snd a)) / (val (fst b) - val (fst a))) in *.
  assert (Line : forall u v, u <= v -> lo * (v - u) <= (val (snd a) + k * (v - val (fst a)))
    - (val (snd a) + k * (u - val (fst a))) <= hi * (v - u)).
  { intros u v Huv.
    assert (E : (val (snd a) + k * (v - val (fst a))) - (val (snd a) + k * (u - val (fst a)))
      = k * (v - u)) by ring.
    rewrite E. split; apply Rmult_le_compat_r; lra. }
  destruct rest as [|c rest]; [now apply Line|].
  assert (End : val (snd a) + k * (val (fst b) - val (fst a)) = val (snd b)).
  { unfold k. field. lra. }
  assert (Ne : c :: rest <> []) by discriminate.
  pose proof (through_start _ b Ne Ha) as St.
  destruct (Rle_dec t (val (fst b))), (Rle_dec s (val (fst b))); try lra.
  - now apply Line.
  - pose proof (Line s (val (fst b)) ltac:(lra)) as A. rewrite End in A.
    pose proof (IH b (val (fst b)) t Ne Ha Hk' ltac:(lra)) as B. rewrite St in B. lra.
  - apply IH; auto.
Qed.
(* Between lo and hi times the distance, upwards. *)
Definition between (lo hi : R) (f : R -> R) (s t : R) : Prop :=
  lo * (t - s) <= f t - f s <= hi * (t - s).
Lemma between_chain lo hi f s u t : between lo hi f s u -> between lo hi f u t -> between lo hi f s t.
Proof. unfold between. lra. Qed.
Lemma inside_slope lo hi a b c d s t : lo <= b - a <= hi -> lo <= c - b <= hi -> lo <= d - c <= hi ->
  0 <= s -> s <= t -> t <= 1 -> between lo hi (cubic a b c d) s t.
Proof.
  intros A B C H0 Hst H1. unfold between.
  set (w0 := (t - s) * ((1 - t) * (1 - t) + (1 - t) * (1 - s) + (1 - s) * (1 - s)) / 6).
  set (w1 := (t - s) * (3 + 3 * (t + s) - 2 * (t * t + t * s + s * s)) / 6).
  set (w2 := (t - s) * (t * t + t * s + s * s) / 6).
  assert (E : cubic a b c d t - cubic a b c d s = (b - a) * w0 + (c - b) * w1 + (d - c) * w2).
  { unfold cubic, w0, w1, w2. field. }
  assert (S : t - s = w0 + w1 + w2) by (unfold w0, w1, w2; field).
  assert (P1 : 0 <= (1 - t) * (1 - s)) by (apply Rmult_le_pos; lra).
  assert (P2 : 0 <= t * s) by (apply Rmult_le_pos; lra).
  assert (P3 : 0 <= (1 - t) * (1 - t)) by (apply Rmult_le_pos; lra).
  assert (P4 : 0 <= (1 - s) * (1 - s)) by (apply Rmult_le_pos; lra).
  assert (P5 : 0 <= t * t) by (apply Rmult_le_pos; lra).
  assert (P6 : 0 <= s * s) by (apply Rmult_le_pos; lra).
  assert (P7 : t * t <= t * 1) by (apply Rmult_le_compat_l; lra).
  assert (P8 : s * s <= s * 1) by (apply Rmult_le_compat_l; lra).
  assert (P9 : t * s <= (t * t + s * s) / 2).
  { pose proof (Rle_0_sqr (t - s)) as Q. unfold Rsqr in Q. lra. }
  assert (W0 : 0 <= w0) by (unfold w0; apply Rmult_le_pos; [apply Rmult_le_pos; lra|lra]).
  assert (W1 : 0 <= w1) by (unfold w1; apply Rmult_le_pos; [apply Rmult_le_pos; lra|lra]).
  assert (W2 : 0 <= w2) by (unfold w2; apply Rmult_le_pos; [apply Rmult_le_pos; lra|lra]).
  rewrite E, S.
  pose proof (Rmult_le_compat_r w0 _ _ W0 (proj1 A)). pose proof (Rmult_le_compat_r w0 _ _ W0 (proj2 A)).
  pose proof (Rmult_le_compat_r w1 _ _ W1 (proj1 B)). pose proof (Rmult_le_compat_r w1 _ _ W1 (proj2 B)).
  pose proof (Rmult_le_compat_r w2 _ _ W2 (proj1 C)). pose proof (Rmult_le_compat_r w2 _ _ W2 (proj2 C)).
  lra.
Qed.
Lemma clip_in p : 0 <= p <= 1 -> Rmax 0 (Rmin 1 p) = p.
Proof. intros H. rewrite Rmin_right, Rmax_right; lra. Qed.
Lemma piece_in a b c d p : 0 <= p <= 1 -> piece a b c d p = cubic a b c d p.
Proof. intros H. unfold piece. cbn zeta. rewrite clip_in by auto. ring. Qed.
Lemma piece_low a b c d p : p <= 0 -> piece a b c d p = cubic a b c d 0 + p * cubic' a b c d 0.
Proof. intros H. unfold piece. cbn zeta. rewrite Rmin_right, Rmax_left by lra. ring. Qed.
Lemma piece_high a b c d p : 1 <= p -> piece a b c d p = cubic a b c d 1 + (p - 1) * cubic' a b c d 1.
Proof. intros H. unfold piece. cbn zeta. rewrite Rmin_left, Rmax_right by lra. ring. Qed.
Lemma piece_slope lo hi a b c d s t : lo <= b - a <= hi -> lo <= c - b <= hi -> lo <= d - c <= hi ->
  s <= t -> between lo hi (piece a b c d) s t.
Proof.
  intros A B C Hst.
  assert (L0 : lo <= cubic' a b c d 0 <= hi) by (unfold cubic'; split; nra).
  assert (L1 : lo <= cubic' a b c d 1 <= hi) by (unfold cubic'; split; nra).
  assert (Low : forall u v, u <= v -> v <= 0 -> between lo hi (piece a b c d) u v).
  { intros u v Huv Hv. unfold between. rewrite !piece_low by lra.
    pose proof (Rmult_le_compat_r (v - u) _ _ ltac:(lra) (proj1 L0)).
    pose proof (Rmult_le_compat_r (v - u) _ _ ltac:(lra) (proj2 L0)). lra. }
  assert (Mid : forall u v, 0 <= u -> u <= v -> v <= 1 -> between lo hi (piece a b c d) u v).
  { intros u v H0 Huv Hv. unfold between. rewrite !piece_in by lra. now apply inside_slope. }
  assert (High : forall u v, 1 <= u -> u <= v -> between lo hi (piece a b c d) u v).
  { intros u v H0 Huv. unfold between. rewrite !piece_high by lra.
    pose proof (Rmult_le_compat_r (v - u) _ _ ltac:(lra) (proj1 L1)).
    pose proof (Rmult_le_compat_r (v - u) _ _ ltac:(lra) (proj2 L1)). lra. }
  assert (Up : forall u, u <= 1 -> u <= t -> 0 <= u -> between lo hi (piece a b c d) u t).
  { intros u H1 Hut H0. destruct (Rle_dec t 1); [now apply Mid|].
    apply between_chain with 1; [apply Mid|apply High]; lra. }
  destruct (Rle_dec t 0); [now apply Low|]. destruct (Rle_dec s 0).
  - apply between_chain with 0; [apply Low|apply Up]; lra.
  - destruct (Rle_dec s 1); [apply Up|apply High]; lra.
Qed.
Fixpoint gaps (a : R) (rest : list R) : list R :=
  match rest with [] => [] | b :: rest' => (b - a) :: gaps b rest' end.
Lemma spline_start a b c d rest : spline (a :: b :: c :: d :: rest) 0 = (a + 4 * b + c) / 6.
Proof.
  cbn [spline]. assert (E : piece a b c d 0 = (a + 4 * b + c) / 6).
  { rewrite piece_in by lra. unfold cubic. field. }
  destruct rest; auto. destruct (Rle_dec 0 1); [auto|lra].
Qed.
Lemma spline_slope lo hi rest : forall a b c d s t,
  Forall (fun k => lo <= k <= hi) (gaps a (b :: c :: d :: rest)) -> s <= t ->
  between lo hi (spline (a :: b :: c :: d :: rest)) s t.
Proof.
  induction rest as [|e rest IH]; intros a b c d s t H Hst;
    pose proof H as H'; inversion H' as [|? ? A Hb]; subst; inversion Hb as [|? ? B Hc]; subst;
    inversion Hc as [|? ? C _]; subst.
  { unfold between. cbn [spline]. now apply piece_slope. }
  assert (One : spline (a :: b :: c :: d :: e :: rest) 1 = (b + 4 * c + d) / 6).
  { cbn [spline]. destruct (Rle_dec 1 1); [|lra]. rewrite piece_in by lra. unfold cubic. field. }
  assert (Low : forall u v, u <= v -> v <= 1 -> between lo hi (spline (a :: b :: c :: d :: e :: rest)) u v).
  { intros u v Huv Hv. unfold between. cbn [spline]. destruct (Rle_dec u 1); [|lra].
    destruct (Rle_dec v 1); [|lra]. now apply piece_slope. }
  assert (High : forall u v, 1 <= u -> u <= v -> between lo hi (spline (a :: b :: c :: d :: e :: rest)) u v).
  { intros u v Hu Huv. pose proof (IH b c d e (u - 1) (v - 1) Hb ltac:(lra)) as I.
    assert (E : forall p, 1 <= p -> spline (a :: b :: c :: d :: e :: rest) p = spline (b :: c :: d :: e :: rest) (p - 1)).
    { intros p Hp. destruct (Req_dec p 1) as [->|N].
      - rewrite One. replace (1 - 1) with 0 by ring. now rewrite spline_start.
      - cbn [spline]. destruct (Rle_dec p 1); [lra|reflexivity]. }
    unfold between in *. rewrite !E by lra. lra. }
  destruct (Rle_dec t 1); [now apply Low|]. destruct (Rle_dec s 1).
  - apply between_chain with 1; [apply Low|apply High]; lra.
  - apply High; lra.
Qed.
Lemma gaps_steps lo hi h rest : (0 < fst h)%Z -> forall a,
  Forall (fun k => lo <= val k <= hi) (steps_of h a rest) ->
  Forall (fun k => lo * val h <= k <= hi * val h) (gaps (val a) (map val rest)).
Proof.
  intros Hh. assert (H : 0 < val h) by (unfold val; apply Rmult_lt_0_compat;
    [now apply (IZR_lt 0)|now apply Rinv_0_lt_compat, IZR_lt]).
  induction rest as [|b rest IH]; intros a F; cbn [gaps map]; constructor;
    inversion F as [|? ? K F']; subst; [|now apply IH].
  rewrite val_div, val_sub in K by auto.
  replace (val b - val a) with ((val b - val a) / val h * val h) by (field; lra).
  split; apply Rmult_le_compat_r; lra.
Qed.
Lemma mapped_between f : map_ok f = true -> forall s t, s <= t ->
  between (val (fst (slope_range f))) (val (snd (slope_range f))) (mapped f) s t.
Proof.
  intros H. unfold slope_range. set (lo := val (fst _)). set (hi := val (snd _)).
  assert (K : Forall (fun k => lo <= val k <= hi) (slopes_of f)).
  { unfold lo, hi. destruct (slopes_of f) as [|a rest]; [constructor|]. cbn [fst snd].
    pose proof (least_of rest a) as A. pose proof (most_of rest a) as B. rewrite Forall_forall in *.
    intros k Hk. split; [apply A|apply B]; exact Hk. }
  clearbody lo hi. destruct f as [[|a [|b rest]]|low h cs]; try discriminate; intros s t Hst.
  - unfold between. cbn [mapped slopes_of] in *. now apply through_slope.
  - unfold map_ok in H. apply andb_prop in H as [H1 H2]. apply Z.ltb_lt in H1. apply Nat.leb_le in H2.
    destruct cs as [|a [|b [|c [|d rest]]]]; cbn in H2; try lia. cbn [slopes_of] in K.
    apply gaps_steps in K; auto. unfold between. cbn [mapped map] in *.
    assert (Hh : 0 < val h) by (unfold val; apply Rmult_lt_0_compat;
      [now apply (IZR_lt 0)|now apply Rinv_0_lt_compat, IZR_lt]).
    assert (Hp : (s - val low) / val h <= (t - val low) / val h).
    { apply Rmult_le_compat_r; [left; now apply Rinv_0_lt_compat|lra]. }
    pose proof (spline_slope _ _ _ _ _ _ _ _ _ K Hp) as [A B].
    replace ((t - val low) / val h - (s - val low) / val h) with ((t - s) / val h) in A, B by (field; lra).
    replace (lo * val h * ((t - s) / val h)) with (lo * (t - s)) in A by (field; lra).
    replace (hi * val h * ((t - s) / val h)) with (hi * (t - s)) in B by (field; lra). lra.
Qed.
Lemma mapped_slope f s t : map_ok f = true -> exists sigma,
  val (fst (slope_range f)) <= sigma <= val (snd (slope_range f)) /\
  mapped f t - mapped f s = sigma * (t - s).
Proof.
  intros H. pose proof (mapped_between f H) as G. set (lo := val (fst _)) in *. set (hi := val (snd _)) in *.
  assert (Go : forall u v, u < v -> exists sigma, lo <= sigma <= hi /\ mapped f v - mapped f u = sigma * (v - u)).
  { intros u v Huv. destruct (G u v (Rlt_le _ _ Huv)) as [A B].
    exists ((mapped f v - mapped f u) / (v - u)). split; [|field; lra].
    split; apply (Rmult_le_reg_r (v - u)); try lra;
      (replace (_ / (v - u) * (v - u)) with (mapped f v - mapped f u) by (field; lra)); lra. }
  destruct (Rtotal_order s t) as [L|[->|L]].
  - now apply Go.
  - destruct (Go t (t + 1) ltac:(lra)) as [k [Hk _]]. exists k. split; auto. ring.
  - destruct (Go t s L) as [k [Hk E]]. exists k. split; auto. lra.
Qed.

(* [I 0] - diag(sigma) into at every corner of the slopes. *)
Fixpoint corners (box : list (num * num)) (us into : matrix) : list matrix :=
  match box, us, into with
  | (lo, hi) :: box', u :: us', a :: into' =>
      flat_map (fun M => [vadd u (vscale (nopp lo) a) :: M; vadd u (vscale (nopp hi) a) :: M])
        (corners box' us' into')
  | _, _, _ => [[]]
  end.
Lemma corners_settled z : forall box sigma us into c q,
  in_box sigma box -> length us = length box -> length into = length box ->
  at_ us z = zip Rmult sigma (at_ into z) ->
  (forall E, In E (corners box us into) -> 0 <= c + dot q (at_ E z)) -> 0 <= c.
Proof.
  induction box as [|[lo hi] box IH]; intros sigma us into c q Hs Lu Li Ez H;
    inversion Hs as [|s ? sigma' ? H0 Hs']; subst; destruct us as [|u us]; try discriminate;
    destruct into as [|a into]; try discriminate.
  { specialize (H [] (or_introl eq_refl)). cbn in H. rewrite dot_nil_r in H. lra. }
  rewrite !at_row in Ez. cbn [zip] in Ez. injection Ez as Eu Ez. cbn [fst snd] in H0.
  destruct q as [|q0 q].
  { assert (Ne : exists E, In E (corners ((lo, hi) :: box) (u :: us) (a :: into))).
    { cbn [corners]. assert (N : exists M, In M (corners box us into)).
      { clear. revert us into. induction box as [|[l h] box IH]; intros [|u us] [|a into];
          try (exists []; now left). destruct (IH us into) as [M HM]. cbn [corners].
        eexists. apply in_flat_map. exists M. split; [exact HM|]. now left. }
      destruct N as [M HM]. eexists. apply in_flat_map. exists M. split; [exact HM|]. now left. }
    destruct Ne as [E HE]. specialize (H E HE). cbn in H. lra. }
  apply (IH sigma' us into c q); auto; try (cbn in *; lia).
  intros M HM.
  assert (A : forall k, k = lo \/ k = hi ->
    0 <= c + (q0 * (dot (map val u) z - val k * dot (map val a) z) + dot q (at_ M z))).
  { intros k Hk. assert (I : In (vadd u (vscale (nopp k) a) :: M) (corners ((lo, hi) :: box) (u :: us) (a :: into))).
    { cbn [corners]. apply in_flat_map. exists M. split; auto. destruct Hk as [->| ->]; cbn; auto. }
    specialize (H _ I). rewrite at_row in H. cbn [dot] in H.
    rewrite dot_vadd, dot_vscale, val_opp in H. lra. }
  pose proof (A lo (or_introl eq_refl)) as A0. pose proof (A hi (or_intror eq_refl)) as A1.
  rewrite Eu in A0, A1. set (g := q0 * dot (map val a) z) in *.
  set (rest := c + dot q (at_ M z)).
  assert (B0 : 0 <= (s - val lo) * g + rest) by (unfold g, rest; lra).
  assert (B1 : 0 <= (s - val hi) * g + rest) by (unfold g, rest; lra).
  fold rest. destruct (Req_dec s (val lo)) as [->|D0]; [lra|].
  assert (P : 0 <= (val hi - s) * ((s - val lo) * g + rest)) by (apply Rmult_le_pos; lra).
  assert (P' : 0 <= (s - val lo) * ((s - val hi) * g + rest)) by (apply Rmult_le_pos; lra).
  apply (Rmult_le_reg_l (val hi - val lo)); lra.
Qed.
