(* A tube around a policy's plan: the plan is the simulation under its inputs u_k, and the observer's
   input is u_k - kappa K (z - x) with its own kappa in [0, 1] at each sample. *)
From Coq Require Import ZArith Reals List Lra Lia Psatz.
From Verified Require Import Integers Forms Claim Definite Goal Funnel Tubes Increments Boxes Near.
Import ListNotations.
Open Scope R_scope.

Lemma dot_mix a : forall b c k, length b = length c ->
  dot a (zip (fun p q => (1 - k) * p + k * q) b c) = (1 - k) * dot a b + k * dot a c.
Proof.
  induction a as [|x a IH]; intros [|y b] [|z c] k H; try discriminate; cbn; try ring.
  rewrite IH by (now injection H). ring.
Qed.
Notation mix k := (zip (fun p q => (1 - k) * p + k * q)).
Lemma at_mix M : forall b c k, length b = length c ->
  at_ M (mix k b c) = mix k (at_ M b) (at_ M c).
Proof.
  intros b c k H. induction M as [|row M IH]; [reflexivity|]. rewrite !at_row, IH, dot_mix by auto.
  reflexivity.
Qed.
Lemma dot_mix_left a : forall b c k, length a = length b ->
  dot (mix k a b) c = (1 - k) * dot a c + k * dot b c.
Proof.
  induction a as [|x a IH]; intros [|y b] [|z c] k H; try discriminate; cbn; try ring.
  rewrite IH by (now injection H). ring.
Qed.
(* V is convex where it is nonnegative. *)
Lemma V_mix P a b k : length a = length b -> (forall c, length c = length a -> 0 <= V P c) -> 0 <= k <= 1 ->
  V P (mix k a b) <= (1 - k) * V P a + k * V P b.
Proof.
  intros H HP Hk. specialize (HP (minus a b) (minus_length a b H)). unfold V in *. fold (vals P) in *.
  fold (at_ P (mix k a b)) (at_ P a) (at_ P b) in *. fold (at_ P (minus a b)) in HP.
  rewrite at_minus, dot_minus in HP by (rewrite ?at_length; auto).
  rewrite at_mix by auto. rewrite dot_mix by now rewrite !at_length.
  rewrite !dot_mix_left by auto.
  assert (D : forall c, dot (minus a b) c = dot a c - dot b c).
  { clear - H. revert b H. unfold minus. induction a as [|x a IH]; intros [|y b] H [|z c];
      try discriminate; cbn; try ring. rewrite IH by (now injection H). ring. }
  rewrite !D in HP.
  assert (0 <= k * (1 - k)) by (apply Rmult_le_pos; lra).
  pose proof (Rmult_le_pos _ _ H0 HP). nra.
Qed.

Section Driven.
Context {K : Ints}.

Definition from_input (b0 : num) (a b : list num) : list num :=
  zip (fun v c => nadd v (nmul c b0)) b a.
Definition engaged (F : matrix) (B feedback : list num) : matrix :=
  zip (fun row v => vadd row (vscale (nopp v) feedback)) F B.
Definition mode_ok (n : nat) (t : tube) (F : matrix) (h : list num) : bool :=
  let base := supply O n (fading t) (storage t) (weight t) in
  andb (andb (shaped n n F) (Nat.eqb (length h) n))
    (andb (semidefinite true (triangle (base ++ flow F (gain t) (storage t))))
      (semidefinite true (triangle (base ++ output h [none] (hd nzero (tau t)))))).
Definition plan_ok (a b : list num) (b0 : num) (feedback : list num) (t : tube) : bool :=
  let n := length a in
  let F := moves (Linear a) in
  let h := none :: repeat nzero (pred n) in
  andb (andb (andb (model_ok (Linear a)) (Nat.eqb (length b) n))
      (andb (mode_ok n t F h)
        (mode_ok n t (engaged F (from_input b0 a b) feedback) (vadd h (vscale (nopp b0) feedback)))))
    (andb (andb (definite n (storage t)) (definite 1 (weight t)))
      (andb (andb (Nat.eqb (length (gain t)) n) (wide_enough t (hd nzero (tau t)) (hd nzero (widths t))))
        (andb (andb (0 <? fst (fading t))%Z (negb (num_ltb none (fading t)))) (0 <=? fst (inlet t))%Z))).

