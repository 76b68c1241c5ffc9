(* What is needed of analysis: derivatives from the right, a barrier lemma for them, and what a
   funnel is made of. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Forms Claim.
Import ListNotations.
Open Scope R_scope.

Lemma limit_equal f t l l' : derivable_pt_lim f t l -> l = l' -> derivable_pt_lim f t l'.
Proof. now intros H <-. Qed.
Lemma limit_same f g t l : (forall u, f u = g u) -> derivable_pt_lim f t l ->
  derivable_pt_lim g t l.
Proof.
  intros E H e He. destruct (H e He) as [d Hd]. exists d. intros h. rewrite <- !E. apply Hd.
Qed.
Lemma continuous_same f g t : (forall u, f u = g u) -> continuity_pt f t -> continuity_pt g t.
Proof.
  intros E H e He. destruct (H e He) as [d [Hd1 Hd2]]. exists d. split; auto.
  intros u Hu. rewrite <- !E. now apply Hd2.
Qed.
Lemma d_plus f g t a b : derivable_pt_lim f t a -> derivable_pt_lim g t b ->
  derivable_pt_lim (fun u => f u + g u) t (a + b).
Proof. apply derivable_pt_lim_plus. Qed.
Lemma d_minus f g t a b : derivable_pt_lim f t a -> derivable_pt_lim g t b ->
  derivable_pt_lim (fun u => f u - g u) t (a - b).
Proof. apply derivable_pt_lim_minus. Qed.
Lemma d_mult f g t a b : derivable_pt_lim f t a -> derivable_pt_lim g t b ->
  derivable_pt_lim (fun u => f u * g u) t (a * g t + f t * b).
Proof. apply derivable_pt_lim_mult. Qed.
Lemma d_const c t : derivable_pt_lim (fun _ => c) t 0.
Proof. apply derivable_pt_lim_const. Qed.
Lemma d_id t : derivable_pt_lim (fun u => u) t 1.
Proof. apply derivable_pt_lim_id. Qed.
Ltac derive :=
  match goal with
  | |- derivable_pt_lim (fun _ => ?c) _ _ => apply d_const
  | |- derivable_pt_lim (fun u => u) _ _ => apply d_id
  | |- derivable_pt_lim (fun u => @?f u + @?g u) _ _ => apply (d_plus f g); derive
  | |- derivable_pt_lim (fun u => @?f u - @?g u) _ _ => apply (d_minus f g); derive
  | |- derivable_pt_lim (fun u => @?f u * @?g u) _ _ => apply (d_mult f g); derive
  end.
Lemma d_continuous f t l : derivable_pt_lim f t l -> continuity_pt f t.
Proof. intros H. apply derivable_continuous_pt. now exists l. Qed.

Lemma d_line r t : derivable_pt_lim (fun u => r * u) t r.
Proof. eapply limit_equal; [derive|]. ring. Qed.

(* Derivatives from the right: those of functions that go straight on to the left. *)
Lemma from_right f t l : derivable_pt_lim f t l -> right_derivative f t l.
Proof.
  intros H e He. destruct (H e He) as [d Hd]. exists d. split; [apply cond_pos|].
  intros h Hh. apply Hd; [lra|]. rewrite Rabs_right; lra.
Qed.
Lemma right_equal f t l l' : right_derivative f t l -> l = l' -> right_derivative f t l'.
Proof. now intros H <-. Qed.
Lemma right_near f g t l e : 0 < e -> (forall u, t <= u < t + e -> f u = g u) ->
  right_derivative f t l -> right_derivative g t l.
Proof.
  intros He E H k Hk. destruct (H k Hk) as [d [Hd N]]. exists (Rmin d e).
  split; [now apply Rmin_glb_lt|]. intros h Hh. pose proof (Rmin_l d e). pose proof (Rmin_r d e).
  rewrite <- !E by lra. apply N. lra.
Qed.
Lemma right_same f g t l : (forall u, f u = g u) -> right_derivative f t l -> right_derivative g t l.
Proof. intros E. apply (right_near f g t l 1); [lra|auto]. Qed.
Definition straight (f : R -> R) (t l u : R) : R := if Rlt_dec u t then f t + l * (u - t) else f u.
Lemma straight_after f t l u : t <= u -> straight f t l u = f u.
Proof. intros H. unfold straight. destruct (Rlt_dec u t); auto; lra. Qed.
Lemma d_straight f t l : right_derivative f t l -> derivable_pt_lim (straight f t l) t l.
Proof.
  intros H e He. destruct (H e He) as [d [Hd N]]. exists (mkposreal d Hd). intros h Hh Hhd.
  cbn in Hhd. rewrite (straight_after f t l t) by lra. unfold straight.
  destruct (Rlt_dec (t + h) t) as [L|L].
  - replace ((f t + l * (t + h - t) - f t) / h - l) with 0 by (now field). now rewrite Rabs_R0.
  - apply N. rewrite Rabs_right in Hhd; lra.
Qed.
Lemma r_plus f g t a b : right_derivative f t a -> right_derivative g t b ->
  right_derivative (fun u => f u + g u) t (a + b).
Proof.
  intros Hf Hg. apply (right_near (fun u => straight f t a u + straight g t b u) _ t _ 1); [lra| |].
  - intros u Hu. rewrite !straight_after by lra. reflexivity.
  - apply from_right, d_plus; now apply d_straight.
Qed.
Lemma r_mult f g t a b : right_derivative f t a -> right_derivative g t b ->
  right_derivative (fun u => f u * g u) t (a * g t + f t * b).
Proof.
  intros Hf Hg. apply (right_near (fun u => straight f t a u * straight g t b u) _ t _ 1); [lra| |].
  - intros u Hu. rewrite !straight_after by lra. reflexivity.
  - rewrite <- (straight_after f t a t), <- (straight_after g t b t) by lra.
    apply from_right, d_mult; now apply d_straight.
Qed.
Lemma r_const c t : right_derivative (fun _ => c) t 0.
Proof. apply from_right, d_const. Qed.
Lemma r_opp f t a : right_derivative f t a -> right_derivative (fun u => - f u) t (- a).
Proof.
  intros H. apply (right_same (fun u => (-1) * f u)); [intros u; ring|].
  eapply right_equal; [apply (r_mult (fun _ => -1) f); [apply r_const|exact H]|]. ring.
Qed.
Lemma r_minus f g t a b : right_derivative f t a -> right_derivative g t b ->
  right_derivative (fun u => f u - g u) t (a - b).
Proof. intros Hf Hg. apply (r_plus f (fun u => - g u)); [exact Hf|now apply r_opp]. Qed.

(* The last time at which f is at most y. *)
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
(* A continuous function whose derivative from the right is negative falls. *)
Lemma not_rising (f : R -> R) a b : a < b -> (forall t, a <= t <= b -> continuity_pt f t) ->
  (forall t, a < t < b -> exists l, right_derivative f t l /\ l < 0) -> f b <= f a.
Proof.
  intros Hab C D. apply Rnot_lt_le. intros Rise. set (y := (f a + f b) / 2).
  assert (Hy : f a < y < f b) by (unfold y; lra).
  destruct (last_below f a b y) as [c [Hc [Fc After]]]; auto; try lra.
  assert (Gc : y <= f c).
  { apply Rnot_lt_le. intros L. destruct (C c ltac:(lra) (y - f c) ltac:(lra)) as [d [Hd N]].
    set (h := Rmin (d / 2) (b - c)).
    assert (Hh : 0 < h <= b - c /\ h < d).
    { unfold h. pose proof (Rmin_l (d / 2) (b - c)). split; [split|]; [|apply Rmin_r|lra].
      apply Rmin_glb_lt; lra. }
    pose proof (After (c + h) ltac:(lra)) as A.
    assert (B : R_dist (f (c + h)) (f c) < y - f c).
    { apply N. split; [split; [exact I|lra]|]. cbn. unfold R_dist. rewrite Rabs_right; lra. }
    unfold R_dist in B. apply Rabs_def2 in B. lra. }
  assert (Hac : a < c) by (destruct (Req_dec a c) as [->|]; lra).
  destruct (D c ltac:(lra)) as [l [Hl Neg]]. destruct (Hl (- l) ltac:(lra)) as [d [Hd N]].
  set (h := Rmin (d / 2) (b - c)).
  assert (Hh : 0 < h <= b - c /\ h < d).
  { unfold h. pose proof (Rmin_l (d / 2) (b - c)). split; [split|]; [|apply Rmin_r|lra].
    apply Rmin_glb_lt; lra. }
  pose proof (After (c + h) ltac:(lra)) as A. specialize (N h ltac:(lra)). apply Rabs_def2 in N.
  assert (Q : 0 < (f (c + h) - f c) / h).
  { apply Rmult_lt_0_compat; [lra|]. apply Rinv_0_lt_compat. lra. }
  lra.
Qed.
Lemma falls (f : R -> R) a b : a < b -> (forall t, a <= t <= b -> continuity_pt f t) ->
  (forall t, a < t < b -> exists l, right_derivative f t l /\ l < 0) -> f b < f a.
Proof.
  intros Hab C D. set (m := (a + b) / 2). assert (Hm : a < m < b) by (unfold m; lra).
  destruct (D m Hm) as [l [Hl Neg]]. destruct (Hl (- l) ltac:(lra)) as [d [Hd N]].
  set (h := Rmin (d / 2) ((b - m) / 2)).
  assert (Hh : 0 < h < b - m /\ h < d).
  { unfold h. pose proof (Rmin_l (d / 2) ((b - m) / 2)). pose proof (Rmin_r (d / 2) ((b - m) / 2)).
    split; [split|]; try lra. apply Rmin_glb_lt; lra. }
  specialize (N h ltac:(lra)). apply Rabs_def2 in N.
  assert (Q : (f (m + h) - f m) / h < 0) by lra.
  assert (M : f (m + h) < f m).
  { apply (Rmult_lt_compat_r h) in Q; [|lra]. unfold Rdiv in Q.
    rewrite Rmult_assoc, Rinv_l in Q by lra. lra. }
  pose proof (not_rising f a m ltac:(lra) ltac:(intros; apply C; lra) ltac:(intros; apply D; lra)).
  pose proof (not_rising f (m + h) b ltac:(lra) ltac:(intros; apply C; lra) ltac:(intros; apply D; lra)).
  lra.
Qed.

(* g <= 0 at the start, and g' < M g from the right wherever g > 0: then g <= 0 until the end. *)
Lemma barrier (g M : R -> R) a b :
  (forall t, a <= t <= b -> continuity_pt g t) ->
  (forall t, a <= t <= b -> continuity_pt M t) ->
  (forall t, a < t < b ->
     exists l, right_derivative g t l /\ (0 < g t -> l < M t * g t)) ->
  g a <= 0 -> forall t, a <= t <= b -> g t <= 0.
Proof.
  intros Cg CM Dg Ha t1 Ht1. apply Rnot_lt_le. intros Hpos.
  destruct (continuity_ab_maj M a b ltac:(lra) CM) as [m [Hm _]].
  set (L := M m) in *.
  destruct (last_below g a t1 0) as [c [Hc [Gc Gpos]]]; auto; try lra.
  { intros t Ht. apply Cg. lra. }
  pose (phi := fun t => g t * exp (- L * t)).
  assert (Dexp : forall t, derivable_pt_lim (fun t => exp (- L * t)) t (exp (- L * t) * - L)).
  { intros t. apply (derivable_pt_lim_comp (fun t => - L * t) exp); [apply d_line|].
    apply derivable_pt_lim_exp. }
  assert (F : phi t1 < phi c).
  { apply falls; [lra| |].
    - intros t Ht. apply (continuity_pt_mult g (fun t => exp (- L * t))).
      + apply Cg. lra.
      + eapply d_continuous, Dexp.
    - intros t Ht. destruct (Dg t ltac:(lra)) as [l [Hl Hlt]].
      eexists. split; [exact (r_mult g (fun t => exp (- L * t)) t _ _ Hl (from_right _ _ _ (Dexp t)))|].
      pose proof (Gpos t ltac:(lra)) as Gt. specialize (Hlt Gt).
      pose proof (Hm t ltac:(lra)) as Hle. pose proof (exp_pos (- L * t)) as X.
      assert (l - L * g t < 0) by nra. cbn beta.
      replace (l * exp (- L * t) + g t * (exp (- L * t) * - L))
        with ((l - L * g t) * exp (- L * t)) by ring. nra. }
  assert (0 < phi t1) by (unfold phi; apply Rmult_lt_0_compat; auto; apply exp_pos).
  assert (phi c <= 0) by (unfold phi; pose proof (exp_pos (- L * c)); nra).
  lra.
Qed.

(* Lists of functions of time, with their derivatives from the right. *)
Definition slopes (f : R -> list R) (t : R) (l : list R) : Prop :=
  exists fs, (forall u, f u = at_time fs u) /\ Forall2 (fun f v => right_derivative f t v) fs l.
Definition slopes2 (f : R -> list (list R)) (t : R) (l : list (list R)) : Prop :=
  exists fs, (forall u, f u = map (fun row => at_time row u) fs) /\
    Forall2 (Forall2 (fun f v => right_derivative f t v)) fs l.

Lemma d_dot_list fs : forall t l gs m,
  Forall2 (fun f v => right_derivative f t v) fs l ->
  Forall2 (fun f v => right_derivative f t v) gs m ->
  right_derivative (fun u => dot (at_time fs u) (at_time gs u)) t
    (dot l (at_time gs t) + dot (at_time fs t) m).
Proof.
  induction fs as [|f fs IH]; intros t l gs m Hf Hg;
    inversion Hf as [|? a ? l' Ha Hl]; subst; cbn.
  { eapply right_equal; [apply r_const|ring]. }
  destruct Hg as [|g v gs m Hv Hg]; cbn. { eapply right_equal; [apply r_const|ring]. }
  eapply right_equal.
  { apply (r_plus (fun u => f u * g u) (fun u => dot (at_time fs u) (at_time gs u)));
      [exact (r_mult f g t a v Ha Hv)|exact (IH t l' gs m Hl Hg)]. }
  unfold at_time. ring.
Qed.
Lemma d_dot f g t l m : slopes f t l -> slopes g t m ->
  right_derivative (fun u => dot (f u) (g u)) t (dot l (g t) + dot (f t) m).
Proof.
  intros [fs [Ef Hf]] [gs [Eg Hg]]. rewrite (Ef t), (Eg t).
  eapply right_same; [|apply d_dot_list; eassumption].
  intros u. cbn. now rewrite Ef, Eg.
Qed.
Lemma d_form_list Ms : forall t L fs l gs m,
  Forall2 (Forall2 (fun f v => right_derivative f t v)) Ms L ->
  Forall2 (fun f v => right_derivative f t v) fs l ->
  Forall2 (fun f v => right_derivative f t v) gs m ->
  right_derivative
    (fun u => form (map (fun row => at_time row u) Ms) (at_time fs u) (at_time gs u)) t
    (form L (at_time fs t) (at_time gs t) +
     form (map (fun row => at_time row t) Ms) l (at_time gs t) +
     form (map (fun row => at_time row t) Ms) (at_time fs t) m).
Proof.
  induction Ms as [|row Ms IH]; intros t L fs l gs m HM Hf Hg;
    inversion HM as [|? row' ? L' Hrow HM']; subst; cbn [map form].
  { eapply right_equal; [apply r_const|ring]. }
  destruct Hrow as [|a a' row row' Ha Hrow]; cbn [at_time map form].
  { eapply right_equal; [apply r_const|ring]. }
  destruct Hf as [|f v fs l Hv Hf]; cbn [at_time map form].
  { eapply right_equal; [apply r_const|ring]. }
  destruct Hg as [|g w gs m Hw Hg]; cbn [at_time map form].
  { eapply right_equal; [apply r_const|ring]. }
  pose proof (d_dot_list row t row' gs m Hrow Hg) as D1.
  pose proof (d_dot_list row t row' fs l Hrow Hf) as D2.
  pose proof (IH t L' fs l gs m HM' Hf Hg) as D3.
  pose proof (r_mult _ _ _ _ _ Hv (r_plus _ _ _ _ _ (r_mult _ _ _ _ _ Ha Hw) D1)) as E1.
  pose proof (r_mult _ _ _ _ _ Hw D2) as E2.
  eapply right_equal; [exact (r_plus _ _ _ _ _ (r_plus _ _ _ _ _ E1 E2) D3)|].
  unfold at_time. ring.
Qed.
Lemma d_form M f g t L l m : slopes2 M t L -> slopes f t l -> slopes g t m ->
  right_derivative (fun u => form (M u) (f u) (g u)) t
    (form L (f t) (g t) + form (M t) l (g t) + form (M t) (f t) m).
Proof.
  intros [Ms [EM HM]] [fs [Ef Hf]] [gs [Eg Hg]]. rewrite (EM t), (Ef t), (Eg t).
  eapply right_same; [|apply d_form_list; eassumption].
  intros u. cbn. now rewrite EM, Ef, Eg.
Qed.

(* A curve's derivative is the number of its intervals times the curve of differences. *)
Definition differences (p : list R) : list R := zip (fun b a => b - a) (tl p) p.
Definition curve' (p : list R) (s : R) : R := INR (pred (length p)) * curve (differences p) s.
Lemma d_curve p s : (length p <= 4)%nat -> derivable_pt_lim (curve p) s (curve' p s).
Proof.
  intros H. unfold curve', curve.
  do 5 (try destruct p as [|? p]); cbn in H; try lia;
    cbn [length pred bernstein differences zip tl dot].
  - eapply limit_equal; [apply d_const|cbn; ring].
  - eapply limit_equal; [apply d_const|cbn; ring].
  - eapply limit_equal.
    { derive. }
    cbn; ring.
  - eapply limit_equal.
    { derive. }
    cbn; ring.
  - eapply limit_equal.
    { derive. }
    cbn; ring.
Qed.
