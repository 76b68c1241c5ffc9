(* How far a function of time can move that has a derivative but at a few times, if its derivative
   is bounded where a limit does not clip it; and functions that are glued together. *)
From Coq Require Import ZArith Reals List Lra Lia Ranalysis5.
From Verified Require Import Forms Claim Calculus.
Import ListNotations.
Open Scope R_scope.

Lemma continuous_near f g t e : 0 < e -> (forall u, Rabs (u - t) < e -> f u = g u) ->
  continuity_pt f t -> continuity_pt g t.
Proof.
  intros He E H k Hk. destruct (H k Hk) as [d [Hd N]]. exists (Rmin d e). split.
  { now apply Rmin_glb_lt. }
  intros u [Hu Hdist]. cbn in *. unfold R_dist in *.
  assert (A : Rabs (u - t) < d) by (eapply Rlt_le_trans; [exact Hdist|apply Rmin_l]).
  assert (B : Rabs (u - t) < e) by (eapply Rlt_le_trans; [exact Hdist|apply Rmin_r]).
  rewrite <- (E u B), <- (E t) by (rewrite Rminus_diag_eq, Rabs_R0; auto). apply N. split; auto.
Qed.
(* f before b and g from then on *)
Definition glued (b : R) (f g : R -> R) (t : R) : R := if Rlt_dec t b then f t else g t.
Lemma glued_continuous b f g t : continuity_pt f t -> continuity_pt g t -> f b = g b ->
  continuity_pt (glued b f g) t.