Lemma mode_sound n t F h x e : mode_ok n t F h = true -> length x = n -> length e = 1%nat ->
  shaped n n (storage t) = true -> shaped 1 1 (weight t) = true -> length (gain t) = n ->
  V (storage t) (plus (at_ F x) (at_ (gain t) e)) <= val (fading t) * V (storage t) x + V (weight t) e /\
  val (hd nzero (tau t)) * (dot (map val h) x + hd 0 e) ^ 2
    <= val (fading t) * V (storage t) x + V (weight t) e.
Proof.
  unfold mode_ok. intros H Hx He HP HW HL. apply andb_prop in H as [H1 H2].
  apply andb_prop in H1 as [HF Hh]. apply Nat.eqb_eq in Hh. apply andb_prop in H2 as [H2 H3].
  pose proof (semidefinite_sound _ _ (x ++ e) H2) as Q2.
  pose proof (semidefinite_sound _ _ (x ++ e) H3) as Q3.
  rewrite form_triangle, total_app in Q2, Q3.
  rewrite (total_flow _ _ _ _ _ n n) in Q2 by auto.
  rewrite total_output in Q3 by congruence.
  pose proof (total_supply [] x e (fading t) (storage t) (weight t)) as T. rewrite Hx, He in T.
  specialize (T HP HW). cbn [length app] in T. rewrite T in Q2, Q3. split; [lra|].
  destruct e as [|e0 [|]]; try discriminate. cbn [map dot hd] in *. rewrite val_none in Q3. nra.
Qed.

Lemma driven_next a b b0 u delta y0 s : length b = length a -> length s = length a ->
  plus (plus (map (fun c => val c * (y0 + val b0 * delta)) a) s) (map (fun v => val v * (u + delta)) b)
  = plus (plus (plus (map (fun c => val c * y0) a) s) (map (fun v => val v * u) b))
      (map (fun v => val v * delta) (from_input b0 a b)).
Proof.
  unfold plus, from_input. revert b s. induction a as [|a0 a IH]; intros [|v b] [|s0 s] H1 H2;
    try discriminate; [reflexivity|]. cbn [map zip]. rewrite IH by (cbn in *; lia). f_equal.
  rewrite val_add, val_mul. ring.
Qed.
Lemma engaged_at feedback x : forall F B, length F = length B ->
  at_ (engaged F B feedback) x
  = plus (at_ F x) (map (fun v => val v * - dot (map val feedback) x) B).
Proof.
  induction F as [|row F IH]; intros [|v B] H; try discriminate; [reflexivity|].
  change (dot (map val (vadd row (vscale (nopp v) feedback))) x :: at_ (engaged F B feedback) x
    = dot (map val row) x + val v * - dot (map val feedback) x
        :: plus (at_ F x) (map (fun v => val v * - dot (map val feedback) x) B)).
  rewrite IH by (now injection H). f_equal. rewrite dot_vadd, dot_vscale, val_opp. ring.
Qed.

Lemma mix_plus k w : forall f B l, length f = length B -> length l = length f ->
  mix k (plus f l) (plus (plus f (map (fun v => val v * w) B)) l)
  = plus (plus f (map (fun v => val v * (k * w)) B)) l.
Proof.
  unfold plus. induction f as [|f0 f IH]; intros [|v B] [|l0 l] H1 H2; try discriminate; [reflexivity|].
  cbn [map zip]. rewrite IH by (cbn in *; lia). f_equal. ring.
Qed.

Theorem plan_proved a b b0 c feedback t : plan_ok a b b0 feedback t = true ->
  stays_near_plan a b b0 c feedback t.
