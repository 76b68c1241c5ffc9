(* What is needed of analysis: a barrier lemma, and derivatives and continuity of what a funnel is
   made of. *)
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

(* A derivative that exists can be named: reals are complete. *)
Lemma named_slope f t : (exists l, derivable_pt_lim f t l) -> {l | derivable_pt_lim f t l}.
Proof.
  intros H. destruct (completeness (fun y => exists l, derivable_pt_lim f t l /\ y <= l)) as [m Hm].
  { destruct H as [l Hl]. exists l. intros y [l' [Hl' Hy]].
    now rewrite (uniqueness_limite _ _ _ _ Hl Hl'). }
  { destruct H as [l Hl]. exists l, l. split; auto; lra. }
  exists m. destruct H as [l Hl]. destruct Hm as [H1 H2].
  assert (l <= m) by (apply H1; exists l; split; auto; lra).
  assert (m <= l).
  { apply H2. intros y [l' [Hl' Hy]]. now rewrite (uniqueness_limite _ _ _ _ Hl Hl'). }
  now replace m with l by lra.
Qed.

(* g <= 0 at the start, and g' < M g wherever g > 0: then g <= 0 until the end. *)
Lemma barrier (g M : R -> R) a b :
  (forall t, a <= t <= b -> continuity_pt g t) ->
  (forall t, a <= t <= b -> continuity_pt M t) ->
  (forall t, a < t < b ->
     exists l, derivable_pt_lim g t l /\ (0 < g t -> l < M t * g t)) ->
  g a <= 0 -> forall t, a <= t <= b -> g t <= 0.
Proof.
  intros Cg CM Dg Ha t1 Ht1. apply Rnot_lt_le. intros Hpos.
  destruct (continuity_ab_maj M a b ltac:(lra) CM) as [m [Hm _]].
  set (L := M m) in *.
  pose (E := fun t => a <= t <= t1 /\ g t <= 0).
  destruct (completeness E) as [c [Hub Hlub]].
  { exists t1. intros t [Ht _]. lra. }
  { exists a. split; auto; lra. }
  assert (Hc : a <= c <= t1).
  { split; [apply Hub; split; auto; lra|]. apply Hlub. intros t [Ht _]. lra. }
  assert (Gc : g c <= 0).
  { apply Rnot_lt_le. intros Hc0. destruct (Cg c ltac:(lra) (g c) Hc0) as [d [Hd N]].
    assert (c <= c - d); [|lra]. apply Hlub. intros t [Ht Gt].
    assert (t <= c) by (apply Hub; split; auto).
    apply Rnot_lt_le. intros Hlt.
    destruct (Req_dec t c) as [->|Hne]; [lra|].
    assert (R_dist (g t) (g c) < g c).
    { apply N. split. { split; [exact I|auto]. }
      cbn. unfold R_dist. rewrite Rabs_left; lra. }
    unfold R_dist in H0. rewrite Rabs_left in H0; lra. }
  assert (Hct : c < t1). { destruct (Req_dec c t1) as [->|]; lra. }
  assert (Gpos : forall t, c < t <= t1 -> 0 < g t).
  { intros t Ht. apply Rnot_le_lt. intros Gt. assert (t <= c); [|lra].
    apply Hub. split; auto; lra. }
  pose (phi := fun t => g t * exp (- L * t)).
  assert (Dexp : forall t, derivable_pt_lim (fun t => exp (- L * t)) t (exp (- L * t) * - L)).
  { intros t. apply (derivable_pt_lim_comp (fun t => - L * t) exp).
    - eapply limit_equal; [apply (d_mult (fun _ => - L) (fun t => t)); [apply d_const|apply d_id]|].
      cbn. ring.
    - apply derivable_pt_lim_exp. }
  assert (Dphi : forall t, c < t < t1 -> exists l, derivable_pt_lim phi t l /\ l < 0).
  { intros t Ht. destruct (Dg t ltac:(lra)) as [l [Hl Hlt]].
    eexists. split; [exact (d_mult g (fun t => exp (- L * t)) t _ _ Hl (Dexp t))|].
    pose proof (Gpos t ltac:(lra)) as Gt. specialize (Hlt Gt).
    pose proof (Hm t ltac:(lra)) as Hle. pose proof (exp_pos (- L * t)) as X.
    assert (l - L * g t < 0) by nra. cbn beta.
    replace (l * exp (- L * t) + g t * (exp (- L * t) * - L))
      with ((l - L * g t) * exp (- L * t)) by ring. nra. }
  assert (Cphi : forall t, c <= t <= t1 -> continuity_pt phi t).
  { intros t Ht. apply (continuity_pt_mult g (fun t => exp (- L * t))).
    - apply Cg. lra. - eapply d_continuous, Dexp. }
  assert (Ephi : forall t, c < t < t1 -> exists l, derivable_pt_lim phi t l).
  { intros t Ht. destruct (Dphi t Ht) as [l [H _]]. now exists l. }
  destruct (MVT phi (fun t => t) c t1
    (fun t Ht => named_slope phi t (Ephi t Ht)) (fun t _ => exist _ 1 (d_id t))
    Hct Cphi (fun t _ => d_continuous _ _ _ (d_id t))) as [e [He V]].
  unfold derive_pt in V. cbn [proj1_sig] in V. rewrite Rmult_1_r in V.
  destruct (named_slope phi e (Ephi e He)) as [l Hl]. cbn [proj1_sig] in V.
  destruct (Dphi e He) as [l' [Hl' Neg]]. rewrite (uniqueness_limite _ _ _ _ Hl Hl') in V.
  assert (0 < phi t1) by (unfold phi; apply Rmult_lt_0_compat; auto; apply exp_pos).
  assert (phi c <= 0) by (unfold phi; pose proof (exp_pos (- L * c)); nra).
  nra.
Qed.

(* Lists of functions of time. *)
Definition slopes (f : R -> list R) (t : R) (l : list R) : Prop :=
  exists fs, (forall u, f u = at_time fs u) /\ Forall2 (fun f v => derivable_pt_lim f t v) fs l.
Definition slopes2 (f : R -> list (list R)) (t : R) (l : list (list R)) : Prop :=
  exists fs, (forall u, f u = map (fun row => at_time row u) fs) /\
    Forall2 (Forall2 (fun f v => derivable_pt_lim f t v)) fs l.

Lemma d_dot_list fs : forall t l gs m,
  Forall2 (fun f v => derivable_pt_lim f t v) fs l ->
  Forall2 (fun f v => derivable_pt_lim f t v) gs m ->
  derivable_pt_lim (fun u => dot (at_time fs u) (at_time gs u)) t
    (dot l (at_time gs t) + dot (at_time fs t) m).
Proof.
  induction fs as [|f fs IH]; intros t l gs m Hf Hg;
    inversion Hf as [|? a ? l' Ha Hl]; subst; cbn.
  { eapply limit_equal; [apply d_const|ring]. }
  destruct Hg as [|g v gs m Hv Hg]; cbn. { eapply limit_equal; [apply d_const|ring]. }
  eapply limit_equal.
  { apply (d_plus (fun u => f u * g u) (fun u => dot (at_time fs u) (at_time gs u)));
      [exact (d_mult f g t a v Ha Hv)|exact (IH t l' gs m Hl Hg)]. }
  unfold at_time. ring.
Qed.
Lemma d_dot f g t l m : slopes f t l -> slopes g t m ->
  derivable_pt_lim (fun u => dot (f u) (g u)) t (dot l (g t) + dot (f t) m).
Proof.
  intros [fs [Ef Hf]] [gs [Eg Hg]]. rewrite (Ef t), (Eg t).
  eapply limit_same; [|apply d_dot_list; eassumption].
  intros u. cbn. now rewrite Ef, Eg.
Qed.
Lemma d_form_list Ms : forall t L fs l gs m,
  Forall2 (Forall2 (fun f v => derivable_pt_lim f t v)) Ms L ->
  Forall2 (fun f v => derivable_pt_lim f t v) fs l ->
  Forall2 (fun f v => derivable_pt_lim f t v) gs m ->
  derivable_pt_lim
    (fun u => form (map (fun row => at_time row u) Ms) (at_time fs u) (at_time gs u)) t
    (form L (at_time fs t) (at_time gs t) +
     form (map (fun row => at_time row t) Ms) l (at_time gs t) +
     form (map (fun row => at_time row t) Ms) (at_time fs t) m).
Proof.
  induction Ms as [|row Ms IH]; intros t L fs l gs m HM Hf Hg;
    inversion HM as [|? row' ? L' Hrow HM']; subst; cbn [map form].
  { eapply limit_equal; [apply d_const|ring]. }
  destruct Hrow as [|a a' row row' Ha Hrow]; cbn [at_time map form].
  { eapply limit_equal; [apply d_const|ring]. }
  destruct Hf as [|f v fs l Hv Hf]; cbn [at_time map form].
  { eapply limit_equal; [apply d_const|ring]. }
  destruct Hg as [|g w gs m Hw Hg]; cbn [at_time map form].
  { eapply limit_equal; [apply d_const|ring]. }
  pose proof (d_dot_list row t row' gs m Hrow Hg) as D1.
  pose proof (d_dot_list row t row' fs l Hrow Hf) as D2.
  pose proof (IH t L' fs l gs m HM' Hf Hg) as D3.
  pose proof (d_mult _ _ _ _ _ Hv (d_plus _ _ _ _ _ (d_mult _ _ _ _ _ Ha Hw) D1)) as E1.
  pose proof (d_mult _ _ _ _ _ Hw D2) as E2.
  eapply limit_equal; [exact (d_plus _ _ _ _ _ (d_plus _ _ _ _ _ E1 E2) D3)|].
  unfold at_time. ring.
Qed.
Lemma d_form M f g t L l m : slopes2 M t L -> slopes f t l -> slopes g t m ->
  derivable_pt_lim (fun u => form (M u) (f u) (g u)) t
    (form L (f t) (g t) + form (M t) l (g t) + form (M t) (f t) m).
Proof.
  intros [Ms [EM HM]] [fs [Ef Hf]] [gs [Eg Hg]]. rewrite (EM t), (Ef t), (Eg t).
  eapply limit_same; [|apply d_form_list; eassumption].
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
