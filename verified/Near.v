(* Tubes and stability of identified models: what is decided, and why outputs then stay near. *)
From Coq Require Import ZArith Reals List Lra Lia Psatz.
From Verified Require Import Integers Forms Claim Condition Definite Goal Funnel Tubes Increments Boxes Ends Cells.
Import ListNotations.
Open Scope R_scope.

(* F, H, E and the box of a model, from its numbers. *)
Definition unknowns (m : model) : nat :=
  match m with
  | Linear _ => O | Affine p _ _ _ _ => p | Monotone _ _ _ _ _ => 1%nat
  | Cells maps _ _ _ => length maps
  end.
Definition states (m : model) : nat :=
  match m with
  | Linear a => length a | Affine _ n _ _ _ => n | Monotone _ _ _ a _ => length a
  | Cells _ _ next _ => length next
  end.
Definition outputs (m : model) : nat :=
  match m with Affine p _ _ _ _ => p | Cells _ _ _ out => length out | _ => 1%nat end.
Definition moves (m : model) : matrix :=
  match m with
  | Linear a => zip cons a (units (pred (length a)) ++ [repeat nzero (pred (length a))])
  | Affine p n _ _ _ => firstn n (units (p + n))
  | Monotone _ _ _ a shift => (none :: repeat nzero (length a)) :: map (cons nzero) shift
  | Cells _ _ next _ => next
  end.
Definition seen (m : model) : matrix :=
  match m with
  | Linear a => [none :: repeat nzero (pred (length a))]
  | Affine p n scale _ _ => zip vscale scale (firstn p (units (p + n)))
  | Monotone _ _ _ a _ => [none :: repeat nzero (length a)]
  | Cells _ _ _ out => out
  end.
Definition box_of (m : model) : list (num * num) :=
  match m with
  | Affine _ _ _ range _ => range | Cells maps _ _ _ => map slope_range maps | _ => []
  end.
Definition steepening (m : model) : bool :=
  match m with Monotone _ _ e3 _ _ => negb (fst e3 =? 0)%Z | _ => false end.
(* the least slope of e1 v + e2 v^2 + e3 v^3 *)
Definition least (e1 e2 e3 : num) : num :=
  if (fst e3 =? 0)%Z then e1 else nsub e1 (ndiv (nmul e2 e2) (nmul (3%Z, xH) e3)).
Definition vertices_of (m : model) (box : list (num * num)) : list matrix :=
  match m with
  | Linear _ => [[]]
  | Affine _ _ _ _ ts => vertices_on box ts
  | Monotone e1 e2 e3 a _ => [[least e1 e2 e3 :: a]]
  | Cells maps into next _ =>
      corners box (firstn (length maps) (units (length maps + length next))) into
  end.
Definition model_ok (m : model) : bool :=
  andb (andb (Nat.ltb 0 (states m)) (shaped (states m) (unknowns m + states m) (moves m)))
    (andb (shaped (outputs m) (unknowns m + states m) (seen m))
  match m with
  | Linear _ => true
  | Affine p n scale _ ts =>
      andb (andb (Nat.ltb 0 p) (Nat.eqb (length scale) p))
        (forallb (fun t => shaped p (p + n) (snd t)) ts)
  | Monotone e1 e2 e3 _ _ =>
      orb (0 <? fst e3)%Z (andb (fst e3 =? 0)%Z (fst e2 =? 0)%Z)
  | Cells maps into next _ =>
      andb (forallb map_ok maps) (shaped (length maps) (length maps + length next) into)
  end).

Section Near.
Context {K : Ints}.

(* One multiplier for each form, at every leaf. *)
Definition vertices_at (m : model) (box : list (num * num)) (stated : option stated_ends)
  : option (list matrix) :=
  match stated, m with
  | None, _ => Some (vertices_of m box)
  | Some e, Affine 1 _ _ _ ts => vertices_between box e ts
  | _, _ => None
  end.
Definition leaf_ok (m : model) (forms : list pairs) (box : list (num * num))
  (stated : option stated_ends) (Ns : list matrix) : bool :=
  match vertices_at m box stated with
  | Some vs =>
      andb (Nat.eqb (length Ns) (length forms))
        (forallb (fun e => positive_at (steepening m) (unknowns m + states m) (fst e) vs (snd e))
          (combine forms Ns))
  | None => false
  end.

Definition difference (u v : list R) (z x : list R) : list R := minus (u ++ z) (v ++ x).

Lemma minus_app a : forall b u v, length a = length u ->
  minus (a ++ b) (u ++ v) = minus a u ++ minus b v.
Proof.
  unfold minus. induction a as [|x a IH]; intros b [|y u] v H; try discriminate; cbn; auto.
  now rewrite IH by (now injection H).
Qed.
Lemma minus_length a b : length a = length b -> length (minus a b) = length a.
Proof. apply zip_length. Qed.
Lemma dot_minus c : forall a b, length a = length b -> dot c (minus a b) = dot c a - dot c b.
Proof.
  unfold minus. induction c as [|c0 c IH]; intros [|x a] [|y b] H; try discriminate; cbn; try ring.
  rewrite IH by (now injection H). ring.
Qed.
Lemma at_minus M a b : length a = length b -> at_ M (minus a b) = minus (at_ M a) (at_ M b).
Proof.
  intros H. induction M as [|row M IH]; [reflexivity|]. rewrite !at_row, IH, dot_minus by auto.
  reflexivity.
Qed.
Lemma minus_plus a b c : length a = length c -> length b = length c ->
  minus (plus a c) (plus b c) = minus a b.
Proof.
  unfold minus, plus. revert b c. induction a as [|x a IH]; intros [|y b] [|z c] H1 H2;
    try discriminate; cbn; auto. cbn in H1, H2. rewrite IH by lia. f_equal. ring.
