(* How far a list of polynomials is apart at two points: a bound on all coefficients of each degree. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Positive Claim Condition Definite Tubes
  Increments Near Samples Words.
Import ListNotations.
Open Scope R_scope.

(* The m-th of [gammas] times far^(m-1) + far^(m-2) near + ... + near^(m-1), all together. *)
Fixpoint stretch (m : nat) (gammas : list num) (far near : R) : R :=
  match gammas with
  | [] => 0
  | g :: rest => val g * spread m far near + stretch (S m) rest far near
  end.

Section Curvature.
Context {K : Ints}.

Fixpoint exponents (n : nat) (m : mono) : list nat :=
  match m with [] => repeat O n | i :: m' => update (pred (Pos.to_nat i)) S (exponents n m') end.

(* Every monomial that occurs, with its coefficients in all of [ps] (over the denominators). *)
Notation table := (list (mono * list I)).
Fixpoint gather (j : nat) (ps : list F) : table :=
  match ps with
  | [] => []
  | p :: ps' =>
      map (fun t => (fst t, repeat izero j ++ [hd izero (snd t)])) (Polynomials.num p)
        ++ gather (S j) ps'
  end.
Definition gathered (ps : list F) : table := sorted add_low (gather 0 ps).

Definition padded (n : nat) (a : list I) : list I := a ++ repeat izero (n - length a).
Definition unit_at (n j : nat) : list I := padded n (repeat izero j ++ [ione]).
(* gamma^2 m! d_i^2 on the diagonal, less e! c c' of each monomial of degree m *)
Definition bending (n m : nat) (dens : list I) (gamma : num) (l : table) : factor :=
  let c := ofZ (fst gamma * fst gamma * zfact m) in
  let d := ofZ (- (Zpos (snd gamma) * Zpos (snd gamma))) in
  zip (fun j e => (imul c (imul e e), unit_at n j)) (seq 0 n) dens
    ++ map (fun t => (imul d (ofZ (zfacts (exponents n (fst t)))), padded n (snd t))) l.
Definition bends (n m : nat) (dens : list I) (gamma : num) (l : table) : bool :=
  let f := bending n m dens gamma l in
  andb (forallb (fun e => Nat.eqb (length (snd e)) n) f) (eliminated false n ione (gram n f)).
Definition of_degree (m : nat) (t : mono * list I) : bool := Nat.eqb (length (fst t)) m.
Fixpoint curved (n m : nat) (dens : list I) (gammas : list num) (l : table) : bool :=
  match gammas with
  | [] => forallb (fun t => forallb (ieqb izero) (snd t)) l
  | g :: rest =>
      andb (andb (0 <=? fst g)%Z (bends n m dens g (filter (of_degree m) l)))
        (curved n (S m) dens rest (filter (fun t => negb (of_degree m t)) l))
  end.
Fixpoint apart (l : list (list nat)) : bool :=
  match l with
  | [] => true
  | e :: l' => andb (negb (existsb (fun f => if list_eq_dec Nat.eq_dec e f then true else false) l'))
      (apart l')
  end.
(* [gammas]: of degrees 1, 2, ... *)
Definition curvature_ok (n : nat) (ps : list F) (gammas : list num) : bool :=
  let l := gathered ps in
  andb (andb (Nat.eqb (length ps) n)
      (forallb (fun t => forallb (fun i => Nat.leb (Pos.to_nat i) n) (fst t)) l))
    (andb (apart (map (fun t => exponents n (fst t)) l))
      (curved n 1 (map den ps) gammas (filter (fun t => negb (of_degree 0 t)) l))).

(* Why. *)
Notation r := Integers.r.
Lemma exponents_length n m : length (exponents n m) = n.
Proof. induction m as [|i m IH]; cbn; [apply repeat_length|]. now rewrite update_length. Qed.
Lemma update_sum e : forall i, (i < length e)%nat -> list_sum (update i S e) = S (list_sum e).
Proof.
  induction e as [|k e IH]; intros [|i] H; cbn [length] in H; try lia; cbn [update].
  - reflexivity.
  - change (k + list_sum (update i S e) = S (k + list_sum e))%nat. rewrite IH by lia. lia.
Qed.
Definition lettered (n : nat) (m : mono) : bool := forallb (fun i => Nat.leb (Pos.to_nat i) n) m.
Lemma exponents_sum n m : lettered n m = true -> list_sum (exponents n m) = length m.
Proof.
  induction m as [|i m IH]; cbn.
  - intros _. induction n; cbn; auto.
  - intros H. apply andb_prop in H as [A B]. apply Nat.leb_le in A.
    rewrite update_sum, IH; auto. rewrite exponents_length. pose proof (Pos2Nat.is_pos i). lia.
Qed.
Lemma power_exponents n m z : lettered n m = true -> length z = n ->
  power (exponents n m) z = mval (env z) m.
Proof.
  intros H Hz. induction m as [|i m IH]; cbn [exponents mval].
  - subst. clear. induction z as [|a z IH]; cbn; auto. rewrite IH. ring.
  - cbn in H. apply andb_prop in H as [A B]. apply Nat.leb_le in A.
    pose proof (Pos2Nat.is_pos i).
    rewrite power_more, IH; auto; rewrite exponents_length; [congruence|lia].
Qed.
Lemma apart_nodup l : apart l = true -> NoDup l.
Proof.
  induction l as [|e l IH]; intros H; constructor; apply andb_prop in H as [A B]; auto.
  intros Hin. apply Bool.negb_true_iff in A. enough (existsb (fun f => if list_eq_dec Nat.eq_dec e f then true else false) l = true) by congruence.
  apply existsb_exists. exists e. split; auto. now destruct (list_eq_dec _ e e).
Qed.
Lemma nodup_filter {A B} (f : A -> B) (p : A -> bool) l : NoDup (map f l) -> NoDup (map f (filter p l)).
Proof.
  induction l as [|a l IH]; intros H; [exact H|]. inversion H as [|? ? N H']; subst.
  cbn [filter]. destruct (p a); cbn [map]; auto. constructor; auto.
  intros Hin. apply N. apply in_map_iff in Hin as [b [E Hb]]. apply in_map_iff. exists b.
  split; auto. now apply filter_In in Hb.
Qed.

Lemma dot_add_low a : forall b y, dot (map r (add_low a b)) y = dot (map r a) y + dot (map r b) y.
Proof.
  induction a as [|c a IH]; intros [|d b] [|y0 y]; cbn [add_low map dot]; try ring.
  rewrite r_add, IH. ring.
Qed.
Lemma dot_zeros_l n : forall y, dot (map r (repeat izero n)) y = 0.
Proof. induction n as [|n IH]; intros [|y0 y]; cbn; auto. rewrite IH, r_zero. ring. Qed.
Lemma dot_padded n a y : dot (map r (padded n a)) y = dot (map r a) y.
Proof.
  unfold padded. generalize (n - length a)%nat as k. revert y.
  induction a as [|c a IH]; intros y k; cbn [app map dot]; [apply dot_zeros_l|].
  destruct y as [|y0 y]; auto. now rewrite IH.
Qed.
Lemma dot_at j c : forall pre y0 y, length pre = j ->
  dot (map r (repeat izero j ++ [c])) (pre ++ y0 :: y) = r c * y0.
Proof.
  induction j as [|j IH]; intros [|p pre] y0 y H; try discriminate; cbn.
  - destruct y; ring.
  - rewrite IH by (now injection H). rewrite r_zero. ring.
Qed.

Definition lifted (n : nat) (y : list R) (l : table) : list (list nat * R) :=
  map (fun t => (exponents n (fst t), dot (map r (snd t)) y)) l.
Definition scaled_by (v : list R) (ps : list F) : list R := zip (fun a p => a / r (den p)) v ps.

Lemma bval_zero a : bval 0 a = r (hd izero a).
Proof.
  destruct a as [|c a]; cbn; [now rewrite r_zero|]. rewrite Rminus_0_r, pow1. ring.
Qed.
Lemma gather_val z : forall ps w, Forall2 (means 0 (env z)) ps w -> forall v pre, length v = length ps ->
  sum_of (fun m a => dot (map r a) (pre ++ scaled_by v ps) * mval (env z) m) (gather (length pre) ps)
  = dot v w.
Proof.
  induction 1 as [|p a ps w [Hd Hp] H IH]; intros [|v0 v] pre L; try discriminate; [reflexivity|].
  injection L as L. cbn [gather dot].
  assert (App : forall (h : mono -> list I -> R) l l', sum_of h (l ++ l') = sum_of h l + sum_of h l').
  { clear. intros h l l'. induction l as [|[m a] l IH]; cbn; [ring|]. rewrite IH. ring. }
  rewrite App. unfold scaled_by in *. cbn [zip].
  specialize (IH v (pre ++ [v0 / r (den p)]) L). rewrite app_length in IH. cbn [length] in IH.
  rewrite Nat.add_1_r, <- app_assoc in IH. cbn [app] in IH. rewrite IH.
  apply (f_equal (fun u => u + _)).
  assert (G : forall l, sum_of (fun m a => dot (map r a) (pre ++ v0 / r (den p) :: zip (fun a p => a / r (den p)) v ps) * mval (env z) m)
      (map (fun t => (fst t, repeat izero (length pre) ++ [hd izero (snd t)])) l)
    = v0 / r (den p) * pval 0 (env z) l).
  { induction l as [|[m c] l IHl]; cbn [map sum_of pval fst snd]; [ring|].
    rewrite IHl, dot_at, bval_zero by auto. ring. }
  rewrite G, Hp. field. lra.
Qed.
Lemma gathered_val n ps w v z : Forall2 (means 0 (env z)) ps w -> length v = length ps -> length z = n ->
  forallb (fun t => lettered n (fst t)) (gathered ps) = true ->
  valued (lifted n (scaled_by v ps) (gathered ps)) z = dot v w.
Proof.
  intros H L Hz HL. rewrite <- (gather_val z ps w H v [] L). cbn [app length].
  rewrite <- (sorted_sum add_low).
  2:{ intros m a b. rewrite dot_add_low. ring. }
  fold (gathered ps). induction (gathered ps) as [|[m a] l IH]; [reflexivity|].
  cbn in HL. apply andb_prop in HL as [A B]. cbn [lifted map valued sum_of fst snd].
  unfold lifted in IH. now rewrite IH, power_exponents.
Qed.

Fixpoint squares_of (f : factor) (y : list R) : R :=
  match f with
  | [] => 0
  | (w, row) :: f' => r w * (dot (map r row) y * dot (map r row) y) + squares_of f' y
  end.
Lemma gram_is n f y : length y = n -> forallb (fun e => Nat.eqb (length (snd e)) n) f = true ->
  triangular n (gram n f) /\ form (reals (gram n f)) y y = squares_of f y.
Proof.
  intros Hy. induction f as [|[w row] f IH]; intros H.
  { destruct (zeros_val n y) as [T E]. auto. }
  cbn in H. apply andb_prop in H as [A B]. apply Nat.eqb_eq in A. destruct (IH B) as [T E].
  destruct (outer_val n 0 w row (gram n f) y T Hy) as [T' E']; [auto|].
  change (gram n ((w, row) :: f)) with (Positive.outer (n - length row)%nat w row (gram n f)).
  replace (n - length row)%nat with O by lia. split; auto.
  rewrite E', E. cbn [skipn squares_of]. ring.
Qed.
Lemma squares_app f g y : squares_of (f ++ g) y = squares_of f y + squares_of g y.
Proof. induction f as [|[w row] f IH]; cbn; [ring|]. rewrite IH. ring. Qed.

Lemma bends_weight n m ps gamma l v : bends n m (map den ps) gamma l = true ->
  length ps = n -> length v = n -> Forall (fun p => 0 < r (den p)) ps ->
  forallb (fun t => andb (lettered n (fst t)) (of_degree m t)) l = true ->
  weight (lifted n (scaled_by v ps) l) <= (val gamma * norm v) * (val gamma * norm v).
Proof.
  unfold bends. intros H Lp Lv Hd Hl. apply andb_prop in H as [H1 H2].
  set (y := scaled_by v ps) in *.
  assert (Ly : length y = n) by (unfold y, scaled_by; rewrite zip_length; congruence).
  assert (Q : 0 <= form (reals (gram n (bending n m (map den ps) gamma l))) y y).
  { eapply eliminated_val; [|exact H2]. rewrite r_one. lra. }
  destruct (gram_is n _ y Ly H1) as [_ E]. rewrite E in Q. clear E H1 H2.
  unfold bending in Q. rewrite squares_app in Q.
  assert (D : squares_of (zip (fun j e => (imul (ofZ (fst gamma * fst gamma * zfact m)) (imul e e), unit_at n j))
      (seq 0 n) (map den ps)) y = IZR (fst gamma) * IZR (fst gamma) * IZR (zfact m) * dot v v).
  { assert (G : forall ps v pre, length v = length ps -> Forall (fun p => 0 < r (den p)) ps ->
      squares_of (zip (fun j e => (imul (ofZ (fst gamma * fst gamma * zfact m)) (imul e e), unit_at n j))
        (seq (length pre) (length ps)) (map den ps)) (pre ++ scaled_by v ps)
      = IZR (fst gamma) * IZR (fst gamma) * IZR (zfact m) * dot v v).
    { clear. induction ps as [|p ps IH]; intros [|v0 v] pre L H; try discriminate.
      { cbn. ring. }
      injection L as L. inversion H as [|? ? Hp H']; subst.
      unfold scaled_by in *. cbn [length seq map zip squares_of dot].
      specialize (IH v (pre ++ [v0 / r (den p)]) L H'). rewrite app_length in IH. cbn [length] in IH.
      rewrite Nat.add_1_r, <- app_assoc in IH. cbn [app] in IH. rewrite IH.
      unfold unit_at. rewrite dot_padded, dot_at, !r_mul, r_ofZ, !mult_IZR, r_one by auto.
      field. lra. }
    rewrite <- (G ps v [] ltac:(congruence) Hd). cbn [length app]. now rewrite Lp. }
  assert (S2 : squares_of (map (fun t => (imul (ofZ (- (Zpos (snd gamma) * Zpos (snd gamma))))
        (ofZ (zfacts (exponents n (fst t)))), padded n (snd t))) l) y
    = - (IZR (Zpos (snd gamma)) * IZR (Zpos (snd gamma))) * (IZR (zfact m) * weight (lifted n y l))).
  { clear - Hl. induction l as [|[e a] l IH]; cbn [map squares_of lifted weight fst snd]; [ring|].
    cbn in Hl. apply andb_prop in Hl as [A B]. apply andb_prop in A as [A1 A2]. apply Nat.eqb_eq in A2.
    unfold lifted in IH. rewrite (IH B), dot_padded, r_mul, !r_ofZ, opp_IZR, mult_IZR.
    unfold words. rewrite exponents_sum by auto. cbn [fst] in A2. rewrite A2.
    pose proof (zfact_pos m). pose proof (zfacts_pos (exponents n e)). field. lra. }
  fold y in S2. rewrite D, S2 in Q.
  set (W := weight _) in *. unfold val.
  assert (Hq : 0 < IZR (Zpos (snd gamma))) by now apply IZR_lt.
  pose proof (zfact_pos m) as Hm. set (q := IZR (Zpos (snd gamma))) in *. set (p := IZR (fst gamma)) in *.
  replace (p / q * norm v * (p / q * norm v)) with ((p * p * (norm v * norm v)) / (q * q)) by (field; lra).
  rewrite norm_squared. apply (Rmult_le_reg_l (q * q * IZR (zfact m))).
  { apply Rmult_lt_0_compat; auto. now apply Rmult_lt_0_compat. }
  replace (q * q * IZR (zfact m) * (p * p * dot v v / (q * q))) with (IZR (zfact m) * (p * p * dot v v)) by (field; lra).
  lra.
Qed.

Lemma valued_split n y p l z : valued (lifted n y l) z =
  valued (lifted n y (filter p l)) z + valued (lifted n y (filter (fun t => negb (p t)) l)) z.
Proof.
  induction l as [|t l IH]; cbn [filter lifted map valued]; [ring|]. unfold lifted in *.
  destruct (p t); cbn [negb map valued]; rewrite IH; ring.
Qed.
Lemma forallb_filter {A} (f p : A -> bool) l : forallb f l = true -> forallb f (filter p l) = true.
Proof.
  intros H. rewrite forallb_forall in *. intros x Hx. apply filter_In in Hx as [Hx _]. auto.
Qed.
Lemma curved_apart n ps v z z' : length ps = n -> length v = n -> length z = n -> length z' = n ->
  Forall (fun p => 0 < r (den p)) ps -> forall gammas m l,
  curved n m (map den ps) gammas l = true ->
  forallb (fun t => lettered n (fst t)) l = true -> NoDup (map (fun t => exponents n (fst t)) l) ->
  Rabs (valued (lifted n (scaled_by v ps) l) z' - valued (lifted n (scaled_by v ps) l) z)
    <= norm v * (norm (minus z' z) * stretch m gammas (norm z') (norm z)).
Proof.
  intros Lp Lv Lz Lz' Hd. set (y := scaled_by v ps).
  induction gammas as [|g gammas IH]; intros m l H HL HN; cbn [curved stretch] in *.
  - assert (Z0 : forall x, valued (lifted n y l) x = 0).
    { intros x. clearbody y. clear - H. induction l as [|[e a] l IH]; [reflexivity|].
      cbn in H. apply andb_prop in H as [A B]. cbn [lifted map valued fst snd].
      unfold lifted in IH. rewrite (IH B).
      assert (E : dot (map r a) y = 0).
      { clear - A. revert y. induction a as [|c a IH]; intros [|y0 y]; cbn; auto.
        cbn in A. apply andb_prop in A as [A B]. apply r_eqb in A. rewrite r_zero in A.
        rewrite <- A, IH by auto. ring. }
      rewrite E. ring. }
    rewrite !Z0. rewrite Rminus_0_r, Rabs_R0. lra.
  - apply andb_prop in H as [H H3]. apply andb_prop in H as [H1 H2]. apply Z.leb_le in H1.
    rewrite !(valued_split n y (of_degree m) l).
    set (here := filter (of_degree m) l) in *.
    set (more := filter (fun t => negb (of_degree m t)) l) in *.
    pose proof (IH (S m) more H3 (forallb_filter _ _ _ HL) (nodup_filter _ _ _ HN)) as B.
    assert (Hg : 0 <= val g).
    { unfold val. apply Rmult_le_pos; [now apply (IZR_le 0)|]. left. now apply Rinv_0_lt_compat, IZR_lt. }
    assert (Hh : forallb (fun t => andb (lettered n (fst t)) (of_degree m t)) here = true).
    { rewrite forallb_forall in *. intros t Ht. apply filter_In in Ht as [Ht E]. now rewrite E, HL. }
    pose proof (bends_weight n m ps g here v H2 Lp Lv Hd Hh) as W. fold y in W.
    pose proof (norm_nonneg v) as Nv.
    assert (A : Rabs (valued (lifted n y here) z' - valued (lifted n y here) z)
      <= val g * norm v * (norm (minus z' z) * spread m (norm z') (norm z))).
    { apply (valued_apart n m); auto.
      - unfold lifted. rewrite map_map. cbn [fst]. unfold here. now apply nodup_filter.
      - unfold lifted. apply Forall_map, Forall_forall. intros t Ht. cbn [fst].
        rewrite forallb_forall in Hh. specialize (Hh t Ht). apply andb_prop in Hh as [A1 A2].
        split; [apply exponents_length|]. rewrite exponents_sum by auto. now apply Nat.eqb_eq in A2.
      - now apply Rmult_le_pos. }
    set (a' := valued (lifted n y here) z') in *. set (a := valued (lifted n y here) z) in *.
    set (b' := valued (lifted n y more) z') in *. set (b := valued (lifted n y more) z) in *.
    replace (a' + b' - (a + b)) with ((a' - a) + (b' - b)) by ring.
    eapply Rle_trans; [apply Rabs_triang|]. lra.
Qed.

Lemma stretch_mono gammas : forall m far near far' near', Forall (fun g => 0 <= val g) gammas ->
  0 <= far <= far' -> 0 <= near <= near' -> stretch m gammas far near <= stretch m gammas far' near'.
Proof.
  induction gammas as [|g gammas IH]; intros m far near far' near' H Hf Hn; cbn; [lra|].
  inversion H; subst. apply Rplus_le_compat; [|now apply IH].
  apply Rmult_le_compat_l; auto. now apply spread_mono.
Qed.
Lemma curved_nonneg n dens gammas : forall m l, curved n m dens gammas l = true ->
  Forall (fun g => 0 <= val g) gammas.
Proof.
  induction gammas as [|g gammas IH]; intros m l H; constructor; cbn in H;
    apply andb_prop in H as [H H3].
  - apply andb_prop in H as [H1 _]. apply Z.leb_le in H1. unfold val.
    apply Rmult_le_pos; [now apply (IZR_le 0)|]. left. now apply Rinv_0_lt_compat, IZR_lt.
  - now apply IH in H3.
Qed.
Theorem curvature_sound n ps gammas z z' w w' : curvature_ok n ps gammas = true ->
  length z = n -> length z' = n ->
  Forall2 (means 0 (env z)) ps w -> Forall2 (means 0 (env z')) ps w' ->
  Forall (fun g => 0 <= val g) gammas /\
  norm (minus w' w) <= norm (minus z' z) * stretch 1 gammas (norm z') (norm z).
Proof.
  unfold curvature_ok. cbn zeta. intros H Lz Lz' Hw Hw'.
  apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [Lp HL]. apply Nat.eqb_eq in Lp.
  apply andb_prop in H2 as [HN HC]. apply apart_nodup in HN. split; [now apply curved_nonneg in HC|].
  change (forallb (fun t => lettered n (fst t)) (gathered ps) = true) in HL.
  assert (Lw : length w = n) by (apply Condition.Forall2_length in Hw; congruence).
  assert (Lw' : length w' = n) by (apply Condition.Forall2_length in Hw'; congruence).
  set (v := minus w' w). assert (Lv : length v = n) by (unfold v; rewrite minus_length; congruence).
  assert (Hd : Forall (fun p => 0 < r (den p)) ps).
  { clear - Hw. induction Hw as [|p a ps w [Hd _] H IH]; constructor; auto. }
  pose proof (curved_apart n ps v z z' Lp Lv Lz Lz' Hd gammas 1 _ HC (forallb_filter _ _ _ HL)
    (nodup_filter _ _ _ HN)) as A.
  pose proof (gathered_val n ps w v z Hw ltac:(congruence) Lz HL) as E.
  pose proof (gathered_val n ps w' v z' Hw' ltac:(congruence) Lz' HL) as E'.
  rewrite (valued_split n _ (of_degree 0)) in E, E'.
  assert (C0 : forall l x, valued (lifted n (scaled_by v ps) (filter (of_degree 0) l)) x
      = valued (lifted n (scaled_by v ps) (filter (of_degree 0) l)) z \/ length x <> n).
  { intros l x. destruct (Nat.eq_dec (length x) n) as [Lx|]; [left|now right].
    induction l as [|[e a] l IH]; [reflexivity|]. cbn [filter]. destruct (of_degree 0 (e, a)) eqn:D; auto.
    unfold of_degree in D. cbn [fst] in D. destruct e; [|discriminate].
    cbn [lifted map valued fst snd]. unfold lifted in IH. rewrite IH.
    rewrite !power_exponents by auto. reflexivity. }
  destruct (C0 (gathered ps) z') as [C|C]; [|congruence]. clear C0.
  rewrite C in E'. set (c0 := valued (lifted n (scaled_by v ps) (filter (of_degree 0) (gathered ps))) z) in *.
  assert (V : dot v v = dot v w' - dot v w) by (unfold v at 2; apply dot_minus; congruence).
  rewrite <- E, <- E' in V. set (s' := valued _ z') in *. set (s := valued _ z) in *.
  replace (c0 + s' - (c0 + s)) with (s' - s) in V by ring. rewrite <- V in A.
  rewrite <- norm_squared in A. pose proof (norm_nonneg v) as Nv.
  set (B := norm (minus z' z) * stretch 1 gammas (norm z') (norm z)) in *.
  pose proof (Rle_abs (norm v * norm v)).
  destruct (Rle_lt_or_eq_dec 0 (norm v) Nv) as [P|P].
  - apply (Rmult_le_reg_l (norm v)); auto. lra.
  - rewrite <- P. unfold B. apply Rmult_le_pos; [apply norm_nonneg|].
    assert (0 <= stretch 1 gammas 0 0) as Q.
    { apply curved_nonneg in HC. clear - HC. generalize 1%nat as m. induction HC; intros m; cbn; [lra|].
      apply Rplus_le_le_0_compat; auto. apply Rmult_le_pos; auto. apply spread_nonneg; lra. }
    eapply Rle_trans; [exact Q|]. apply stretch_mono; [now apply curved_nonneg in HC| |];
      split; try lra; apply norm_nonneg.
Qed.
End Curvature.