Proof.
  intros Cf Cg E. destruct (Rtotal_order t b) as [L|[->|L]].
  - apply (continuous_near f _ t (b - t)); auto; [lra|]. intros u Hu. unfold glued.
    destruct (Rlt_dec u b) as [|N]; auto. apply Rabs_def2 in Hu. lra.
  - intros k Hk. destruct (Cf k Hk) as [d [Hd N]]. destruct (Cg k Hk) as [d' [Hd' N']].
    exists (Rmin d d'). split; [now apply Rmin_glb_lt|]. intros u [Hu Hdist]. cbn in *. unfold R_dist in *.
    assert (A : Rabs (u - b) < d) by (eapply Rlt_le_trans; [exact Hdist|apply Rmin_l]).
    assert (B : Rabs (u - b) < d') by (eapply Rlt_le_trans; [exact Hdist|apply Rmin_r]).
    unfold glued at 2. destruct (Rlt_dec b b) as [|_]; [lra|]. unfold glued.
    destruct (Rlt_dec u b) as [|_]; [rewrite <- E; now apply N|now apply N'].
  - apply (continuous_near g _ t (t - b)); auto; [lra|]. intros u Hu. unfold glued.
    destruct (Rlt_dec u b) as [M|]; auto. apply Rabs_def2 in Hu. lra.
Qed.

(* Between two times, with a bounded slope but at the times of a list. *)
Lemma moves_less (f : R -> R) r ks : forall a b, a < b ->
  (forall t, a <= t <= b -> continuity_pt f t) ->
  (forall t, a < t < b -> ~ In t ks -> exists l, derivable_pt_lim f t l /\ Rabs l < r) ->
  Rabs (f b - f a) < r * (b - a).
Proof.
  induction ks as [|k ks IH]; intros a b Hab C D.
  - assert (E : forall t, a < t < b -> exists l, derivable_pt_lim f t l).
    { intros t Ht. destruct (D t Ht) as [l [Hl _]]; auto. now exists l. }
    destruct (MVT f (fun t => t) a b (fun t Ht => named_slope f t (E t Ht))
      (fun t _ => exist _ 1 (d_id t)) Hab C (fun t _ => d_continuous _ _ _ (d_id t))) as [e [He V]].
    unfold derive_pt in V. cbn [proj1_sig] in V. rewrite Rmult_1_r in V.
    destruct (named_slope f e (E e He)) as [l Hl]. cbn [proj1_sig] in V.
    destruct (D e He) as [l' [Hl' B]]; [auto|].
    rewrite (uniqueness_limite _ _ _ _ Hl Hl') in V. rewrite <- V, Rabs_mult.
    rewrite (Rabs_right (b - a)) by lra. rewrite Rmult_comm. apply Rmult_lt_compat_r; lra.
  - destruct (Rlt_dec a k) as [A|A]; [destruct (Rlt_dec k b) as [B|B]|].
    + assert (H1 : Rabs (f k - f a) < r * (k - a)).
      { apply IH; auto; [intros; apply C; lra|]. intros t Ht N. apply D; [lra|].
        intros [->|I]; [lra|auto]. }
      assert (H2 : Rabs (f b - f k) < r * (b - k)).
      { apply IH; auto; [intros; apply C; lra|]. intros t Ht N. apply D; [lra|].
        intros [->|I]; [lra|auto]. }
      replace (f b - f a) with ((f b - f k) + (f k - f a)) by ring.
      eapply Rle_lt_trans; [apply Rabs_triang|]. lra.
    + apply IH; auto. intros t Ht N. apply D; auto. intros [->|I]; [lra|auto].
    + apply IH; auto. intros t Ht N. apply D; auto. intros [->|I]; [lra|auto].
Qed.

(* The last time at which f is at most y, and the first at which it is at least y. *)
Lemma last_below f a b y : a <= b -> (forall t, a <= t <= b -> continuity_pt f t) -> f a <= y ->
  y < f b -> exists c, a <= c < b /\ f c <= y /\ forall t, c < t <= b -> y < f t.
Proof.
  intros Hab C Ha Hb. pose (E := fun t => a <= t <= b /\ f t <= y).
  destruct (completeness E) as [c [Hub Hlub]].
  { exists b. intros t [Ht _]. lra. }
  { exists a. split; auto; lra. }
  assert (Hc : a <= c <= b).
  { split; [apply Hub; split; auto; lra|]. apply Hlub. intros t [Ht _]. lra. }
  assert (Gc : f c <= y).
  { apply Rnot_lt_le. intros Hc0. destruct (C c Hc (f c - y) ltac:(lra)) as [d [Hd N]].
    assert (c <= c - d); [|lra]. apply Hlub. intros t [Ht Gt].
    assert (t <= c) by (apply Hub; split; auto). apply Rnot_lt_le. intros Hlt.
    destruct (Req_dec t c) as [->|Hne]; [lra|].
    assert (X : R_dist (f t) (f c) < f c - y).
    { apply N. split. { split; [exact I|auto]. } cbn. unfold R_dist. rewrite Rabs_left; lra. }
    unfold R_dist in X. rewrite Rabs_left in X; lra. }
  exists c. split; [|split]; auto.
  - split; [lra|]. destruct (Req_dec c b) as [->|]; lra.
  - intros t Ht. apply Rnot_le_lt. intros G. assert (t <= c); [|lra]. apply Hub. split; auto. lra.
Qed.
Lemma turned_continuous f t : continuity_pt f (- t) -> continuity_pt (fun u => - f (- u)) t.
Proof.
  intros H k Hk. destruct (H k Hk) as [d [Hd N]]. exists d. split; auto. intros u [[_ Hu] Hdist].
  cbn in *. unfold R_dist in *. replace (- f (- u) - - f (- t)) with (- (f (- u) - f (- t))) by ring.
  rewrite Rabs_Ropp. apply N. split; [split; [exact I|lra]|].
  replace (- u - - t) with (- (u - t)) by ring. now rewrite Rabs_Ropp.
Qed.
Lemma first_above f a b y : a <= b -> (forall t, a <= t <= b -> continuity_pt f t) -> f a < y ->
  y <= f b -> exists c, a < c <= b /\ y <= f c /\ forall t, a <= t < c -> f t < y.
Proof.
  intros Hab C Ha Hb.
  destruct (last_below (fun u => - f (- u)) (- b) (- a) (- y)) as [c [Hc [Fc L]]]; try lra.
  - intros t Ht. apply turned_continuous, C. lra.
  - rewrite Ropp_involutive. lra.
  - rewrite Ropp_involutive. lra.
  - exists (- c). split; [lra|]. split; [lra|]. intros t Ht. specialize (L (- t) ltac:(lra)).
    rewrite Ropp_involutive in L. lra.
Qed.

(* Not at a limit. *)
Definition free (l : option (num * num)) (u : R) : Prop :=
  match l with None => True | Some (low, high) => val low <= u <= val high end.
Definition apart (l : option (num * num)) : Prop :=
  match l with None => True | Some (low, high) => val low < val high end.
Lemma clip_lipschitz l u v : Rabs (clip l u - clip l v) <= Rabs (u - v).
Proof.
  destruct l as [[a b]|]; cbn [clip]; [|lra]. unfold Rmax, Rmin.
  repeat destruct (Rle_dec _ _); unfold Rabs; repeat destruct (Rcase_abs _); lra.
Qed.
Lemma clip_up l f ks r : apart l -> forall a b, a < b ->
  (forall t, a <= t <= b -> continuity_pt f t) ->
  (forall t, a < t < b -> ~ In t ks ->
    exists s, derivable_pt_lim f t s /\ (free l (f t) -> Rabs s < r)) ->
  0 < r -> clip l (f b) - clip l (f a) < r * (b - a).
Proof.
  intros Hl a b Hab C D Hr. set (p := clip l (f a)). set (q := clip l (f b)).
  destruct (Rle_lt_dec q p) as [|Hpq].
  { pose proof (Rmult_lt_0_compat r (b - a) Hr ltac:(lra)). lra. }
  assert (Free : forall v, p < v < q -> free l v).
  { intros v Hv. unfold p, q in Hv. destruct l as [[low high]|]; cbn in *; auto.
    pose proof (Rmax_l (val low) (Rmin (val high) (f a))).
    pose proof (Rmax_lub (val low) (Rmin (val high) (f b)) (val high) ltac:(lra) (Rmin_l _ _)). lra. }
  assert (Fa : f a <= p).
  { unfold p, q in Hpq |- *. destruct l as [[low high]|]; cbn in *; [|lra].
    destruct (Rle_lt_dec (f a) (val high)) as [H|H].
    - rewrite Rmin_right by lra. apply Rmax_r.
    - exfalso. rewrite (Rmin_left (val high) (f a)) in Hpq by lra.
      rewrite (Rmax_right (val low) (val high)) in Hpq by lra.
      pose proof (Rmax_lub (val low) (Rmin (val high) (f b)) (val high) ltac:(lra) (Rmin_l _ _)). lra. }
  assert (Fb : q <= f b).
  { unfold p, q in Hpq |- *. destruct l as [[low high]|]; cbn in *; [|lra].
    destruct (Rle_lt_dec (val low) (f b)) as [H|H].
    - apply Rmax_lub; auto. apply Rmin_r.
    - exfalso. rewrite (Rmax_left (val low) (Rmin (val high) (f b))) in Hpq.
      + pose proof (Rmax_l (val low) (Rmin (val high) (f a))). lra.
      + eapply Rle_trans; [apply Rmin_r|]. lra. }
  destruct (last_below f a b p) as [c [Hc [Fc Lc]]]; auto; try lra.
  destruct (first_above f c b q) as [e [He [Fe Le]]]; auto; try lra.
  { intros t Ht. apply C. lra. }
  assert (M : Rabs (f e - f c) < r * (e - c)).
  { apply (moves_less f r ks); try lra.
    - intros t Ht. apply C. lra.
    - intros t Ht N. destruct (D t ltac:(lra) N) as [s [Hs B]]. exists s. split; auto.
      apply B, Free. split; [apply Lc; lra|apply Le; lra]. }
  pose proof (Rle_abs (f e - f c)). assert (r * (e - c) <= r * (b - a)).
  { apply Rmult_le_compat_l; lra. } lra.
Qed.
Definition flipped (l : option (num * num)) : option (num * num) :=
  match l with None => None | Some (low, high) => Some (((- fst high)%Z, snd high), ((- fst low)%Z, snd low)) end.
Lemma val_flip a : val ((- fst a)%Z, snd a) = - val a.
Proof. unfold val; cbn [fst snd]. rewrite opp_IZR. field. now apply Rgt_not_eq, IZR_lt. Qed.
Lemma clip_flipped l u : apart l -> clip (flipped l) (- u) = - clip l u.
Proof.
  destruct l as [[a b]|]; cbn [flipped clip apart]; auto. rewrite !val_flip. intros H.
  unfold Rmax, Rmin. repeat destruct (Rle_dec _ _); lra.
Qed.
(* A clipped function moves less than its rate allows where it is free. *)
Lemma clip_moves l f ks r : apart l -> forall a b, a < b ->
  (forall t, a <= t <= b -> continuity_pt f t) ->
  (forall t, a < t < b -> ~ In t ks ->
    exists s, derivable_pt_lim f t s /\ (free l (f t) -> Rabs s < r)) ->
  0 < r -> Rabs (clip l (f b) - clip l (f a)) < r * (b - a).
Proof.
  intros Hl a b Hab C D Hr. pose proof (clip_up l f ks r Hl a b Hab C D Hr) as U.
  assert (V : clip (flipped l) (- f b) - clip (flipped l) (- f a) < r * (b - a)).
  { apply (clip_up (flipped l) (fun t => - f t) ks r); auto.
    - destruct l as [[p q]|]; cbn in *; auto. rewrite !val_flip. lra.
    - intros t Ht. apply continuity_pt_opp. now apply C.
    - intros t Ht N. destruct (D t Ht N) as [s [Hs B]]. exists (- s). split.
      + now apply derivable_pt_lim_opp.
      + rewrite Rabs_Ropp. intros Fr. apply B. destruct l as [[p q]|]; cbn in *; auto.
        rewrite !val_flip in Fr. lra. }
  rewrite !clip_flipped in V by auto. unfold Rabs. destruct (Rcase_abs _); lra.
Qed.
