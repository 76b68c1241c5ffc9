(* Networks of maps that are linear between knots: how such a map differs between two points, and
   what is left of the differences at the corners of its slopes. *)
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
Definition slope_range (f : list point) : num * num :=
  match f with
  | a :: b :: rest =>
      (fold_right nmin (slope a b) (slopes b rest), fold_right nmost (slope a b) (slopes b rest))
  | _ => (nzero, nzero)
  end.
Definition map_ok (f : list point) : bool :=
  match f with a :: b :: rest => ascending a (b :: rest) | _ => false end.

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
Lemma mapped_slope f s t : map_ok f = true -> exists sigma,
  val (fst (slope_range f)) <= sigma <= val (snd (slope_range f)) /\
  mapped f t - mapped f s = sigma * (t - s).
Proof.
  destruct f as [|a [|b rest]]; try discriminate. unfold map_ok. intros H.
  cbn [mapped]. set (lo := val (fst (slope_range (a :: b :: rest)))).
  set (hi := val (snd (slope_range (a :: b :: rest)))).
  assert (K : Forall (fun k => lo <= val k <= hi) (slopes a (b :: rest))).
  { cbn [slopes]. pose proof (least_of (slopes b rest) (slope a b)) as A.
    pose proof (most_of (slopes b rest) (slope a b)) as B. rewrite Forall_forall in *.
    intros k Hk. split; [apply A|apply B]; exact Hk. }
  assert (Ne : b :: rest <> []) by discriminate.
  assert (G : forall u v, u < v -> exists sigma, lo <= sigma <= hi /\
    through a (b :: rest) v - through a (b :: rest) u = sigma * (v - u)).
  { intros u v Huv. pose proof (through_slope lo hi _ a u v Ne H K (Rlt_le _ _ Huv)) as [A B].
    exists ((through a (b :: rest) v - through a (b :: rest) u) / (v - u)).
    split; [|field; lra].
    split; apply (Rmult_le_reg_r (v - u)); try lra;
      (replace (_ / (v - u) * (v - u)) with (through a (b :: rest) v - through a (b :: rest) u)
        by (field; lra)); lra. }
  destruct (Rtotal_order s t) as [L|[->|L]].
  - now apply G.
  - inversion K; subst. exists lo. split; [lra|ring].
  - destruct (G t s L) as [k [Hk E]]. exists k. split; auto. lra.
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