Qed.
Lemma at_firstn k M z : at_ (firstn k M) z = firstn k (at_ M z).
Proof. unfold at_, image, vals. now rewrite <- !firstn_map. Qed.
Lemma minus_firstn k : forall a b, minus (firstn k a) (firstn k b) = firstn k (minus a b).
Proof.
  unfold minus. induction k as [|k IH]; intros [|x a] [|y b]; cbn; auto. now rewrite IH.
Qed.

(* Two steps under the same inputs. *)
Section Two.
Variables (m : model) (d r w x v x' y z u z' q : list R).
Hypothesis Hm : model_ok m = true.
Hypothesis Sx : step m d r x w v x' y.
Hypothesis Sz : step m d r z w u z' q.
Notation zeta := (difference u v z x).

Lemma sizes : length x = states m /\ length z = states m /\
  length v = unknowns m /\ length u = unknowns m.
Proof.
  clear Hm. destruct m; cbn in *; decompose [and] Sx; decompose [and] Sz; subst; cbn; auto.
Qed.
Lemma split_zeta : zeta = minus u v ++ minus z x.
Proof. destruct sizes as [_ [_ [A B]]]. apply minus_app. congruence. Qed.
Lemma zeta_length : length zeta = (unknowns m + states m)%nat.
Proof.
  destruct sizes as [A [B [C D]]]. unfold difference. rewrite minus_length; rewrite !app_length; lia.
Qed.

Lemma zip_cons_at a : forall M z0 z, length a = length M ->
  at_ (zip cons a M) (z0 :: z) = plus (map (fun c => val c * z0) a) (at_ M z).
Proof.
  induction a as [|c a IH]; intros [|row M] z0 z1 H; try discriminate; [reflexivity|].
  cbn [zip]. rewrite !at_row, IH by (now injection H). reflexivity.
Qed.
Lemma next_state : minus z' x' = at_ (moves m) zeta.
Proof.
  pose proof sizes as [Lx [Lz [Lv Lu]]]. pose proof zeta_length as Lzeta.
  pose proof split_zeta as Split. pose proof Hm as Hm'. unfold model_ok in Hm'.
  apply andb_prop in Hm' as [H1 H2]. apply andb_prop in H1 as [H0 H1]. apply Nat.ltb_lt in H0.
  apply andb_prop in H2 as [_ H2].
  destruct m as [a|p n scale range ts|e1 e2 e3 a shift|maps into next out]; cbn [step moves states unknowns] in *.
  - decompose [and] Sx; decompose [and] Sz; subst. unfold difference. cbn [app].
    destruct x as [|x0 xs]; [cbn in Lx; lia|]. destruct z as [|z0 zs]; [cbn in Lz; lia|].
    cbn [hd tl length] in *. rewrite minus_plus.
    + destruct a as [|a0 a]; [cbn in Lx; lia|]. cbn [length pred] in *.
      change (minus (z0 :: zs) (x0 :: xs)) with (z0 - x0 :: minus zs xs). rewrite zip_cons_at.
      2:{ rewrite app_length. cbn.
          assert (U : forall k, length (units k) = k).
          { induction k as [|k IH]; cbn; auto. now rewrite map_length, IH. }
          rewrite U. cbn. lia. }
      assert (E : at_ (units (length a) ++ [repeat nzero (length a)]) (minus zs xs)
        = minus zs xs ++ [0]).
      { unfold at_, image, vals. rewrite !map_app. cbn [map]. rewrite dot_zeros. f_equal.
        apply at_units. rewrite minus_length; lia. }
      rewrite E. injection Lx as Lx. injection Lz as Lz.
      assert (G : forall (f g : list R) a b, length f = length a -> length g = length b ->
        length f = length g ->
        minus (plus f a) (plus g b) = plus (minus f g) (minus a b)).
      { clear. unfold minus, plus. induction f as [|f0 f IH]; intros [|g0 g] [|a0 a] [|b0 b] A B C;
          try discriminate; cbn; auto. rewrite IH by (cbn in *; congruence). f_equal. ring. }
      rewrite G; try (cbn; rewrite !map_length, app_length; cbn; lia).
      2:{ cbn. now rewrite !map_length. }
      rewrite minus_app by congruence.
      change (minus [0] [0]) with [0 - 0]. replace (0 - 0) with 0 by ring. f_equal.
      generalize (a0 :: a). clear. induction l as [|c l IH]; cbn; auto. unfold minus in *. cbn.
      rewrite IH. f_equal. ring.
    + unfold plus. rewrite zip_length; rewrite map_length; [congruence|].
      rewrite app_length; cbn in *; lia.
    + unfold plus. rewrite zip_length; rewrite map_length; [congruence|].
      rewrite app_length; cbn in *; lia.
  - decompose [and] Sx; decompose [and] Sz; subst z' x'. rewrite minus_firstn, at_firstn.
    now rewrite at_units.
  - decompose [and] Sx; decompose [and] Sz; subst z' x'. rewrite minus_app by congruence.
    unfold difference. rewrite minus_app by congruence.
    destruct v as [|v0 [|]]; try discriminate. destruct u as [|u0 [|]]; try discriminate.
    change (minus [u0] [v0]) with [u0 - v0]. cbn [app]. rewrite at_row, at_cons. f_equal.
    + cbn [map dot]. rewrite dot_zeros, val_none. ring.
    + fold (vals shift). fold (at_ shift x). fold (at_ shift z).
      rewrite minus_plus by (rewrite at_length; auto). symmetry. apply at_minus. congruence.
  - decompose [and] Sx; decompose [and] Sz; subst z' x'.
    change (image (map (map val) next)) with (at_ next).
    rewrite minus_plus by (rewrite at_length; auto). symmetry. apply at_minus.
    rewrite !app_length. congruence.