Proof.
  unfold plan_ok. set (n := length a). set (F := moves (Linear a)).
  set (h := none :: repeat nzero (pred n)). set (B := from_input b0 a b).
  assert (En : n = length a) by reflexivity.
  intros H. apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [H0 Hmodes].
  apply andb_prop in H0 as [Hm Hb]. apply Nat.eqb_eq in Hb.
  apply andb_prop in Hmodes as [M0 M1]. apply andb_prop in H2 as [H2 H3].
  apply andb_prop in H2 as [HPd HWd]. apply andb_prop in H3 as [H3 H4].
  apply andb_prop in H3 as [HL Hwide]. apply Nat.eqb_eq in HL.
  apply andb_prop in H4 as [H4 Hin]. apply andb_prop in H4 as [Hr0 Hr1].
  apply Z.ltb_lt, val_positive in Hr0. apply Bool.negb_true_iff, num_le in Hr1.
  rewrite val_none in Hr1. apply Z.leb_le, val_nonneg in Hin.
  pose proof (definite_shaped _ _ HPd) as HP. pose proof (definite_shaped _ _ HWd) as HW.
  assert (PP : forall c, length c = n -> 0 <= V (storage t) c).
  { intros v Hv. apply andb_prop in HPd as [_ S]. apply (semidefinite_sound _ _ v) in S.
    rewrite form_triangle in S. rewrite <- Hv in HP.
    pose proof (total_block [] v [] (1%Z, 2%positive) (storage t) HP) as T.
    cbn [length app] in T. rewrite app_nil_r in T. rewrite T in S.
    unfold val in S at 1. cbn in S. lra. }
  intros u kappa x y z e measured Hk Sx Sz H0 k HE.
  set (bar := fun i => minus (z i) (x i)).
  assert (Step : forall i, length (bar i) = n /\ length (e i) = 1%nat /\
    bar (S i) = mix (kappa i) (plus (at_ F (bar i)) (at_ (gain t) (e i)))
      (plus (at_ (engaged F B feedback) (bar i)) (at_ (gain t) (e i))) /\
    hd 0 (measured i) - hd 0 (y i) = (1 - kappa i) * (dot (map val h) (bar i) + hd 0 (e i))
      + kappa i * (dot (map val (vadd h (vscale (nopp b0) feedback))) (bar i) + hd 0 (e i))).
  { intros i. destruct (Sz i) as [z' [q [St [Ez [Em Le]]]]]. specialize (Sx i).
    set (delta := - kappa i * dot (map val feedback) (bar i)).
    set (u0 := u i) in *. set (xi := x i) in *. set (zi := z i) in *.
    replace (u0 - kappa i * dot (map val feedback) (minus zi xi)) with (u0 + delta) in St
      by (unfold delta, bar; fold xi zi; ring).
    set (y0 := hd 0 zi + (val b0 * u0 + val c)).
    set (zn := plus (plus (map (fun v => val v * y0) a) (tl zi ++ [0])) (map (fun v => val v * u0) b)).
    pose proof St as St'. cbn [step] in St'. destruct St' as [_ [Lz [_ [Eq Ez']]]].
    assert (S0 : step (Linear a) [val b0 * u0 + val c] (map (fun v => val v * u0) b) zi [] [] zn [y0]).
    { cbn [step]. repeat split; auto. now rewrite map_length. }
    pose proof (next_state (Linear a) _ _ [] xi [] _ _ zi [] zn [y0] Hm Sx S0) as N.
    change (difference [] [] zi xi) with (bar i) in N. fold F in N.
    pose proof Sx as Sx'. cbn [step] in Sx'. destruct Sx' as [_ [Lx [_ [Ey Ex']]]].
    assert (Hn : (0 < n)%nat).
    { unfold model_ok in Hm. apply andb_prop in Hm as [A _]. apply andb_prop in A as [A _].
      now apply Nat.ltb_lt in A. }
    destruct xi as [|x0 xs] eqn:Exi; [cbn in Lx; unfold n in Hn; lia|].
    destruct zi as [|z0 zs] eqn:Ezi; [cbn in Lz; unfold n in Hn; lia|].
    cbn [hd tl] in *. rewrite Eq in Le, Em. cbn [length] in Le.
    assert (Lbar : length (bar i) = n).
    { unfold bar. fold xi zi. rewrite Exi, Ezi, minus_length; congruence. }
    assert (LF : length (at_ F (bar i)) = n).
    { rewrite at_length. unfold model_ok in Hm. apply andb_prop in Hm as [A _].
      apply andb_prop in A as [_ A]. now apply shaped_is in A as [A _]. }
    assert (LB : length B = n).
    { unfold B, from_input. rewrite zip_length; auto. }
    assert (Ls : length (zs ++ [0]) = length a) by (rewrite app_length; cbn in *; lia).
    assert (Ezn : z' = plus zn (map (fun v => val v * delta) B)).
    { rewrite Ez', Eq. cbn [hd]. unfold zn, B. rewrite <- driven_next by auto.
      replace (z0 + (val b0 * (u0 + delta) + val c)) with (y0 + val b0 * delta); auto.
      unfold y0. ring. }
    assert (Lzn : length zn = n).
    { unfold zn, plus. rewrite zip_length; rewrite zip_length; rewrite ?map_length; auto. }
    assert (Lx' : length (x (S i)) = n).
    { rewrite Ex'. unfold plus. rewrite zip_length; rewrite zip_length; rewrite ?map_length; auto;
        rewrite app_length; cbn in *; lia. }
    split; [exact Lbar|]. split; [exact Le|]. split.
    - unfold bar at 1. rewrite Ez, Ezn.
      change (image (map (map val) (gain t)) (e i)) with (at_ (gain t) (e i)).
      assert (LD : length (map (fun v => val v * delta) B) = n) by now rewrite map_length.
      rewrite minus_plus_left.
      2:{ unfold plus. rewrite zip_length; congruence. }
      2:{ unfold plus. rewrite zip_length, at_length; congruence. }
      rewrite minus_plus_left by congruence. rewrite N.
      rewrite engaged_at.
      2:{ rewrite at_length in LF. congruence. }
      rewrite mix_plus by (rewrite ?at_length in *; congruence).
      f_equal. f_equal. apply map_ext. intros v. unfold delta. ring.
    - rewrite Em, Ey. destruct (e i) as [|e0 [|]]; try discriminate. unfold plus. cbn [zip hd].
      rewrite dot_vadd, dot_vscale, val_opp.
      assert (Dh : dot (map val h) (bar i) = z0 - x0).
      { unfold bar. fold xi zi. rewrite Exi, Ezi. unfold h.
        change (minus (z0 :: zs) (x0 :: xs)) with (z0 - x0 :: minus zs xs).
        cbn [map dot]. rewrite dot_zeros, val_none. ring. }
      rewrite Dh. unfold delta. ring. }
  set (rho := val (fading t)) in *.
  assert (Both : forall i, V (storage t) (bar (S i)) <= rho * V (storage t) (bar i) + V (weight t) (e i) /\
    val (hd nzero (tau t)) * (hd 0 (measured i) - hd 0 (y i)) ^ 2
      <= rho * V (storage t) (bar i) + V (weight t) (e i)).
  { intros i. destruct (Step i) as [Lb [Le [Eb Eo]]].
    destruct (mode_sound n t F h (bar i) (e i) M0 Lb Le HP HW HL) as [A0 B0].
    destruct (mode_sound n t _ _ (bar i) (e i) M1 Lb Le HP HW HL) as [A1 B1].
    fold rho in A0, B0, A1, B1. specialize (Hk i). split.
    - rewrite Eb.
      assert (LF : length F = n).
      { unfold mode_ok in M0. apply andb_prop in M0 as [M0 _]. apply andb_prop in M0 as [M0 _].
        now apply shaped_is in M0 as [M0 _]. }
      assert (LE : length (engaged F B feedback) = n).
      { unfold mode_ok in M1. apply andb_prop in M1 as [M1 _]. apply andb_prop in M1 as [M1 _].
        now apply shaped_is in M1 as [M1 _]. }
      assert (L0 : length (plus (at_ F (bar i)) (at_ (gain t) (e i))) = n).
      { unfold plus. rewrite zip_length; rewrite !at_length; congruence. }
      assert (L1 : length (plus (at_ (engaged F B feedback) (bar i)) (at_ (gain t) (e i))) = n).
      { unfold plus. rewrite zip_length; rewrite !at_length; congruence. }
      pose proof (V_mix (storage t) _ _ (kappa i) (eq_trans L0 (eq_sym L1))
        (fun c Hc => PP c (eq_trans Hc L0)) Hk) as Vm.
      assert (K0 : 0 <= 1 - kappa i) by lra.
      pose proof (Rmult_le_compat_l _ _ _ K0 A0). pose proof (Rmult_le_compat_l _ _ _ (proj1 Hk) A1).
      lra.
    - rewrite Eo. set (o0 := dot (map val h) (bar i) + hd 0 (e i)) in *.
      set (o1 := dot (map val (vadd h (vscale (nopp b0) feedback))) (bar i) + hd 0 (e i)) in *.
      set (s := rho * V (storage t) (bar i) + V (weight t) (e i)) in *.
      unfold wide_enough in Hwide. apply andb_prop in Hwide as [W _]. apply andb_prop in W as [W _].
      apply Z.ltb_lt, val_positive in W. set (ta := val (hd nzero (tau t))) in *.
      assert (Q : 0 <= ta * ((kappa i * (1 - kappa i)) * (o0 - o1) ^ 2)).
      { apply Rmult_le_pos; [lra|]. apply Rmult_le_pos; [|apply pow2_ge_0].
        apply Rmult_le_pos; lra. }
      assert (C0 : (1 - kappa i) * (ta * o0 ^ 2) <= (1 - kappa i) * s).
      { apply Rmult_le_compat_l; [lra|exact B0]. }
      assert (C1 : kappa i * (ta * o1 ^ 2) <= kappa i * s).
      { apply Rmult_le_compat_l; [lra|exact B1]. }
      replace (ta * ((1 - kappa i) * o0 + kappa i * o1) ^ 2) with
        ((1 - kappa i) * (ta * o0 ^ 2) + kappa i * (ta * o1 ^ 2)
          - ta * ((kappa i * (1 - kappa i)) * (o0 - o1) ^ 2)) by ring.
      apply (Rle_trans _ ((1 - kappa i) * s + kappa i * s)); [lra|]. right. ring. }
  assert (Hs : forall i, V (storage t) (bar i) <= rho ^ i * val (inlet t) + energy t e i).
  { induction i as [|i IH]; [cbn [pow energy]; unfold bar; lra|]. destruct (Both i) as [A _].
    cbn [energy pow]. fold rho.
    pose proof (Rmult_le_compat_l rho _ _ (Rlt_le _ _ Hr0) IH). lra. }
  destruct (Both k) as [_ Out]. specialize (Hs k). cbn [energy] in HE. fold rho in HE.
  unfold wide_enough in Hwide. apply andb_prop in Hwide as [W C]. apply andb_prop in W as [W1 W2].
  apply Z.ltb_lt, val_positive in W1. apply Z.ltb_lt, val_positive in W2.
  apply Bool.negb_true_iff, num_le in C. rewrite val_add, !val_mul in C. fold rho in C.
  set (ta := val (hd nzero (tau t))) in *. set (wd := val (hd nzero (widths t))) in *.
  set (o := hd 0 (measured k) - hd 0 (y k)) in *.
  assert (Pow : 0 <= rho ^ k <= 1).
  { clear - Hr0 Hr1. induction k as [|k IH]; cbn; [lra|]. split; [apply Rmult_le_pos; lra|].
    pose proof (Rmult_le_compat rho 1 (rho ^ k) 1 ltac:(lra) ltac:(lra) Hr1 ltac:(lra)). lra. }
  assert (I : rho ^ k * val (inlet t) <= val (inlet t)).
  { pose proof (Rmult_le_compat_r (val (inlet t)) _ _ Hin (proj2 Pow)). lra. }
  pose proof (Rmult_le_compat_l rho _ _ (Rlt_le _ _ Hr0) Hs) as A.
  pose proof (Rmult_le_compat_l rho _ _ (Rlt_le _ _ Hr0) I) as A'.
  assert (O : o ^ 2 <= wd * wd) by (apply (Rmult_le_reg_l ta); auto; lra).
  assert (Near : Rabs o <= wd); [|exact Near].
  rewrite <- (Rabs_right wd) by lra. apply Rsqr_le_abs_0. unfold Rsqr. lra.
Qed.
Theorem plans_proved a b b0 c feedback ts : forallb (plan_ok a b b0 feedback) ts = true ->
  Forall (stays_near_plan a b b0 c feedback) ts.
Proof.
  intros H. rewrite forallb_forall in H. apply Forall_forall. intros t Ht. apply plan_proved. auto.
Qed.
End Driven.
