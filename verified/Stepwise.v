(* Why every motion that starts in a sampled funnel stays in it: by induction over the samples. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Positive Claim Condition Definite Funnel
  Goal Valid Tubes Increments Near Samples Words Curvature Steps.
Import ListNotations.
Open Scope R_scope.

Lemma nonneg_val a : nonneg a = true -> 0 <= val a.
Proof.
  unfold nonneg, val. intros H. apply Z.leb_le in H. apply Rmult_le_pos; [now apply (IZR_le 0)|].
  left. now apply Rinv_0_lt_compat, IZR_lt.
Qed.
Lemma positive_val a : positive a = true -> 0 < val a.
Proof. intros H. apply val_positive. now apply Z.ltb_lt. Qed.
Lemma plus_length a b : length a = length b -> length (plus a b) = length a.
Proof. apply zip_length. Qed.
Lemma at_plus M a b : length a = length b -> at_ M (plus a b) = plus (at_ M a) (at_ M b).
Proof.
  intros H. induction M as [|row M IH]; [reflexivity|].
  change (at_ (row :: M) ?z) with (dot (map val row) z :: at_ M z). rewrite IH.
  unfold plus at 1. rewrite dot_plus by auto. reflexivity.
Qed.
Lemma at_products A B z : at_ (nproducts A B) z = at_ A (at_ B z).
Proof.
  unfold nproducts, at_ at 1 2, image, vals. rewrite !map_map. apply map_ext. intros row.
  apply dot_combination.
Qed.
Lemma total_self c M z : total (map (fun row => (vscale c row, row)) M) z = val c * dot (at_ M z) (at_ M z).
Proof.
  induction M as [|row M IH]; [cbn; ring|].
  change (at_ (row :: M) z) with (dot (map val row) z :: at_ M z).
  cbn [map total dot]. rewrite IH, dot_vscale. ring.
Qed.
Lemma npow_val a k : val (npow a k) = val a ^ k.
Proof. induction k as [|k IH]; cbn [npow pow]; [apply val_none|]. now rewrite val_mul, IH. Qed.
Lemma nspread_val m t q : val (nspread m t q) = spread m (val t) (val q).
Proof.
  induction m as [|m IH]; cbn [nspread spread]; [apply val_nzero|].
  now rewrite val_add, val_mul, npow_val, IH.
Qed.
Lemma nstretch_val gammas far near : forall m,
  val (nstretch m gammas far near) = stretch m gammas (val far) (val near).
Proof.
  induction gammas as [|g gammas IH]; intros m; cbn [nstretch stretch]; [apply val_nzero|].
  now rewrite val_add, val_mul, nspread_val, IH.
Qed.

(* T z = x has a solution *)
Lemma dot_zeros_first i : forall row pre z, length pre = i ->
  forallb (fun a : num => Z.eqb (fst a) 0) (firstn i row) = true -> (i <= length row)%nat ->
  dot (map val row) (pre ++ z) = dot (map val (skipn i row)) z.
Proof.
  induction i as [|i IH]; intros row [|q pre] z L H Hr; try discriminate; [reflexivity|].
  destruct row as [|a row]; [cbn in Hr; lia|]. cbn in H. apply andb_prop in H as [A B].
  cbn [app map dot skipn]. rewrite IH; auto; [|cbn in Hr; lia].
  apply Z.eqb_eq in A. unfold val at 1. rewrite A. unfold Rdiv. ring.
Qed.
Lemma echelon_onto n M : forall i, echelon i M = true -> (i + length M = n)%nat ->
  (forall row, In row M -> length row = n) -> forall x, length x = length M ->
  exists z, length z = length M /\ forall pre, length pre = i -> at_ M (pre ++ z) = x.
Proof.
  induction M as [|row M IH]; intros i H Hn Hr x Hx.
  { exists []. destruct x; [|discriminate]. split; auto. }
  destruct x as [|x0 x]; [discriminate|]. cbn in H. apply andb_prop in H as [H1 H2].
  apply andb_prop in H1 as [H0 H1]. cbn [length] in *.
  destruct (IH (S i) H2 ltac:(lia) (fun r Hin => Hr r (or_intror Hin)) x ltac:(lia)) as [z [Lz Hz]].
  pose proof (Hr row (or_introl eq_refl)) as Lr.
  set (a := val (nth i row nzero)).
  assert (Ha : a <> 0).
  { unfold a, val. intros C. apply Bool.negb_true_iff, Z.eqb_neq in H1. apply H1.
    apply Rmult_integral in C as [C|C]; [now apply eq_IZR in C|].
    exfalso. apply (Rinv_neq_0_compat (IZR (Zpos (snd (nth i row nzero))))); [|exact C].
    apply Rgt_not_eq. now apply IZR_lt. }
  set (z0 := (x0 - dot (map val (skipn (S i) row)) z) / a).
  exists (z0 :: z). split; [cbn [length]; congruence|]. intros pre Lp.
  change (at_ (row :: M) ?v) with (dot (map val row) v :: at_ M v). f_equal.
  - rewrite (dot_zeros_first i) by (auto; lia).
    assert (E : skipn i row = nth i row nzero :: skipn (S i) row).
    { assert (Hi : (i < length row)%nat) by lia. clear - Hi. revert i Hi.
      induction row as [|b row IH]; intros [|i] Hi; cbn [length skipn nth] in *; try lia; [reflexivity|].
      apply IH. lia. }
    rewrite E. cbn [map dot]. fold a. unfold z0. field. exact Ha.
  - replace (pre ++ z0 :: z) with ((pre ++ [z0]) ++ z) by now rewrite <- app_assoc.
    apply Hz. rewrite app_length. cbn. lia.
Qed.

Section Stepwise.
Context {K : Ints}.
Notation means z := (Polynomials.means 0 (env z)).

Lemma means_flinear M z zs v : Forall2 (means z) zs v -> Forall2 (means z) (flinear M zs) (at_ M v).
Proof.
  intros H. unfold flinear, at_, image, vals. rewrite map_map. apply Forall2_map2. intros row.
  apply means_fdot; auto. apply Forall2_map2. intros a. apply means_fnum.
Qed.
Lemma means_nums z l : Forall2 (means z) (map fnum l) (map val l).
Proof. apply Forall2_map2. intros a. apply means_fnum. Qed.
Lemma means_minus z a b v w : Forall2 (means z) a v -> Forall2 (means z) b w ->
  Forall2 (means z) (zip fsub a b) (minus v w).
Proof. apply (Forall2_zip (means z) (means z)). intros. now apply means_sub. Qed.

Variables (m : map_file) (p : track_file) (s : sampled_file) (w : links).
Notation n := (order m).
Definition fbar (k : nat) (xi : list R) : list R :=
  minus (maps_to m (plus (row k (states p)) xi) (minus (row k (inputs p)) (times k (feedback p) xi)))
    (row (S k) (states p)).

Lemma means_fmoved k z xi v : Forall2 (means z) xi v -> Forall2 (means z) (fmoved m p k xi) (fbar k v).
Proof.
  intros H. unfold fmoved, fbar. apply means_minus; [|apply means_nums].
  unfold maps_to. apply Forall2_map2. intros e. apply means_frate, means_ftable. apply Forall2_app.
  - unfold plus. apply (Forall2_zip (means z) (means z)); [|apply means_nums|exact H].
    intros. now apply means_add.
  - apply means_minus; [apply means_nums|]. now apply means_flinear.
Qed.

Hypothesis accepted : sampled_ok m p s w = true.

Lemma parts : sizes_ok m p s w = true /\ form_ok s = true /\
  (forall k, (k <= steps p)%nat -> sample_ok m p s k = true) /\
  forall k, (k < steps p)%nat -> exists l,
    link_ok m p s (basis w) (ball_basis w) (products (basis w)) k l = true.
Proof.
  unfold sampled_ok in accepted. apply andb_prop in accepted as [H1 H2].
  apply andb_prop in H1 as [S1 S2]. apply andb_prop in H2 as [H2 H3].
  rewrite forallb_forall in H2, H3. repeat split; auto.
  - intros k Hk. apply H2, in_seq. lia.
  - intros k Hk. assert (L : length (linked w) = steps p).
    { unfold sizes_ok in S1. apply andb_prop in S1 as [_ S1]. apply andb_prop in S1 as [_ S1].
      apply andb_prop in S1 as [_ S1]. apply andb_prop in S1 as [_ S1]. now apply Nat.eqb_eq in S1. }
    assert (G : forall N a (l : list link), length l = N -> (a <= k < a + N)%nat ->
      exists x, In (k, x) (combine (seq a N) l)).
    { clear. induction N as [|N IH]; intros a [|x l] L H; try discriminate; try lia.
      destruct (Nat.eq_dec a k) as [->|D]; [exists x; now left|].
      destruct (IH (S a) l ltac:(now injection L) ltac:(lia)) as [y Hy]. exists y. now right. }
    destruct (G (steps p) O (linked w) L ltac:(lia)) as [l Hl]. exists l. apply (H3 _ Hl).
Qed.
Lemma shaped_nth k a b c (M : matrix) : shaped a b M = true -> (k < a)%nat -> c = b ->
  length (map val (nth k M [])) = c.
Proof.
  intros H Hk ->. apply shaped_is in H as [L H]. rewrite map_length. apply H, nth_In. lia.
Qed.
Lemma row_states k : (k <= steps p)%nat -> length (row k (states p)) = n.
Proof.
  intros Hk. destruct parts as [S1 _]. unfold sizes_ok in S1. apply andb_prop in S1 as [_ S1].
  apply andb_prop in S1 as [S1 _]. apply andb_prop in S1 as [S1 _]. apply andb_prop in S1 as [_ S1].
  apply (shaped_nth k _ _ _ _ S1); auto. lia.
Qed.
Lemma maps_length x u : length (maps_to m x u) = n.
Proof. unfold maps_to, equations_of. now rewrite !map_length, seq_length. Qed.
Lemma fbar_length k xi : (k < steps p)%nat -> length (fbar k xi) = n.
Proof.
  intros Hk. unfold fbar. rewrite minus_length; rewrite maps_length; auto.
  now rewrite row_states by lia.
Qed.
Lemma response_shape k : (k < steps p)%nat -> length (nth k (responses s) []) = n.
Proof.
  intros Hk. destruct parts as [S1 _]. unfold sizes_ok in S1. apply andb_prop in S1 as [_ S1].
  apply andb_prop in S1 as [_ S1]. apply andb_prop in S1 as [_ S1]. apply andb_prop in S1 as [S1 _].
  apply andb_prop in S1 as [L S1]. apply Nat.eqb_eq in L. rewrite forallb_forall in S1.
  assert (Hin : In (nth k (responses s) []) (responses s)) by (apply nth_In; lia).
  apply S1, shaped_is in Hin. apply Hin.
Qed.
Lemma scale_facts k : (k <= steps p)%nat -> shaped n n (scale_at s k) = true /\
  0 < val (radius_at (tube_radii s) k) /\ 0 < val (radius_at (inlet_radii s) k).
Proof.
  intros Hk. destruct parts as [_ [_ [S1 _]]]. specialize (S1 k Hk). unfold sample_ok in S1.
  apply andb_prop in S1 as [S1 _]. apply andb_prop in S1 as [A B].
  apply andb_prop in A as [A _]. apply andb_prop in B as [B1 B2].
  repeat split; auto; now apply positive_val.
Qed.
Lemma size_is k z : size s k z = norm (at_ (scale_at s k) z).
Proof. reflexivity. Qed.
Lemma bound_nonneg : 0 <= val (bound s).
Proof. destruct parts as [_ [H _]]. apply andb_prop in H as [H _]. now apply nonneg_val. Qed.

(* What is bent. *)
Definition bent (k : nat) (xi : list R) : list R :=
  let g := at_ (scale_at s (S k)) (fbar k xi) in
  match assumed_form s with
  | Response => minus g (at_ (scale_at s (S k)) (times k (responses s) xi))
  | _ => g
  end.

Lemma kappa_sound ST kap z : kappa_ok m ST kap = true -> length z = n ->
  norm z <= val kap * norm (at_ ST z).
Proof.
  intros H Hz. apply andb_prop in H as [H1 H2]. apply nonneg_val in H1.
  apply (semidefinite_sound _ _ z) in H2. rewrite form_triangle, total_app, !total_self in H2.
  rewrite at_units, val_mul, val_opp, val_none in H2 by auto.
  apply norm_below; [apply Rmult_le_pos; auto; apply norm_nonneg|].
  replace (val kap * norm (at_ ST z) * (val kap * norm (at_ ST z)))
    with (val kap * val kap * (norm (at_ ST z) * norm (at_ ST z))) by ring.
  rewrite norm_squared. lra.
Qed.

Lemma link_sound k l (radii : list num) (c : chain) :
  link_ok m p s (basis w) (ball_basis w) (products (basis w)) k l = true -> (k < steps p)%nat ->
  (radii = tube_radii s /\ c = of_tube l \/ radii = inlet_radii s /\ c = of_inlet l) ->
  exists more, added s l (radius_at radii k) = Some more /\
  val (reach c) + val more <= radius radii (S k) /\ 0 <= val (kappa l) /\
  0 <= val (stretched s l (radius_at radii k)) /\
  (forall xi, length xi = n -> size s k xi <= radius radii k ->
    norm (at_ (scale_at s (S k)) (fbar k xi)) <= val (reach c)) /\
  (forall xi y, length xi = n -> length y = n -> size s k xi <= radius radii k ->
    size s k y <= val (bound s) ->
    norm (minus (bent k (plus xi y)) (bent k xi)) <= val (stretched s l (radius_at radii k)) * size s k y).
Proof.
  intros H Hk Hc. unfold link_ok in H. cbn zeta in H.
  set (T := frame l) in *. set (zs := fstate n) in *. set (xs := flinear T zs) in *.
  set (g := flinear (scale_at s (S k)) (fmoved m p k xs)) in *.
  set (y0 := flinear (scale_at s k) xs) in *. set (q := match assumed_form s with Response => _ | _ => _ end) in *.
  apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [H1 HK]. apply andb_prop in H1 as [HT HE].
  apply andb_prop in H2 as [HC H2]. apply andb_prop in H2 as [H2 H3].
  assert (Hch : chain_ok s (basis w) (ball_basis w) (products (basis w)) k l (fdot g g) (fdot y0 y0) radii c = true).
  { destruct Hc as [[-> ->]|[-> ->]]; auto. }
  clear H2 H3. unfold chain_ok in Hch. cbn zeta in Hch.
  destruct (expanded _ _ _) as [sigma|] eqn:Es; [|discriminate].
  destruct (added s l (radius_at radii k)) as [more|] eqn:Ea; [|discriminate].
  apply andb_prop in Hch as [B1 B2]. apply andb_prop in B1 as [B0 B1].
  apply nonneg_val in B0. apply num_leb_le in B1. rewrite val_add in B1.
  assert (Hr : 0 <= radius radii k).
  { destruct (scale_facts k ltac:(lia)) as [_ [A B]]. destruct Hc as [[-> _]|[-> _]]; unfold radius, radius_at, nzero in *; lra. }
  apply shaped_is in HT as [LT RT].
  assert (Onto : forall xi, length xi = n -> exists z, length z = n /\ at_ T z = xi).
  { intros xi Hxi. destruct (echelon_onto n T O HE ltac:(lia) RT xi ltac:(lia)) as [z [Lz Hz]].
    exists z. split; [lia|]. exact (Hz [] eq_refl). }
  assert (Means : forall z, length z = n ->
    Forall2 (means z) xs (at_ T z) /\ Forall2 (means z) g (at_ (scale_at s (S k)) (fbar k (at_ T z))) /\
    Forall2 (means z) y0 (at_ (scale_at s k) (at_ T z)) /\ Forall2 (means z) q (bent k (at_ T z))).
  { intros z Hz. assert (A : Forall2 (means z) xs (at_ T z)).
    { apply means_flinear. unfold zs. rewrite <- Hz. apply means_fstate. }
    assert (B : Forall2 (means z) g (at_ (scale_at s (S k)) (fbar k (at_ T z)))).
    { now apply means_flinear, means_fmoved. }
    repeat split; auto; [now apply means_flinear|].
    unfold q, bent. destruct (assumed_form s); auto. apply means_minus; auto.
    now apply means_flinear, means_flinear. }
  exists more. split; auto. split; [exact B1|].
  assert (HK0 : 0 <= val (kappa l)) by (apply andb_prop in HK as [HK _]; now apply nonneg_val).
  assert (Kap : forall z, length z = n -> norm z <= val (kappa l) * size s k (at_ T z)).
  { intros z Hz. rewrite size_is, <- at_products. now apply (kappa_sound _ _ z HK). }
  pose proof bound_nonneg as Hbound.
  assert (Hg : Forall (fun g => 0 <= val g) (curvature l)).
  { destruct (Means (repeat 0 n) (repeat_length _ _)) as [_ [_ [_ M0]]].
    now destruct (curvature_sound n q (curvature l) _ _ _ _ HC (repeat_length _ _) (repeat_length _ _) M0 M0). }
  assert (Hst : 0 <= stretch 1 (curvature l) (val (kappa l) * radius radii k + val (kappa l) * val (bound s))
      (val (kappa l) * radius radii k)).
  { pose proof (Rmult_le_pos _ _ HK0 Hr). pose proof (Rmult_le_pos _ _ HK0 Hbound).
    clear - Hg H H0. generalize 1%nat as j. induction Hg; intros j; cbn; [lra|].
    apply Rplus_le_le_0_compat; auto. apply Rmult_le_pos; auto. apply spread_nonneg; lra. }
  split; auto. split.
  { unfold stretched. rewrite val_mul, nstretch_val, val_add, !val_mul. now apply Rmult_le_pos. }
  split.
  - intros xi Hxi Hs. destruct (Onto xi Hxi) as [z [Lz <-]]. destruct (Means z Lz) as [_ [Mg [My _]]].
    apply norm_below; auto.
    destruct (expanded_val 0 (env z) _ _ _ _ ltac:(lra) Es) as [v [Hv Hv0]].
    assert (P := is_nonneg_sound 0 (env z) _ _ _ _ _ ltac:(lra) B2
      (means_sub _ _ _ _ _ _ (means_sub _ _ _ _ _ _ (means_fnum _ _ _) (means_fdot _ _ _ _ _ _ Mg Mg))
        (means_mul _ _ _ _ _ _ Hv (means_sub _ _ _ _ _ _ (means_fnum _ _ _) (means_fdot _ _ _ _ _ _ My My))))).
    rewrite !val_mul in P.
    rewrite size_is in Hs. rewrite <- (norm_squared (at_ (scale_at s k) (at_ T z))) in P.
    set (a := norm (at_ (scale_at s k) (at_ T z))) in *.
    pose proof (norm_nonneg (at_ (scale_at s k) (at_ T z))) as Ha. fold a in Ha.
    change (val (radius_at radii k)) with (radius radii k) in P.
    assert (D : 0 <= radius radii k * radius radii k - a * a).
    { pose proof (Rmult_le_compat a _ a _ Ha Ha Hs Hs). lra. }
    pose proof (Rmult_le_pos _ _ Hv0 D). lra.
  - intros xi y Hxi Hy Hs Hb. destruct (Onto xi Hxi) as [z [Lz <-]]. destruct (Onto y Hy) as [u [Lu <-]].
    rewrite <- at_plus by congruence.
    assert (Lzu : length (plus z u) = n) by (rewrite plus_length; congruence).
    destruct (Means z Lz) as [_ [_ [_ Mq]]]. destruct (Means _ Lzu) as [_ [_ [_ Mq']]].
    destruct (curvature_sound n q (curvature l) _ _ _ _ HC Lz Lzu Mq Mq') as [_ C].
    eapply Rle_trans; [exact C|].
    assert (E : minus (plus z u) z = u).
    { clear - Lz Lu. revert u Lu. rewrite <- Lz. clear Lz. induction z as [|a z IH]; intros [|b u] L;
        try discriminate; auto. cbn. unfold minus, plus in IH. rewrite IH by (now injection L). f_equal. ring. }
    rewrite E. clear E C.
    pose proof (Kap z Lz) as Nz. pose proof (Kap u Lu) as Nu. pose proof (norm_nonneg z) as N0.
    pose proof (norm_nonneg (plus z u)). pose proof (norm_nonneg u).
    pose proof (norm_plus z u ltac:(congruence)) as Np.
    set (su := size s k (at_ T u)) in *. set (sz := size s k (at_ T z)) in *.
    assert (0 <= su) by (unfold su; rewrite size_is; apply norm_nonneg).
    assert (0 <= sz) by (unfold sz; rewrite size_is; apply norm_nonneg).
    unfold stretched. rewrite val_mul, nstretch_val, val_add, !val_mul.
    change (val (radius_at radii k)) with (radius radii k).
    set (kap := val (kappa l)) in *.
    assert (A1 : norm z <= kap * radius radii k).
    { eapply Rle_trans; [exact Nz|]. now apply Rmult_le_compat_l. }
    assert (A2 : norm u <= kap * val (bound s)).
    { eapply Rle_trans; [exact Nu|]. now apply Rmult_le_compat_l. }
    eapply Rle_trans.
    { apply Rmult_le_compat_l; auto. apply (stretch_mono (curvature l) 1 _ _
        (kap * radius radii k + kap * val (bound s)) (kap * radius radii k)); auto; lra. }
    set (st := stretch _ _ _ _) in *.
    replace (kap * st * su) with (kap * su * st) by ring. now apply Rmult_le_compat_r.
Qed.

(* Motions. *)
Lemma plus_minus a b : length a = length b -> plus b (minus a b) = a.
Proof.
  revert b. unfold plus, minus. induction a as [|x a IH]; intros [|y b] L; try discriminate; auto.
  cbn. rewrite IH by (now injection L). f_equal. ring.
Qed.
Lemma plus_comm a : forall b, plus a b = plus b a.
Proof.
  unfold plus. induction a as [|x a IH]; intros [|y b]; auto. cbn. rewrite IH. f_equal. ring.
Qed.
Lemma motion_length x d : motion m p x d -> forall k, (k <= steps p)%nat -> length (x k) = n.
Proof.
  intros [H0 H] [|k] Hk; auto. destruct (H k ltac:(lia)) as [Ld ->].
  rewrite plus_length; rewrite maps_length; auto.
Qed.
Lemma off_length x d k : motion m p x d -> (k <= steps p)%nat -> length (off p k (x k)) = n.
Proof.
  intros H Hk. unfold off. pose proof (motion_length x d H k Hk).
  rewrite minus_length; auto. now rewrite row_states.
Qed.
Lemma off_next x d k : motion m p x d -> (k < steps p)%nat ->
  length (d k) = n /\ off p (S k) (x (S k)) = plus (fbar k (off p k (x k))) (d k).
Proof.
  intros Hm Hk. pose proof (motion_length x d Hm k ltac:(lia)) as Lx. destruct Hm as [_ H].
  destruct (H k Hk) as [Ld E]. split; auto. unfold off at 1. rewrite E, minus_plus_left.
  - unfold fbar. assert (G : plus (row k (states p)) (off p k (x k)) = x k).
    { apply plus_minus. now rewrite row_states by lia. }
    rewrite G. reflexivity.
  - rewrite maps_length, row_states by lia. reflexivity.
  - now rewrite maps_length.
Qed.
Lemma size_plus k a b : length a = length b -> size s k (plus a b) <= size s k a + size s k b.
Proof.
  intros L. rewrite !size_is, at_plus by auto. apply norm_plus. now rewrite !at_length.
Qed.
Lemma size_nonneg k z : 0 <= size s k z.
Proof. apply norm_nonneg. Qed.

Definition a_chain (radii : list num) : Prop := radii = tube_radii s \/ radii = inlet_radii s.
Lemma chain_step radii k : a_chain radii -> (k < steps p)%nat -> exists b l more,
  added s l (radius_at radii k) = Some more /\ b + val more <= radius radii (S k) /\
  0 <= val (stretched s l (radius_at radii k)) /\
  (forall xi, length xi = n -> size s k xi <= radius radii k ->
    norm (at_ (scale_at s (S k)) (fbar k xi)) <= b) /\
  (forall xi y, length xi = n -> length y = n -> size s k xi <= radius radii k ->
    size s k y <= val (bound s) ->
    norm (minus (bent k (plus xi y)) (bent k xi)) <= val (stretched s l (radius_at radii k)) * size s k y).
Proof.
  intros Hr Hk. destruct parts as [_ [_ [_ L]]]. destruct (L k Hk) as [l Hl].
  assert (C : exists c, radii = tube_radii s /\ c = of_tube l \/ radii = inlet_radii s /\ c = of_inlet l).
  { destruct Hr as [->| ->]; eauto. }
  destruct C as [c C]. destruct (link_sound k l radii c Hl Hk C) as [more [A [B [_ D]]]].
  exists (val (reach c)), l, more. auto.
Qed.

Lemma stays_peak radii x d : a_chain radii -> assumed_form s = Peak -> motion m p x d ->
  size s O (off p O (x O)) <= radius radii O -> forall k, (k <= steps p)%nat ->
  (forall j, (j < k)%nat -> size s (S j) (d j) <= val (bound s)) ->
  size s k (off p k (x k)) <= radius radii k.
Proof.
  intros Hc Hf Hm H0. induction k as [|k IH]; intros Hk Hd; auto.
  destruct (chain_step radii k Hc ltac:(lia)) as [b [l [more [A [B [_ [C _]]]]]]].
  unfold added in A. rewrite Hf in A. injection A as <-.
  specialize (IH ltac:(lia) (fun j Hj => Hd j (Nat.lt_lt_succ_r _ _ Hj))).
  destruct (off_next x d k Hm ltac:(lia)) as [Ld ->].
  pose proof (off_length x d k Hm ltac:(lia)) as Lo.
  eapply Rle_trans. { apply size_plus. now rewrite fbar_length by lia. }
  pose proof (C _ Lo IH) as D. rewrite <- size_is in D. pose proof (Hd k ltac:(lia)). lra.
Qed.

Lemma response_length d k : (forall j, (j < k)%nat -> length (d j) = n) -> (k <= steps p)%nat ->
  length (response m s d k) = n.
Proof.
  intros Hd Hk. destruct k as [|k]; [apply repeat_length|]. cbn [response].
  assert (L : length (times k (responses s) (response m s d k)) = n).
  { change (length (at_ (nth k (responses s) []) (response m s d k)) = n).
    rewrite at_length. apply response_shape. lia. }
  rewrite plus_length; auto. now rewrite L, Hd by lia.
Qed.
Lemma stays_response radii x d : a_chain radii -> assumed_form s = Response -> motion m p x d ->
  size s O (off p O (x O)) <= radius radii O -> forall k, (k <= steps p)%nat ->
  (forall j, (j <= k)%nat -> size s j (response m s d j) <= val (bound s)) ->
  size s k (minus (off p k (x k)) (response m s d k)) <= radius radii k.
Proof.
  intros Hc Hf Hm H0.
  assert (Ld : forall k, (k < steps p)%nat -> length (d k) = n).
  { intros k Hk. now destruct (off_next x d k Hm Hk). }
  induction k as [|k IH]; intros Hk Hd.
  { cbn [response]. replace (minus _ _) with (off p O (x O)); auto.
    pose proof (off_length x d O Hm ltac:(lia)) as L. unfold minus. fold n. rewrite <- L.
    clear. induction (off p O (x O)) as [|a l IH]; auto. cbn. rewrite <- IH. f_equal. ring. }
  destruct (chain_step radii k Hc ltac:(lia)) as [b [l [more [A [B [S0 [C D]]]]]]].
  unfold added in A. rewrite Hf in A. injection A as <-. rewrite val_mul in B.
  specialize (IH ltac:(lia) (fun j Hj => Hd j ltac:(lia))).
  destruct (off_next x d k Hm ltac:(lia)) as [Ldk ->].
  pose proof (off_length x d k Hm ltac:(lia)) as Lo.
  pose proof (response_length d k (fun j Hj => Ld j ltac:(lia)) ltac:(lia)) as Lr.
  set (o := off p k (x k)) in *. set (r := response m s d k) in *. cbn [response]. fold r.
  assert (LA : length (times k (responses s) r) = n).
  { change (length (at_ (nth k (responses s) []) r) = n). rewrite at_length. apply response_shape. lia. }
  pose proof (fbar_length k o ltac:(lia)) as LF.
  rewrite minus_plus by congruence.
  set (xi := minus o r) in *. assert (Lxi : length xi = n) by (unfold xi; rewrite minus_length; congruence).
  assert (Eo : plus xi r = o).
  { unfold xi. rewrite plus_comm. apply plus_minus. congruence. }
  pose proof (Hd k ltac:(lia)) as Hrk. fold r in Hrk.
  specialize (C xi Lxi IH). specialize (D xi r Lxi Lr IH Hrk). rewrite Eo in D.
  pose proof (fbar_length k xi ltac:(lia)) as LFx.
  rewrite size_is, at_minus by congruence. unfold bent in D. rewrite Hf in D.
  rewrite <- Eo in D at 2.
  change (times k (responses s) ?v) with (at_ (nth k (responses s) []) v) in *.
  rewrite at_plus in D by congruence.
  set (M := scale_at s (S k)) in *. set (AA := nth k (responses s) []) in *.
  rewrite at_plus in D by (rewrite !at_length; reflexivity).
  assert (E : minus (at_ M (fbar k o)) (at_ M (at_ AA r)) =
    plus (at_ M (fbar k xi)) (minus (minus (at_ M (fbar k o)) (plus (at_ M (at_ AA xi)) (at_ M (at_ AA r))))
      (minus (at_ M (fbar k xi)) (at_ M (at_ AA xi))))).
  { apply (nth_ext _ _ 0 0).
    - repeat first [rewrite plus_length | rewrite minus_length | rewrite at_length]; auto.
    - intros i _. repeat first [rewrite nth_plus | rewrite nth_minus];
        repeat first [rewrite plus_length | rewrite minus_length | rewrite at_length]; auto. ring. }
  rewrite E. eapply Rle_trans.
  { apply norm_plus. repeat first [rewrite plus_length | rewrite minus_length | rewrite at_length]; auto. }
  pose proof (Rmult_le_compat_l _ _ _ S0 Hrk). lra.
Qed.

(* The motion that the disturbance would not have. *)
Fixpoint alone (x0 : list R) (k : nat) : list R :=
  match k with O => x0 | S j => fbar j (alone x0 j) end.
Lemma alone_length x0 k : length x0 = n -> (k <= steps p)%nat -> length (alone x0 k) = n.
Proof. intros H Hk. destruct k; auto. apply fbar_length. lia. Qed.
Lemma mixed a delta mu c lam E : 0 <= a -> 0 <= delta -> 0 <= mu -> 1 <= c -> 0 <= lam -> a * a <= E ->
  c * (mu * mu) <= (c - 1) * lam -> (mu * a + delta) * (mu * a + delta) <= lam * E + c * delta ^ 2.
Proof.
  intros Ha Hd Hm Hc Hl HE H.
  assert (Haa : 0 <= a * a) by now apply Rmult_le_pos.
  assert (Hdd : 0 <= delta * delta) by now apply Rmult_le_pos.
  assert (U : 0 <= lam * (a * a)) by now apply Rmult_le_pos.
  assert (W : 0 <= c * (c - 1) * (delta * delta)).
  { apply Rmult_le_pos; auto. apply Rmult_le_pos; lra. }
  assert (D : 2 * c * mu * a * delta <= lam * (a * a) + c * (c - 1) * (delta * delta)).
  { apply square_below; [lra|].
    pose proof (Rmult_le_compat_l (4 * c * ((a * a) * (delta * delta))) _ _
      ltac:(apply Rmult_le_pos; [lra|now apply Rmult_le_pos]) H) as G.
    pose proof (Rle_0_sqr (lam * (a * a) - c * (c - 1) * (delta * delta))) as Q. unfold Rsqr in Q. lra. }
  pose proof (Rmult_le_compat_r (a * a) _ _ Haa H) as G.
  pose proof (Rmult_le_compat_l lam _ _ Hl HE) as G2.
  apply (Rmult_le_reg_l c); [lra|].
  pose proof (Rmult_le_compat_l c _ _ ltac:(lra) G2). cbn [pow]. lra.
Qed.
Lemma stays_energy radii x d : a_chain radii ->
  (assumed_form s = Energy \/ assumed_form s = Fading) -> motion m p x d ->
  size s O (off p O (x O)) <= radius radii O -> forall k, (k <= steps p)%nat ->
  (forall j, (j <= k)%nat -> sqrt (energy s d j) <= val (bound s)) ->
  let y := alone (off p O (x O)) k in
  size s k y <= radius radii k /\
  size s k (minus (off p k (x k)) y) * size s k (minus (off p k (x k)) y) <= energy s d k.
Proof.
  intros Hc Hf Hm H0. cbn zeta. pose proof (off_length x d O Hm ltac:(lia)) as L0.
  assert (Gains : 1 <= val (weighs s) /\ 0 <= val (forgets_by s)).
  { destruct parts as [_ [G _]]. unfold form_ok in G. apply andb_prop in G as [_ G].
    assert (G' : andb (num_leb none (weighs s)) (nonneg (forgets_by s)) = true) by (destruct Hf as [E|E]; now rewrite E in G).
    apply andb_prop in G' as [A B]. apply num_leb_le in A. rewrite val_none in A. split; auto. now apply nonneg_val. }
  destruct Gains as [Gc Gl].
  assert (Hbent : forall k v, bent k v = at_ (scale_at s (S k)) (fbar k v)).
  { intros k v. unfold bent. destruct Hf as [E|E]; now rewrite E. }
  induction k as [|k IH]; intros Hk Hd.
  { cbn [alone energy]. split; auto.
    assert (E : at_ (scale_at s O) (minus (off p O (x O)) (off p O (x O))) = minus (at_ (scale_at s O) (off p O (x O))) (at_ (scale_at s O) (off p O (x O)))).
    { now apply at_minus. }
    rewrite size_is, norm_squared, E. generalize (at_ (scale_at s O) (off p O (x O))). clear.
    unfold minus. induction l as [|a l IH]; cbn; [lra|]. replace (a - a) with 0 by ring. lra. }
  destruct (chain_step radii k Hc ltac:(lia)) as [b [l [more [A [B [S0 [C D]]]]]]].
  unfold added in A.
  assert (A' : num_leb (nmul (weighs s) (nmul (stretched s l (radius_at radii k)) (stretched s l (radius_at radii k))))
      (nmul (nsub (weighs s) none) (forgets_by s)) = true /\ more = nzero).
  { destruct Hf as [E|E]; rewrite E in A; destruct (num_leb _ _); try discriminate; injection A as <-; auto. }
  clear A. destruct A' as [A ->]. apply num_leb_le in A. rewrite !val_mul, val_sub, val_none in A.
  rewrite val_nzero in B.
  destruct (IH ltac:(lia) (fun j Hj => Hd j ltac:(lia))) as [I1 I2]. clear IH.
  destruct (off_next x d k Hm ltac:(lia)) as [Ldk ->].
  pose proof (off_length x d k Hm ltac:(lia)) as Lo.
  pose proof (alone_length (off p O (x O)) k L0 ltac:(lia)) as Ly.
  cbn [alone]. set (y := alone (off p O (x O)) k) in *. set (o := off p k (x k)) in *.
  pose proof (fbar_length k y ltac:(lia)) as LFy. pose proof (fbar_length k o ltac:(lia)) as LFo.
  pose proof (C y Ly I1) as Cy. split. { rewrite size_is. lra. }
  set (e := minus o y) in *. assert (Le : length e = n) by (unfold e; rewrite minus_length; congruence).
  assert (Eo : plus y e = o) by (apply plus_minus; congruence).
  set (a := size s k e) in *. assert (Ha : 0 <= a) by apply size_nonneg.
  assert (Hb : a <= val (bound s)).
  { apply Rle_trans with (sqrt (energy s d k)); [|apply Hd; lia].
    rewrite <- (sqrt_square a) by auto. now apply sqrt_le_1_alt. }
  specialize (D y e Ly Le I1 Hb). rewrite Eo, !Hbent in D. rewrite <- at_minus in D by congruence.
  rewrite minus_plus_left by congruence.
  assert (T : size s (S k) (plus (minus (fbar k o) (fbar k y)) (d k))
      <= val (stretched s l (radius_at radii k)) * a + size s (S k) (d k)).
  { eapply Rle_trans. { apply size_plus. rewrite minus_length; congruence. }
    apply Rplus_le_compat_r. rewrite size_is. exact D. }
  pose proof (size_nonneg (S k) (plus (minus (fbar k o) (fbar k y)) (d k))) as T0.
  pose proof (Rmult_le_compat _ _ _ _ T0 T0 T T) as TT. eapply Rle_trans; [exact TT|].
  cbn [energy]. apply mixed; auto. apply size_nonneg.
Qed.

(* Any form: the radius, widened. *)
Lemma adds_val : val (adds s) = widened s.
Proof. unfold adds, widened. destruct (assumed_form s); auto. apply val_nzero. Qed.
Theorem stays_within radii x d : a_chain radii -> motion m p x d ->
  size s O (off p O (x O)) <= radius radii O -> forall k, (k <= steps p)%nat -> assumed m s d k ->
  size s k (off p k (x k)) <= radius radii k + widened s.
Proof.
  intros Hc Hm H0 k Hk Ha. pose proof (off_length x d k Hm Hk) as Lo.
  pose proof (off_length x d O Hm ltac:(lia)) as L0.
  assert (Faded : assumed_form s = Energy \/ assumed_form s = Fading ->
    (forall j, (j <= k)%nat -> sqrt (energy s d j) <= val (bound s)) ->
    size s k (off p k (x k)) <= radius radii k + val (bound s)).
  { intros Hf Hd. destruct (stays_energy radii x d Hc Hf Hm H0 k Hk Hd) as [A B].
    set (y := alone _ k) in *. assert (Ly : length y = n) by (apply alone_length; auto).
    rewrite <- (plus_minus (off p k (x k)) y) by congruence.
    eapply Rle_trans. { apply size_plus. rewrite minus_length; congruence. }
    apply Rplus_le_compat; auto. apply Rle_trans with (sqrt (energy s d k)); [|apply Hd; lia].
    rewrite <- (sqrt_square (size _ _ _)) by apply size_nonneg. now apply sqrt_le_1_alt. }
  unfold assumed, widened in *. destruct (assumed_form s) eqn:Hf.
  - pose proof (stays_response radii x d Hc Hf Hm H0 k Hk Ha) as H. pose proof (Ha k ltac:(lia)) as Hr.
    assert (Lr : length (response m s d k) = n).
    { apply response_length; auto. intros j Hj. now destruct (off_next x d j Hm ltac:(lia)). }
    rewrite <- (plus_minus (off p k (x k)) (response m s d k)) by congruence.
    eapply Rle_trans. { apply size_plus. rewrite minus_length; congruence. } lra.
  - pose proof (stays_peak radii x d Hc Hf Hm H0 k Hk Ha). lra.
  - exact (Faded (or_introl eq_refl) Ha).
  - exact (Faded (or_intror eq_refl) Ha).
Qed.

(* The box of the data, and the half-widths. *)
Lemma fits_sound S sz rm g z : fits_in S sz rm g = true -> 0 <= val sz ->
  0 <= val rm /\ Rabs (dot (map val g) z) * val sz <= val rm * norm (at_ S z).
Proof.
  intros H Hs. apply andb_prop in H as [H1 H2]. apply nonneg_val in H1. split; auto.
  apply (semidefinite_sound _ _ z) in H2. rewrite form_triangle in H2. cbn [total] in H2.
  rewrite total_self, dot_vscale, !val_mul, val_opp, val_mul in H2.
  pose proof (norm_nonneg (at_ S z)). pose proof (Rabs_pos (dot (map val g) z)).
  apply square_below; [now apply Rmult_le_pos|].
  assert (E : Rabs (dot (map val g) z) * Rabs (dot (map val g) z) = dot (map val g) z * dot (map val g) z).
  { rewrite <- Rabs_mult. apply Rabs_right, Rle_ge. apply (Rle_0_sqr (dot (map val g) z)). }
  replace (Rabs (dot (map val g) z) * val sz * (Rabs (dot (map val g) z) * val sz))
    with (Rabs (dot (map val g) z) * Rabs (dot (map val g) z) * (val sz * val sz)) by ring.
  rewrite E. replace (val rm * norm (at_ S z) * (val rm * norm (at_ S z)))
    with (val rm * val rm * (norm (at_ S z) * norm (at_ S z))) by ring.
  rewrite norm_squared. lra.
Qed.
Lemma all_widths S sz z : 0 <= val sz -> forall rows widths,
  forallb (fun e => fits_in S sz (snd e) (fst e)) (combine rows widths) = true ->
  length rows = length widths -> forall i, (i < length rows)%nat ->
  0 <= nth i (map val widths) 0 /\
  Rabs (nth i (at_ rows z) 0) * val sz <= nth i (map val widths) 0 * norm (at_ S z).
Proof.
  intros Hs. induction rows as [|g rows IH]; intros [|rm widths] H L i Hi; try discriminate; [cbn in Hi; lia|].
  cbn in H. apply andb_prop in H as [A B].
  change (at_ (g :: rows) z) with (dot (map val g) z :: at_ rows z). destruct i as [|i]; cbn [nth map].
  - now apply fits_sound.
  - apply IH; auto. cbn in Hi. lia.
Qed.
Lemma all_ranges S sz z : 0 < val sz -> norm (at_ S z) <= val sz -> forall rows centres ends,
  forallb (fun e => fits_in S sz (room (snd (fst e)) (snd e)) (fst (fst e)))
    (combine (combine rows centres) ends) = true ->
  length rows = length centres -> length centres = length ends ->
  in_box (plus (map val centres) (at_ rows z)) ends /\ in_box (minus (map val centres) (at_ rows z)) ends.
Proof.
  intros Hs Hz. induction rows as [|g rows IH]; intros [|c centres] [|[lo hi] ends] H L1 L2; try discriminate.
  { split; constructor. }
  cbn in H. apply andb_prop in H as [A B]. injection L1 as L1. injection L2 as L2.
  destruct (IH centres ends B L1 L2) as [P Q]. clear IH B.
  destruct (fits_sound _ _ _ _ z A ltac:(lra)) as [R0 R1].
  assert (W : Rabs (dot (map val g) z) <= val (room c (lo, hi))).
  { apply (Rmult_le_reg_r (val sz)); auto. eapply Rle_trans; [exact R1|]. now apply Rmult_le_compat_l. }
  unfold room in W. cbn [fst snd] in W.
  destruct (nmin_below (nsub hi c) (nsub c lo)) as [M1 M2]. rewrite !val_sub in M1, M2.
  pose proof (Rle_abs (dot (map val g) z)) as G1. pose proof (Rle_abs (- dot (map val g) z)) as G2.
  rewrite Rabs_Ropp in G2.
  change (at_ (g :: rows) z) with (dot (map val g) z :: at_ rows z).
  split; constructor; auto; cbn [fst snd]; lra.
Qed.

Lemma sample_sound k x d radii : a_chain radii -> motion m p x d -> (k <= steps p)%nat ->
  size s k (off p k (x k)) <= radius radii k + widened s ->
  in_data m p k (x k) /\
  forall i, (i < n)%nat -> 0 <= nth i (row k (half_widths s)) 0 /\
    Rabs (nth i (off p k (x k)) 0) * (radius (tube_radii s) k + widened s)
      <= nth i (row k (half_widths s)) 0 * size s k (off p k (x k)).
Proof.
  intros Hc Hm Hk Hz. pose proof (off_length x d k Hm Hk) as Lo.
  pose proof (motion_length x d Hm k Hk) as Lx.
  destruct parts as [Z1 [_ [S1 _]]]. specialize (S1 k Hk). unfold sample_ok in S1. cbn zeta in S1.
  destruct (scale_facts k Hk) as [_ [T0 I0]]. pose proof bound_nonneg as B0.
  assert (W0 : 0 <= widened s) by (unfold widened; destruct (assumed_form s); lra).
  apply andb_prop in S1 as [_ S1]. apply andb_prop in S1 as [Hw S1]. apply andb_prop in S1 as [Hx Hu].
  set (t := nadd (radius_at (tube_radii s) k) (adds s)) in *.
  set (i0 := nadd (radius_at (inlet_radii s) k) (adds s)) in *.
  assert (Vt : val t = radius (tube_radii s) k + widened s) by (unfold t; now rewrite val_add, adds_val).
  assert (Vi : val i0 = radius (inlet_radii s) k + widened s) by (unfold i0; now rewrite val_add, adds_val).
  change (val (radius_at ?l k)) with (radius l k) in T0, I0.
  set (most := if num_ltb t i0 then i0 else t) in *.
  assert (Most : val t <= val most /\ val i0 <= val most).
  { unfold most. destruct (num_ltb t i0) eqn:E; [apply num_ltb_lt in E|apply num_ltb_not in E]; lra. }
  assert (Hmost : norm (at_ (scale_at s k) (off p k (x k))) <= val most).
  { rewrite <- size_is. destruct Hc as [-> | ->]; lra. }
  assert (Pm : 0 < val most) by lra.
  unfold sizes_ok in Z1. apply andb_prop in Z1 as [Z0 Z1]. apply andb_prop in Z1 as [Z1 Z2].
  apply andb_prop in Z1 as [Z1 Z3]. apply andb_prop in Z1 as [Zu Zx]. apply andb_prop in Z3 as [Zf Zfs].
  apply andb_prop in Z2 as [Z2 _]. apply andb_prop in Z2 as [_ Z2]. apply andb_prop in Z2 as [Zw _].
  assert (Lunits : forall j, length (units j) = j) by (induction j; cbn; auto; now rewrite map_length, IHj).
  assert (Lrow : forall a b (M : matrix) j, shaped a b M = true -> (j < a)%nat -> length (nth j M []) = b).
  { intros a b M j H Hj. apply shaped_is in H as [L H]. apply H, nth_In. lia. }
  split; [split|].
  - destruct (all_ranges _ _ _ Pm Hmost _ _ _ Hx) as [P _].
    + rewrite Lunits. symmetry. apply (Lrow _ _ _ _ Zx). lia.
    + apply (Lrow _ _ _ _ Zx). lia.
    + rewrite at_units in P by auto. unfold off in P. rewrite plus_minus in P; [exact P|].
      now rewrite row_states.
  - intros Hlt. destruct (Nat.ltb_spec k (steps p)) as [_|]; [|lia].
    assert (Lf : length (nth k (feedback p) []) = length (u_range m)).
    { apply Nat.eqb_eq in Zf. rewrite forallb_forall in Zfs.
      assert (Hin : In (nth k (feedback p) []) (feedback p)) by (apply nth_In; lia).
      apply Zfs, shaped_is in Hin. apply Hin. }
    destruct (all_ranges _ _ _ Pm Hmost _ _ _ Hu) as [_ P].
    + rewrite Lf. symmetry. now apply (Lrow _ _ _ _ Zu).
    + now apply (Lrow _ _ _ _ Zu).
    + exact P.
  - intros i Hi. rewrite <- Vt. rewrite size_is.
    rewrite <- (at_units (off p k (x k)) n Lo) at 1.
    assert (Pt : 0 <= val t) by lra. apply (all_widths _ _ _ Pt _ _ Hw).
    + rewrite Lunits. symmetry. apply (Lrow _ _ _ _ Zw). lia.
    + now rewrite Lunits.
Qed.

Theorem tube_stays : stays_in_tube m p s.
Proof.
  intros x d Hm H0 k Hk Ha. assert (Hc : a_chain (tube_radii s)) by now left.
  pose proof (stays_within _ x d Hc Hm H0 k Hk Ha) as H.
  destruct (sample_sound k x d _ Hc Hm Hk H) as [A B]. repeat split; auto; try apply A.
  intros i Hi. destruct (B i Hi) as [W0 W]. destruct (scale_facts k Hk) as [_ [T0 _]].
  change (val (radius_at ?l k)) with (radius l k) in T0. pose proof bound_nonneg as B0.
  assert (0 <= widened s) by (unfold widened; destruct (assumed_form s); lra).
  apply (Rmult_le_reg_r (radius (tube_radii s) k + widened s)); [lra|].
  eapply Rle_trans; [exact W|]. now apply Rmult_le_compat_l.
Qed.
Theorem inlet_arrives : arrives_from_inlet m p s.
Proof.
  intros x d Hm H0 k Hk Ha. assert (Hc : a_chain (inlet_radii s)) by now right.
  pose proof (stays_within _ x d Hc Hm H0 k Hk Ha) as H.
  destruct (sample_sound k x d _ Hc Hm Hk H) as [A B]. repeat split; auto; try apply A.
  intros i Hi. destruct (B i Hi) as [W0 W]. eapply Rle_trans; [exact W|]. now apply Rmult_le_compat_l.
Qed.
End Stepwise.

Section Sampled.
Context {K : Ints}.
Theorem sampled_theorem m p s w : sampled_ok m p s w = true ->
  stays_in_tube m p s /\ arrives_from_inlet m p s.
Proof. intros H. split; [exact (tube_stays m p s w H)|exact (inlet_arrives m p s w H)]. Qed.
End Sampled.