Qed.
Lemma difference_of_outputs : minus q y = at_ (seen m) zeta /\ length q = outputs m /\ length y = outputs m.
Proof.
  pose proof sizes as [Lx [Lz [Lv Lu]]]. pose proof zeta_length as Lzeta.
  pose proof split_zeta as Split. pose proof Hm as Hm'. unfold model_ok in Hm'.
  apply andb_prop in Hm' as [H1 H2]. apply andb_prop in H1 as [H0 H1]. apply Nat.ltb_lt in H0.
  apply andb_prop in H2 as [_ H2].
  destruct m as [a|p n scale range ts|e1 e2 e3 a shift|maps into next out]; cbn [step seen states unknowns outputs] in *.
  - decompose [and] Sx; decompose [and] Sz; subst. split; [|auto].
    destruct x as [|x0 xs]; [cbn in Lx; lia|]. destruct z as [|z0 zs]; [cbn in Lz; lia|].
    unfold difference, minus. cbn [app zip hd]. rewrite at_row. cbn [map dot].
    rewrite dot_zeros, val_none. cbn. f_equal. ring.
  - decompose [and] Sx; decompose [and] Sz; subst q y. apply andb_prop in H2 as [H2 _].
    apply andb_prop in H2 as [_ H2]. apply Nat.eqb_eq in H2.
    assert (Ls : forall t : list R, length t = p -> length (zip Rmult (map val scale) t) = p).
    { intros t Ht. rewrite zip_length; rewrite map_length; congruence. }
    split; [|split; unfold plus; rewrite zip_length; rewrite Ls; auto; congruence].
    rewrite minus_plus by (rewrite Ls; congruence).
    assert (E : at_ (zip vscale scale (firstn p (units (p + n)))) zeta
      = zip Rmult (map val scale) (at_ (firstn p (units (p + n))) zeta)).
    { generalize (firstn p (units (p + n))). clear. induction scale as [|c scale IH];
        intros [|row M]; [reflexivity..|]. cbn [zip map]. now rewrite !at_row, dot_vscale, IH. }
    rewrite E, at_firstn, at_units by auto. rewrite Split.
    rewrite firstn_app, firstn_all2 by (rewrite minus_length; lia).
    replace (p - length (minus u v))%nat with O by (rewrite minus_length; lia).
    cbn [firstn]. rewrite app_nil_r. clear. revert u v. unfold minus.
    induction scale as [|c scale IH]; intros [|u0 u] [|v0 v]; cbn; auto. rewrite IH. f_equal. ring.
  - decompose [and] Sx; decompose [and] Sz; subst. split; [|auto].
    destruct v as [|v0 [|]]; try discriminate. destruct u as [|u0 [|]]; try discriminate.
    unfold difference, minus. cbn [app zip hd]. rewrite at_row. cbn [map dot].
    rewrite dot_zeros, val_none. cbn. f_equal. ring.
  - decompose [and] Sx; decompose [and] Sz; subst q y.
    change (image (map (map val) out)) with (at_ out). split.
    + rewrite minus_plus by (rewrite at_length; auto). symmetry. apply at_minus.
      rewrite !app_length. congruence.
    + unfold plus. split; rewrite zip_length; rewrite at_length; auto.
Qed.

(* What each map adds to the difference is a slope of it times the difference before. *)
Lemma slopes_between maps : forall a b, forallb map_ok maps = true -> length a = length maps ->
  length b = length maps -> exists sigma, in_box sigma (map slope_range maps) /\
    minus (zip mapped maps a) (zip mapped maps b) = zip Rmult sigma (minus a b).
Proof.
  induction maps as [|f maps IH]; intros [|a0 a] [|b0 b] H La Lb; try discriminate.
  { exists []. split; [constructor|reflexivity]. }
  cbn [forallb] in H. apply andb_prop in H as [Hf H].
  destruct (IH a b H ltac:(now injection La) ltac:(now injection Lb)) as [sigma [Hs E]].
  destruct (mapped_slope f b0 a0 Hf) as [s [Hs0 E0]]. exists (s :: sigma). split.
  - constructor; auto.
  - unfold minus in *. cbn [zip]. now rewrite E, E0.
Qed.

Lemma weighted_minus ts i a b : length a = length b ->
  weighted ts w (minus a b) i = weighted ts w a i - weighted ts w b i.
Proof.
  intros H. induction ts as [|[e C] ts IH]; cbn [weighted]; [ring|]. rewrite IH, dot_minus by auto. ring.
Qed.
Lemma valued_weighted p k ts z0 c : forallb (fun t => shaped p k (snd t)) ts = true ->
  valued ts w (fun M => dot c (at_ M z0)) = dot c (map (weighted ts w z0) (seq 0 p)).
Proof.
  induction ts as [|[e M] ts IH]; cbn [forallb valued snd]; intros H.
  - cbn [weighted]. generalize (seq 0 p). clear. induction c as [|c0 c IH]; intros [|i l]; cbn; auto.
    rewrite <- IH. ring.
  - apply andb_prop in H as [H1 H2]. rewrite IH by auto. apply shaped_is in H1 as [H1 _].
    assert (E : at_ M z0 = map (fun i => dot (map val (nth i M [])) z0) (seq 0 p)).
    { clear - H1. subst p. induction M as [|row M IH]; [reflexivity|]. rewrite at_row, IH.
      cbn [length seq map nth]. f_equal. rewrite <- seq_shift, map_map. reflexivity. }
    rewrite E. generalize (seq 0 p). cbn [weighted]. clear.
    intros l. revert c. induction l as [|i l IH]; intros [|c0 c]; cbn; try ring.
    rewrite <- IH. ring.
Qed.

(* At a leaf that was accepted and holds w, every form is nonnegative. *)
Lemma forms_nonnegative forms t : on_leaves (leaf_ok m forms) t (box_of m) = true ->
  forall base post, In base forms -> 0 <= total base (zeta ++ post).
