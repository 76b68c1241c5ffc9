(* How far a function of time can move that has a derivative from the right but at a few times, if its derivative
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
  (forall t, a < t < b -> ~ In t ks -> exists l, right_derivative f t l /\ Rabs l < r) ->
  Rabs (f b - f a) < r * (b - a).
Proof.
  induction ks as [|k ks IH]; intros a b Hab C D.
  - assert (S : forall t, a < t < b -> exists l, right_derivative f t l /\ - r < l < r).
    { intros t Ht. destruct (D t Ht) as [l [Hl B]]; [auto|]. exists l. apply Rabs_def2 in B. split; auto; lra. }
    assert (Up : f b - r * b < f a - r * a).
    { apply (falls (fun t => f t - r * t)); auto.
      - intros t Ht. apply continuity_pt_minus; [auto|]. eapply d_continuous, d_line.
      - intros t Ht. destruct (S t Ht) as [l [Hl B]]. exists (l - r). split; [|lra].
        apply r_minus; [exact Hl|apply from_right, d_line]. }
    assert (Down : - f b - r * b < - f a - r * a).
    { apply (falls (fun t => - f t - r * t)); auto.
      - intros t Ht. apply continuity_pt_minus; [now apply continuity_pt_opp, C|]. eapply d_continuous, d_line.
      - intros t Ht. destruct (S t Ht) as [l [Hl B]]. exists (- l - r). split; [|lra].
        apply r_minus; [now apply r_opp|apply from_right, d_line]. }
    apply Rabs_def1; lra.
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

(* The first time at which f is at least y. *)
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
    exists s, right_derivative f t s /\ (free l (f t) -> Rabs s < r)) ->
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
    exists s, right_derivative f t s /\ (free l (f t) -> Rabs s < r)) ->
  0 < r -> Rabs (clip l (f b) - clip l (f a)) < r * (b - a).
Proof.
  intros Hl a b Hab C D Hr. pose proof (clip_up l f ks r Hl a b Hab C D Hr) as U.
  assert (V : clip (flipped l) (- f b) - clip (flipped l) (- f a) < r * (b - a)).
  { apply (clip_up (flipped l) (fun t => - f t) ks r); auto.
    - destruct l as [[p q]|]; cbn in *; auto. rewrite !val_flip. lra.
    - intros t Ht. apply continuity_pt_opp. now apply C.
    - intros t Ht N. destruct (D t Ht N) as [s [Hs B]]. exists (- s). split.
      + now apply r_opp.
      + rewrite Rabs_Ropp. intros Fr. apply B. destruct l as [[p q]|]; cbn in *; auto.
        rewrite !val_flip in Fr. lra. }
  rewrite !clip_flipped in V by auto. unfold Rabs. destruct (Rcase_abs _); lra.
Qed.