Proof.
  intros Ht base post Hb. pose proof sizes as [Lx [Lz [Lv Lu]]]. pose proof zeta_length as Lzeta.
  pose proof split_zeta as Split. pose proof Hm as Hm'. unfold model_ok in Hm'.
  apply andb_prop in Hm' as [H1 H2]. apply andb_prop in H1 as [H0 H1]. apply Nat.ltb_lt in H0.
  apply andb_prop in H2 as [_ H2].
  assert (Hbox : exists w', in_box w' (box_of m) /\
    forall box stated vs, in_box w' box -> vertices_at m box stated = Some vs ->
    settled (steepening m) vs zeta).
  { destruct m as [a|p n scale range ts|e1 e2 e3 a shift|maps into next out]; cbn [step box_of steepening vertices_of] in *.
    - exists []. split; [constructor|]. intros box [st|] vs _ Hv; [discriminate|]. injection Hv as <-.
      intros c l _ H. specialize (H [] (or_introl eq_refl)).
      cbn in H. rewrite dot_nil_r in H. lra.
    - decompose [and] Sx; decompose [and] Sz. exists w. split; auto. apply andb_prop in H2 as [_ H2].
      assert (Z1 : forall i, In i (seq 0 p) -> weighted ts w zeta i = 0).
      { intros i Hi. apply in_seq in Hi. unfold difference.
        rewrite weighted_minus by (rewrite !app_length; lia).
        match goal with A : forall i, _ -> weighted ts w (v ++ x) i + _ = 0,
          B : forall i, _ -> weighted ts w (u ++ z) i + _ = 0 |- _ =>
          specialize (A i ltac:(lia)); specialize (B i ltac:(lia)) end. lra. }
      intros box [st|] vs Hw Hv.
      { destruct p as [|[|p]]; try discriminate. specialize (Z1 O (or_introl eq_refl)).
        destruct zeta as [|z0 zs] eqn:Ez; [discriminate|].
        exact (between_settled n box st ts vs w z0 zs Hv Hw H2 Z1). }
      injection Hv as <-. intros c l _ H'.
      pose proof (vertices_bound l zeta box ts c w Hw H') as B.
      rewrite (valued_weighted p (p + n)) in B by auto.
      assert (Z0 : forall l, dot l (map (weighted ts w zeta) (seq 0 p)) = 0); [|rewrite Z0 in B; lra].
      { intros k. revert Z1. generalize (seq 0 p). clear. intros js. revert k.
        induction js as [|i js IH]; intros [|k0 k] Z1; cbn; auto.
        rewrite (Z1 i) by now left. rewrite IH; [ring|]. intros; apply Z1; now right. }
    - exists []. split; [constructor|]. intros box [st|] vs _ Hv; [discriminate|]. injection Hv as <-.
      intros c l Hl H. specialize (H _ (or_introl eq_refl)).
      decompose [and] Sx; decompose [and] Sz. rewrite Split in *.
      destruct v as [|v0 [|]]; try discriminate. destruct u as [|u0 [|]]; try discriminate.
      change (minus [u0] [v0]) with [u0 - v0] in *. cbn [hd app] in *.
      rewrite at_row in H. cbn [map dot] in H. change (at_ [] _) with (@nil R) in H.
      rewrite dot_minus in H by congruence.
      set (ax := dot (map val a) x) in *. set (az := dot (map val a) z) in *.
      set (r0 := hd 0 r) in *. cbn [hd] in Hl.
      assert (Eq : val e1 * (u0 - v0) + val e2 * (u0 ^ 2 - v0 ^ 2) + val e3 * (u0 ^ 3 - v0 ^ 3)
        + (az - ax) = 0) by lra.
      unfold least in H. destruct (fst e3 =? 0)%Z eqn:E3.
      + apply Z.eqb_eq in E3. cbn in H2. apply Bool.orb_prop in H2 as [H2|H2].
        { apply Z.ltb_lt in H2. lia. }
        apply Z.eqb_eq in H2.
        assert (Z0 : forall e, fst e = 0%Z -> val e = 0).
        { intros e He. unfold val. rewrite He. unfold Rdiv. ring. }
        rewrite (Z0 e2), (Z0 e3) in Eq by auto.
        replace (val e1 * (u0 - v0) + (az - ax)) with 0 in H by lra.
        destruct l as [|l0 l]; cbn [dot] in H; rewrite ?dot_nil_r in H; lra.
      + destruct (Hl eq_refl) as [s [Hs ->]]. cbn [dot] in H. cbn in H2.
        rewrite Bool.orb_false_r in H2. apply Z.ltb_lt in H2.
        assert (P3 : 0 < val e3).
        { unfold val. apply Rmult_lt_0_compat; [now apply (IZR_lt 0)|].
          now apply Rinv_0_lt_compat, IZR_lt. }
        rewrite val_sub, val_div, !val_mul in H by (cbn [nmul fst]; lia).
        replace (val (3%Z, 1%positive)) with 3 in H by (unfold val; cbn; field).
        set (nu := u0 - v0) in *. set (m0 := val e1 - val e2 * val e2 / (3 * val e3)) in *.
        set (sigma := val e1 + val e2 * (u0 + v0) + val e3 * (u0 * u0 + u0 * v0 + v0 * v0)).
        assert (Es : az - ax = - (sigma * nu)) by (unfold sigma, nu; lra).
        assert (M : m0 <= sigma).
        { unfold m0, sigma.
          assert (0 <= 3 * val e3 * (val e2 * (u0 + v0) + val e3 * (u0 * u0 + u0 * v0 + v0 * v0))
            + val e2 * val e2).
          { replace (_ + _) with ((val e2 + 3 / 2 * val e3 * (u0 + v0)) ^ 2
              + 3 / 4 * (val e3 * (u0 - v0)) ^ 2) by field.
            pose proof (pow2_ge_0 (val e2 + 3 / 2 * val e3 * (u0 + v0))).
            pose proof (pow2_ge_0 (val e3 * (u0 - v0))). lra. }
          assert (T : 0 < 3 * val e3) by lra.
          apply (Rmult_le_reg_l (3 * val e3)); auto.
          replace (3 * val e3 * (val e1 - val e2 * val e2 / (3 * val e3)))
            with (3 * val e3 * val e1 - val e2 * val e2) by (field; lra). lra. }
        rewrite Es in H. replace (c + (s * nu * (m0 * nu + - (sigma * nu)) + 0))
          with (c - s * ((sigma - m0) * (nu * nu))) in H by ring.
        assert (0 <= s * ((sigma - m0) * (nu * nu))).
        { apply Rmult_le_pos; auto. apply Rmult_le_pos; [lra|]. apply Rle_0_sqr. }
        lra.
    - cbn [states unknowns] in Lx, Lz, Lv, Lu, Lzeta.
      apply andb_prop in H2 as [Hmaps Hinto]. apply shaped_is in Hinto as [Linto _].
      destruct Sx as [_ [_ [_ [_ [Lw [Ev _]]]]]]. destruct Sz as [_ [_ [_ [_ [_ [Eu _]]]]]].
      change (image (map (map val) into)) with (at_ into) in *.
      assert (Larg : forall a, length (plus (at_ into a) w) = length maps).
      { intros a. unfold plus. rewrite zip_length; rewrite at_length; congruence. }
      destruct (slopes_between maps _ _ Hmaps (Larg (u ++ z)) (Larg (v ++ x))) as [sigma [Hs E]].
      exists sigma. split; [exact Hs|]. intros box [st|] vs Hbox Hv; [discriminate|]. injection Hv as <-.
      intros c l _ H.
      assert (Ls : length sigma = length maps).
      { apply Forall2_length in Hs. now rewrite map_length in Hs. }
      assert (Lb : length sigma = length box) by (clear - Hbox; now apply Forall2_length in Hbox).
      set (us := firstn (length maps) (units (length maps + length next))) in *.
      assert (Eus : at_ us zeta = minus u v).
      { unfold us. rewrite at_firstn, at_units by auto. rewrite Split.
        rewrite firstn_app, firstn_all2 by (rewrite minus_length; lia).
        replace (length maps - length (minus u v))%nat with O by (rewrite minus_length; lia).
        cbn [firstn]. now rewrite app_nil_r. }
      apply (corners_settled zeta box sigma us into c l); auto.
      + rewrite <- Lb, Ls, <- (at_length us zeta), Eus, minus_length; congruence.
      + congruence.
      + rewrite <- Eu, <- Ev in E. rewrite Eus, E. f_equal.
        rewrite minus_plus by (rewrite at_length; congruence). symmetry. apply at_minus.
        rewrite !app_length. congruence. }
  destruct Hbox as [w' [Hw' Hs]].
  destruct (leaf_of _ t _ w' Ht Hw') as [box [stated [Ns [Hok Hin]]]].
  unfold leaf_ok in Hok. destruct (vertices_at m box stated) as [vs|] eqn:Evs; [|discriminate].
  specialize (Hs box stated vs Hin Evs). apply andb_prop in Hok as [Hlen Hok]. apply Nat.eqb_eq in Hlen.
  rewrite forallb_forall in Hok.
  assert (G : exists N, In (base, N) (combine forms Ns)).
  { clear - Hb Hlen. revert Ns Hlen Hb. induction forms as [|f forms IH]; intros [|N Ns] H Hb;
      try discriminate; [destruct Hb|]. destruct Hb as [->|Hb]; [exists N; now left|].
    destruct (IH Ns) as [N' HN]; auto. exists N'. now right. }
  destruct G as [N HN]. specialize (Hok _ HN). cbn [fst snd] in Hok.
  apply (positive_total _ _ _ _ _ _ _ Hok); auto.
  intros _ E. rewrite E in Lzeta. cbn in Lzeta. lia.
Qed.
End Two.

(* Everything that is decided of a tube. [W]: R of the file. *)
Definition definite (k : nat) (P : matrix) : bool :=
  andb (shaped k k P) (semidefinite true (triangle (block O (1%Z, 2%positive) P))).
Definition decrease (m : model) (rho : num) (P L W : matrix) : pairs :=
  supply (unknowns m) (states m) rho P W ++ flow (moves m) L P.
Definition forms_of (m : model) (t : tube) : list pairs :=
  let base := supply (unknowns m) (states m) (fading t) (storage t) (weight t) in
  decrease m (fading t) (storage t) (gain t) (weight t)
    :: zip (fun row e => base ++ output (fst row) (snd row) e)
         (combine (seen m) (units (outputs m))) (tau t).
Definition wide_enough (t : tube) (tau width : num) : bool :=
  andb (andb (0 <? fst tau)%Z (0 <? fst width)%Z)
    (negb (num_ltb (nmul tau (nmul width width)) (nadd (nmul (fading t) (inlet t)) (top t)))).
Definition tube_ok (m : model) (t : tube) (proof : tree) : bool :=
  andb (andb (andb (model_ok m) (on_leaves (leaf_ok m (forms_of m t)) proof (box_of m)))
      (andb (shaped (states m) (outputs m) (gain t)) (definite (states m) (storage t))))
    (andb (andb (definite (outputs m) (weight t)) (Nat.eqb (length (tau t)) (outputs m)))
      (andb (andb (Nat.eqb (length (widths t)) (outputs m)) (forallb (fun e => wide_enough t (fst e) (snd e))
          (combine (tau t) (widths t))))
        (andb (andb (0 <? fst (fading t))%Z (negb (num_ltb none (fading t)))) (0 <=? fst (inlet t))%Z))).

Lemma definite_shaped k P : definite k P = true -> shaped k k P = true.
Proof. intros H. now apply andb_prop in H as [H _]. Qed.
Lemma num_le a b : num_ltb a b = false -> val b <= val a.
Proof.
  destruct a as [p q], b as [p' q']. unfold num_ltb, val; cbn [fst snd]. intros H. apply Z.ltb_ge in H.
  apply IZR_le in H. rewrite !mult_IZR in H.
  assert (0 < IZR (Zpos q)) by now apply IZR_lt. assert (0 < IZR (Zpos q')) by now apply IZR_lt.
  apply (Rmult_le_reg_r (IZR (Zpos q) * IZR (Zpos q'))). { now apply Rmult_lt_0_compat. }
  replace (IZR p' / _ * _) with (IZR p' * IZR (Zpos q)) by (field; lra).
  replace (IZR p / _ * _) with (IZR p * IZR (Zpos q')) by (field; lra). exact H.
Qed.
Lemma val_positive a : (0 < fst a)%Z -> 0 < val a.
Proof.
  intros H. unfold val. apply Rmult_lt_0_compat; [now apply (IZR_lt 0)|].
  now apply Rinv_0_lt_compat, IZR_lt.
Qed.
Lemma minus_plus_left a b c : length a = length b -> length c = length a ->
  minus (plus a c) b = plus (minus a b) c.
Proof.
  unfold minus, plus. revert b c. induction a as [|x a IH]; intros [|y b] [|z c] H1 H2;
    try discriminate; cbn in *; auto. rewrite IH by lia. f_equal. ring.
Qed.
Lemma nth_plus a : forall b j, length a = length b -> nth j (plus a b) 0 = nth j a 0 + nth j b 0.
Proof.
  unfold plus. induction a as [|x a IH]; intros [|y b] [|j] H; try discriminate; cbn; try ring.
  apply IH. now injection H.
Qed.
Lemma nth_minus a : forall b j, length a = length b -> nth j (minus a b) 0 = nth j a 0 - nth j b 0.
Proof.
  unfold minus. induction a as [|x a IH]; intros [|y b] [|j] H; try discriminate; cbn; try ring.
  apply IH. now injection H.
Qed.

(* One step of simulation and observer. *)
Lemma one_step m d r w x v x' y z u z' q rho P L W e forms proof : model_ok m = true ->
  step m d r x w v x' y -> step m d r z w u z' q ->
  on_leaves (leaf_ok m forms) proof (box_of m) = true -> In (decrease m rho P L W) forms ->
  shaped (states m) (states m) P = true -> shaped (length e) (length e) W = true ->
  length L = states m ->
  V P (minus (plus z' (image (vals L) e)) x') <= val rho * V P (minus z x) + V W e.
Proof.
  intros Hm Sx Sz Ht Hin HP HW HL.
  pose proof (forms_nonnegative m d r w x v x' y z u z' q Hm Sx Sz forms proof Ht _ e Hin) as Q.
  pose proof (next_state m d r w x v x' y z u z' q Hm Sx Sz) as N.
  pose proof (sizes m d r w x v x' y z u z' q Sx Sz) as [Lx [Lz [Lv Lu]]].
  pose proof (zeta_length m d r w x v x' y z u z' q Sx Sz) as Lzeta.
  pose proof Hm as Hm'. unfold model_ok in Hm'. apply andb_prop in Hm' as [H1 _].
  apply andb_prop in H1 as [_ H1].
  unfold decrease in Q. rewrite total_app in Q.
  rewrite (total_flow _ _ _ _ _ (unknowns m + states m) (states m)) in Q by auto.
  rewrite (split_zeta m d r w x v x' y z u z' q Sx Sz) in Q at 1.
  assert (Lu' : length (minus u v) = unknowns m) by (rewrite minus_length; congruence).
  assert (Lz' : length (minus z x) = states m) by (rewrite minus_length; congruence).
  rewrite <- Lu', <- Lz' in Q at 1. rewrite total_supply in Q by (rewrite ?Lz'; auto).
  rewrite <- N in Q.
  assert (Lx' : length (at_ (moves m) (difference u v z x)) = states m).
  { rewrite at_length. now apply shaped_is in H1 as [H1 _]. }
  assert (Both : length z' = states m /\ length x' = states m).
  { clear - Sx Sz Lx Lz Lv Lu H1 Hm.
    unfold model_ok in Hm. apply andb_prop in Hm as [A _]. apply andb_prop in A as [A _].
    apply Nat.ltb_lt in A. apply shaped_is in H1 as [H1 _].
    destruct m as [a|p n scale range ts|e1 e2 e3 a shift|maps into next out]; cbn [step states unknowns moves] in *;
      decompose [and] Sx; decompose [and] Sz; subst z' x'.
    - unfold plus. split; rewrite !zip_length; rewrite ?map_length, ?app_length; cbn; try lia;
        try (rewrite zip_length; rewrite ?map_length, ?app_length; cbn; destruct x, z; cbn in *; lia);
        destruct x, z; cbn in *; lia.
    - rewrite !firstn_length, !app_length. lia.
    - cbn [length] in H1. rewrite map_length in H1. rewrite !app_length. unfold plus.
      rewrite !zip_length; unfold image; rewrite ?map_length; lia.
    - unfold plus, image. split; rewrite zip_length; rewrite ?map_length; congruence. }
  destruct Both as [Lz1 Lx1]. change (image (vals L) e) with (at_ L e).
  rewrite minus_plus_left by (rewrite ?at_length; congruence). lra.
Qed.

Theorem tube_proved m t proof : tube_ok m t proof = true -> stays_near m t.
Proof.
  unfold tube_ok. intros H. apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [H1 H3].
  apply andb_prop in H1 as [Hm Ht]. apply andb_prop in H3 as [HL HP]. apply definite_shaped in HP.
  apply andb_prop in H2 as [H2 H4]. apply andb_prop in H2 as [HW Htau]. apply definite_shaped in HW.
  apply andb_prop in H4 as [H4 H5]. apply andb_prop in H4 as [Hw Hwide]. apply andb_prop in H5 as [H5 Hin].
  apply andb_prop in H5 as [Hr0 Hr1]. apply Nat.eqb_eq in Htau, Hw. apply Z.ltb_lt, val_positive in Hr0.
  apply Bool.negb_true_iff, num_le in Hr1. rewrite val_none in Hr1. apply Z.leb_le, val_nonneg in Hin.
  destruct (shaped_is _ _ _ HL) as [LL _].
  intros [d r w x v y z u e measured Sx Sz] g Hg Hone H0 k HE j Hj.
  cbn [Tubes.x Tubes.z Tubes.y Tubes.e Tubes.measured] in *.
  rewrite Hw in Hj.
  assert (Le : forall i, length (e i) = outputs m).
  { intros i. destruct (Sz i) as [z' [q [St [_ [_ L]]]]]. rewrite L.
    now destruct (difference_of_outputs m (d i) (r i) (w i) (x i) (v i) (x (S i)) (y i) (z i) (u i) z' q Hm (Sx i) St)
      as [_ [A _]]. }
  assert (Hs : forall i, V (storage t) (minus (z i) (x i)) <= val (fading t) ^ i * val (inlet t) + energy t e i).
  { induction i as [|i IH]; [cbn [pow energy]; lra|]. destruct (Sz i) as [z' [q [St [E _]]]].
    pose proof (one_step m (d i) (r i) (w i) (x i) (v i) (x (S i)) (y i) (z i) (u i) z' q (fading t) (storage t) (gain t)
      (weight t) (e i) _ proof Hm (Sx i) St Ht (or_introl eq_refl) HP) as A.
    rewrite Le in A. specialize (A HW LL). rewrite E. cbn [energy pow]. unfold vals in A.
    pose proof (Rmult_le_compat_l (val (fading t)) _ _ (Rlt_le _ _ Hr0) IH). lra. }
  destruct (Sz k) as [z' [q [St [_ [M Lm]]]]].
  pose proof (forms_nonnegative m (d k) (r k) (w k) (x k) (v k) (x (S k)) (y k) (z k) (u k) z' q Hm (Sx k) St _ proof Ht) as Q.
  pose proof (difference_of_outputs m (d k) (r k) (w k) (x k) (v k) (x (S k)) (y k) (z k) (u k) z' q Hm (Sx k) St) as [D [Lq Ly]].
  pose proof (sizes m (d k) (r k) (w k) (x k) (v k) (x (S k)) (y k) (z k) (u k) z' q (Sx k) St) as [Lx [Lz [Lv Lu]]].
  pose proof (zeta_length m (d k) (r k) (w k) (x k) (v k) (x (S k)) (y k) (z k) (u k) z' q (Sx k) St) as Lzeta.
  pose proof (split_zeta m (d k) (r k) (w k) (x k) (v k) (x (S k)) (y k) (z k) (u k) z' q (Sx k) St) as Split.
  set (zeta := difference (u k) (v k) (z k) (x k)) in *.
  pose proof Hm as Hm'. unfold model_ok in Hm'. apply andb_prop in Hm' as [_ B].
  apply andb_prop in B as [B _]. destruct (shaped_is _ _ _ B) as [LH RH].
  set (row := nth j (seen m) []). set (unit := nth j (units (outputs m)) []).
  assert (LU : length (units (outputs m)) = outputs m).
  { generalize (outputs m). induction n as [|n IH]; cbn; auto. now rewrite map_length, IH. }
  assert (Form : In (supply (unknowns m) (states m) (fading t) (storage t) (weight t)
      ++ output row unit (nth j (tau t) nzero)) (forms_of m t)).
  { right. set (base := supply _ _ _ _ _).
    assert (G : forall (rows us : matrix) (ts : list num) j, length rows = length us ->
      length rows = length ts -> (j < length rows)%nat ->
      In (base ++ output (nth j rows []) (nth j us []) (nth j ts nzero))
        (zip (fun row e => base ++ output (fst row) (snd row) e) (combine rows us) ts)).
    { clear. induction rows as [|row rows IH]; intros [|u us] [|t0 ts] [|j] H1 H2 H3; cbn in *;
        try discriminate; try lia; [now left|]. right. apply IH; lia. }
    apply G; congruence. }
  specialize (Q _ (e k) Form). rewrite total_app, total_output in Q.
  2:{ rewrite Lzeta. apply RH. apply nth_In. congruence. }
  assert (Lu' : length (minus (u k) (v k)) = unknowns m) by (rewrite minus_length; congruence).
  assert (Lz' : length (minus (z k) (x k)) = states m) by (rewrite minus_length; congruence).
  rewrite Split in Q at 1. rewrite <- Lu', <- Lz' in Q at 1.
  rewrite total_supply in Q by (rewrite ?Lz', ?Le; auto).
  assert (Out : dot (map val row) zeta + dot (map val unit) (e k)
    = nth j (measured k) 0 - nth j (y k) 0).
  { rewrite M, nth_plus by congruence. unfold row, unit.
    assert (N : forall (rows : matrix) v, nth j (at_ rows v) 0 = dot (map val (nth j rows [])) v).
    { clear. intros rows v. revert j. induction rows as [|r0 rows IH]; intros [|j]; cbn; auto. }
    rewrite <- !N, at_units by auto. fold zeta in D. rewrite <- D, nth_minus by congruence. ring. }
  rewrite Out in Q. set (o := nth j (measured k) 0 - nth j (y k) 0) in *.
  specialize (Hs k). set (rho := val (fading t)) in *.
  assert (Wide : 0 < val (nth j (tau t) nzero) /\ 0 < val (nth j (widths t) nzero) /\
    rho * val (inlet t) + val (top t)
      <= val (nth j (tau t) nzero) * (val (nth j (widths t) nzero) * val (nth j (widths t) nzero))).
  { rewrite forallb_forall in Hwide.
    specialize (Hwide (nth j (tau t) nzero, nth j (widths t) nzero)).
    assert (In (nth j (tau t) nzero, nth j (widths t) nzero) (combine (tau t) (widths t))) as I.
    { rewrite <- combine_nth by congruence. apply nth_In. rewrite combine_length. lia. }
    specialize (Hwide I). unfold wide_enough in Hwide. cbn [fst snd] in Hwide.
    apply andb_prop in Hwide as [A C]. apply andb_prop in A as [A1 A2].
    apply Z.ltb_lt, val_positive in A1. apply Z.ltb_lt, val_positive in A2.
    apply Bool.negb_true_iff, num_le in C. rewrite val_add, !val_mul in C. auto. }
  destruct Wide as [T0 [W0 Wd]]. change (0%Z, 1%positive) with nzero.
  set (ta := val (nth j (tau t) nzero)) in *. set (wd := val (nth j (widths t) nzero)) in *.
  cbn [energy] in HE. fold rho in HE.
  assert (Pow : 0 <= rho ^ S k <= rho).
  { split; [apply pow_le; lra|]. cbn. clear - Hr0 Hr1.
    assert (0 <= rho ^ k <= 1).
    { induction k as [|k IH]; cbn; [lra|]. split; [apply Rmult_le_pos; lra|].
      pose proof (Rmult_le_compat rho 1 (rho ^ k) 1 ltac:(lra) ltac:(lra) Hr1 ltac:(lra)). lra. }
    pose proof (Rmult_le_compat_l rho (rho ^ k) 1 ltac:(lra) ltac:(lra)). lra. }
  assert (Sq : ta * o * o <= ta * (wd * wd) * g k).
  { pose proof (Rmult_le_compat_l rho _ _ (Rlt_le _ _ Hr0) Hs) as A.
    assert (B0 : rho * (rho ^ k * val (inlet t)) <= rho * val (inlet t)).
    { pose proof (Rmult_le_compat_r (val (inlet t)) _ _ Hin (proj2 Pow)) as C. cbn in C. lra. }
    assert (C : ta * o * o <= rho * val (inlet t) + val (top t) * g k) by lra.
    destruct Hone as [Z0|One].
    - rewrite Z0 in *. specialize (Hg k).
      pose proof (Rmult_le_compat_r (g k) _ _ Hg Wd). lra.
    - rewrite One in *. lra. }
  assert (o * o <= wd * wd * g k).
  { apply (Rmult_le_reg_l ta); auto. lra. }
  rewrite <- (sqrt_square wd) by lra. rewrite <- sqrt_mult by (auto; nra).
  rewrite <- sqrt_Rsqr_abs. apply sqrt_le_1_alt. unfold Rsqr. exact H.
Qed.

Definition tubes_ok (m : model) (ts : list tube) (proofs : list tree) : bool :=
  andb (Nat.eqb (length ts) (length proofs)) (forallb (fun e => tube_ok m (fst e) (snd e)) (combine ts proofs)).
Theorem tubes_proved m ts proofs : tubes_ok m ts proofs = true -> Forall (stays_near m) ts.
Proof.
  unfold tubes_ok. intros H. apply andb_prop in H as [L H]. apply Nat.eqb_eq in L. revert proofs L H.
  induction ts as [|t ts IH]; intros [|p proofs] L H; try discriminate; constructor;
    cbn in H; apply andb_prop in H as [H1 H2].
  - exact (tube_proved m t p H1).
  - apply (IH proofs); auto.
Qed.

(* Stability is a tube's decrease without innovations. *)
Definition stability_ok (m : model) (P : matrix) (rate : num) (proof : tree) : bool :=
  andb (andb (andb (model_ok m) (definite (states m) P))
      (on_leaves (leaf_ok m [decrease m (nmul rate rate) P (repeat [] (states m)) []]) proof (box_of m)))
    (andb (0 <? fst rate)%Z (num_ltb rate none)).
Theorem stability_proved m P rate proof : stability_ok m P rate proof = true -> forgets m P rate.
Proof.
  unfold stability_ok. intros H d r w x v y z u q Sx Sz k. apply andb_prop in H as [H1 H2].
  apply andb_prop in H1 as [H1 Ht]. apply andb_prop in H1 as [Hm HP]. apply definite_shaped in HP.
  induction k as [|k IH]; [cbn [pow]; lra|].
  pose proof (one_step m (d k) (r k) (w k) (x k) (v k) (x (S k)) (y k) (z k) (u k) (z (S k)) (q k)
    (nmul rate rate) P (repeat [] (states m)) [] [] _ proof Hm (Sx k) (Sz k) Ht (or_introl eq_refl)
    HP eq_refl (repeat_length _ _)) as A.
  rewrite val_mul in A.
  assert (E : plus (z (S k)) (image (vals (repeat [] (states m))) []) = z (S k)).
  { pose proof (sizes m (d (S k)) (r (S k)) (w (S k)) (x (S k)) (v (S k)) (x (S (S k))) (y (S k)) (z (S k)) (u (S k))
      (z (S (S k))) (q (S k)) (Sx (S k)) (Sz (S k))) as [_ [Lz _]].
    rewrite <- Lz. unfold plus. generalize (z (S k)). clear.
    induction l as [|a l IH]; [reflexivity|]. cbn [length repeat].
    change (a + 0 :: zip Rplus l (image (vals (repeat [] (length l))) []) = a :: l).
    rewrite IH. f_equal. ring. }
  assert (Z0 : V [] [] = 0) by reflexivity. rewrite E, Z0 in A.
  replace (val rate * val rate) with (val rate ^ 2) in A by ring.
  rewrite <- tech_pow_Rmult.
  pose proof (Rmult_le_compat_l _ _ _ (pow2_ge_0 (val rate)) IH). lra.
Qed.
End Near.
