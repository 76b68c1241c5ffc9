(* Norms of lists of reals; how far monomials of one degree are apart at two points, all together:
   by the words that they are made of. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Forms Claim Tubes Samples.
Import ListNotations.
Open Scope R_scope.

Lemma dot_self v : 0 <= dot v v.
Proof. induction v as [|a v IH]; cbn; [lra|]. pose proof (Rle_0_sqr a). unfold Rsqr in *. lra. Qed.
Lemma norm_nonneg v : 0 <= norm v.
Proof. apply sqrt_pos. Qed.
Lemma norm_squared v : norm v * norm v = dot v v.
Proof. apply sqrt_sqrt, dot_self. Qed.
Lemma norm_below v c : 0 <= c -> dot v v <= c * c -> norm v <= c.
Proof.
  intros Hc H. unfold norm. rewrite <- (sqrt_square c) by auto. now apply sqrt_le_1_alt.
Qed.
Lemma dot_sym a : forall b, dot a b = dot b a.
Proof. induction a as [|x a IH]; intros [|y b]; cbn; auto. rewrite IH. ring. Qed.

(* (sum of a b)^2 <= (sum of a^2 / n) (sum of n b^2) *)
Fixpoint triple (l : list (R * R * R)) : R :=
  match l with [] => 0 | (a, b, _) :: l' => a * b + triple l' end.
Fixpoint first_part (l : list (R * R * R)) : R :=
  match l with [] => 0 | (a, _, n) :: l' => a * a / n + first_part l' end.
Fixpoint second_part (l : list (R * R * R)) : R :=
  match l with [] => 0 | (_, b, n) :: l' => n * (b * b) + second_part l' end.
Lemma square_below x y : 0 <= y -> x * x <= y * y -> x <= y.
Proof. intros Hy H. apply Rsqr_incr_0_var; auto. Qed.
Lemma cauchy l : Forall (fun e => 0 < snd e) l ->
  0 <= first_part l /\ 0 <= second_part l /\ triple l * triple l <= first_part l * second_part l.
Proof.
  induction 1 as [|[[a b] n] l Hn H IH]; cbn; [lra|]. cbn in Hn. destruct IH as [A [B C]].
  set (p := first_part l) in *. set (q := second_part l) in *. set (t := triple l) in *.
  pose proof (Rle_0_sqr a) as Ha. pose proof (Rle_0_sqr b) as Hb. unfold Rsqr in *.
  assert (Hi : 0 < / n) by now apply Rinv_0_lt_compat.
  assert (U : 0 <= a * a / n) by (apply Rmult_le_pos; lra).
  assert (W : 0 <= n * (b * b)) by (apply Rmult_le_pos; lra).
  split; [lra|]. split; [lra|].
  pose proof (Rmult_le_pos _ _ U B) as UB. pose proof (Rmult_le_pos _ _ A W) as AW.
  assert (D : 2 * (a * b * t) <= a * a / n * q + p * (n * (b * b))).
  { apply square_below; [lra|].
    assert (E : a * a / n * (n * (b * b)) = a * a * (b * b)) by (field; lra).
    pose proof (Rle_0_sqr (a * a / n * q - p * (n * (b * b)))) as G. unfold Rsqr in G.
    pose proof (Rmult_le_compat_l (4 * (a * a * (b * b))) _ _ ltac:(nra) C) as J.
    replace (a * a * (b * b)) with (a * a / n * (n * (b * b))) in J at 2. nra. }
  assert (E : a * a / n * (n * (b * b)) = a * b * (a * b)) by (field; lra). nra.
Qed.
Lemma dot_below a b : dot a b * dot a b <= dot a a * dot b b.
Proof.
  pose (l := zip (fun x y => (x, y, 1)) a b).
  assert (H : Forall (fun e : R * R * R => 0 < snd e) l).
  { unfold l. clear l. revert b. induction a as [|x a IH]; intros [|y b]; cbn; constructor; auto.
    cbn. lra. }
  destruct (cauchy l H) as [A [B C]].
  assert (T : triple l = dot a b).
  { unfold l. clear. revert b. induction a as [|x a IH]; intros [|y b]; cbn; auto. now rewrite IH. }
  assert (P : first_part l <= dot a a).
  { unfold l. clear. revert b. induction a as [|x a IH]; intros [|y b]; cbn; try lra.
    - pose proof (dot_self (x :: a)) as D. cbn in D. lra.
    - specialize (IH b). lra. }
  assert (Q : second_part l <= dot b b).
  { unfold l. clear. revert b. induction a as [|x a IH]; intros [|y b]; cbn; try lra.
    - pose proof (dot_self (y :: b)) as D. cbn in D. lra.
    - specialize (IH b). lra. }
  rewrite T in C. pose proof (dot_self a). pose proof (dot_self b).
  apply (Rle_trans _ _ _ C). apply Rmult_le_compat; auto.
Qed.
Lemma dot_norms a b : Rabs (dot a b) <= norm a * norm b.
Proof.
  apply square_below.
  - apply Rmult_le_pos; apply norm_nonneg.
  - rewrite <- Rabs_mult, Rabs_right.
    + replace (norm a * norm b * (norm a * norm b)) with ((norm a * norm a) * (norm b * norm b)) by ring.
      rewrite !norm_squared. apply dot_below.
    + apply Rle_ge. apply (Rle_0_sqr (dot a b)).
Qed.
Lemma norm_plus a b : length a = length b -> norm (plus a b) <= norm a + norm b.
Proof.
  intros L. pose proof (norm_nonneg a). pose proof (norm_nonneg b).
  apply norm_below; [lra|]. unfold plus.
  rewrite dot_plus by auto. rewrite (dot_sym _ a), (dot_sym _ b), !dot_plus by auto.
  rewrite (dot_sym b a). pose proof (dot_norms a b) as D. pose proof (Rle_abs (dot a b)).
  pose proof (norm_squared a). pose proof (norm_squared b). nra.
Qed.

(* t^(m-1) + t^(m-2) q + ... + q^(m-1) *)
Fixpoint spread (m : nat) (t q : R) : R :=
  match m with O => 0 | S k => t ^ k + q * spread k t q end.
Lemma spread_other m t q : spread (S m) t q = q ^ m + t * spread m t q.
Proof. induction m as [|m IH]; cbn [spread pow] in *; [ring|]. rewrite IH at 1. ring. Qed.
Lemma spread_apart m t q : (t - q) * spread m t q = t ^ m - q ^ m.
Proof.
  induction m as [|m IH]; [cbn; ring|].
  cbn [spread pow]. replace ((t - q) * (t ^ m + q * spread m t q))
    with ((t - q) * t ^ m + q * ((t - q) * spread m t q)) by ring.
  rewrite IH. ring.
Qed.
Lemma spread_nonneg m t q : 0 <= t -> 0 <= q -> 0 <= spread m t q.
Proof.
  intros Ht Hq. induction m as [|m IH]; cbn; [lra|].
  apply Rplus_le_le_0_compat; [now apply pow_le|]. now apply Rmult_le_pos.
Qed.
Lemma spread_mono m t q t' q' : 0 <= t <= t' -> 0 <= q <= q' -> spread m t q <= spread m t' q'.
Proof.
  intros Ht Hq. induction m as [|m IH]; cbn; [lra|].
  apply Rplus_le_compat; [now apply pow_incr|].
  apply Rmult_le_compat; try lra. apply spread_nonneg; lra.
Qed.
Lemma spread_least t q : 0 <= t -> 0 <= q -> forall m,
  INR m * (t * q) ^ pred m <= spread m t q * spread m t q /\
  INR (S m) * (t * q) ^ m <= spread (S m) t q * spread (S m) t q.
Proof.
  intros Ht Hq. induction m as [|m [A B]].
  { cbn. lra. }
  split; [exact B|].
  assert (E : spread (S (S m)) t q = t ^ S m + q ^ S m + t * q * spread m t q).
  { change (spread (S (S m)) t q) with (t ^ S m + q * spread (S m) t q).
    rewrite spread_other. cbn [pow]. ring. }
  rewrite E. clear E B. set (a := t ^ S m). set (b := q ^ S m). set (c := t * q * spread m t q).
  assert (Ha : 0 <= a) by now apply pow_le. assert (Hb : 0 <= b) by now apply pow_le.
  assert (Htq : 0 <= t * q) by now apply Rmult_le_pos.
  assert (Hc : 0 <= c) by (apply Rmult_le_pos; auto; now apply spread_nonneg).
  assert (AB : a * b = (t * q) ^ S m) by (unfold a, b; now rewrite Rpow_mult_distr).
  assert (C : INR m * (t * q) ^ S m <= c * c).
  { destruct m as [|m]. { cbn [INR]. rewrite Rmult_0_l. now apply Rmult_le_pos. }
    cbn [pred] in A. unfold c.
    replace ((t * q) ^ S (S m)) with ((t * q) * (t * q) * (t * q) ^ m) by (cbn [pow]; ring).
    pose proof (Rmult_le_compat_l ((t * q) * (t * q)) _ _ ltac:(now apply Rmult_le_pos) A). lra. }
  rewrite !S_INR. rewrite <- AB in *.
  pose proof (Rle_0_sqr (a - b)) as G. unfold Rsqr in G.
  pose proof (Rmult_le_pos _ _ Ha Hc). pose proof (Rmult_le_pos _ _ Hb Hc).
  pose proof (Rmult_le_pos _ _ Ha Hb). nra.
Qed.
(* (t q)^m - c^m *)
Lemma power_gap y c : forall m, 0 <= y -> Rabs c <= y -> y ^ m - c ^ m <= (y - c) * (INR m * y ^ pred m).
Proof.
  intros m Hy Hc. pose proof (Rle_abs c).
  rewrite <- spread_apart. apply Rmult_le_compat_l; [lra|].
  induction m as [|m IH]; [cbn; lra|]. rewrite spread_other, S_INR. cbn [pred].
  assert (P : c ^ m <= y ^ m).
  { apply Rle_trans with (Rabs (c ^ m)); [apply Rle_abs|]. rewrite <- RPow_abs. apply pow_incr.
    split; auto. apply Rabs_pos. }
  destruct m as [|m]. { cbn in *. lra. }
  cbn [pred] in IH. pose proof (Rmult_le_compat_l y _ _ Hy IH). cbn [pow] in *. nra.
Qed.
Lemma apart_below (m : nat) (z y : list R) : length z = length y ->
  dot z z ^ m - 2 * dot z y ^ m + dot y y ^ m
  <= (norm (minus z y) * spread m (norm z) (norm y)) * (norm (minus z y) * spread m (norm z) (norm y)).
Proof.
  intros L.
  assert (N : norm (minus z y) * norm (minus z y) = dot z z - 2 * dot z y + dot y y).
  { rewrite norm_squared. unfold minus. revert y L.
    induction z as [|a z IH]; intros [|b y] L; try discriminate; cbn; [ring|].
    rewrite IH by (now injection L). ring. }
  set (t := norm z) in *. set (q := norm y) in *. set (P := spread m t q) in *.
  replace (_ * P * (_ * P)) with ((norm (minus z y) * norm (minus z y)) * (P * P)) by ring.
  rewrite N. rewrite <- (norm_squared z), <- (norm_squared y). fold t q.
  pose proof (norm_nonneg z) as Ht. pose proof (norm_nonneg y) as Hq. fold t in Ht. fold q in Hq.
  pose proof (dot_norms z y) as C. fold t q in C. set (c := dot z y) in *.
  pose proof (spread_apart m t q) as A. fold P in A.
  pose proof (power_gap (t * q) c m (Rmult_le_pos _ _ Ht Hq) C) as G.
  destruct (spread_least t q Ht Hq m) as [Q _]. fold P in Q.
  pose proof (Rle_abs c). assert (Hgap : 0 <= t * q - c) by lra.
  pose proof (Rmult_le_compat_l _ _ _ Hgap Q) as J.
  rewrite !Rpow_mult_distr in *.
  replace ((t * t - 2 * c + q * q) * (P * P))
    with (((t - q) * P) * ((t - q) * P) + 2 * ((t * q - c) * (P * P))) by ring.
  rewrite A. lra.
Qed.

(* Exponents, words and how many words have the same exponents. *)
Fixpoint zfact (n : nat) : Z := match n with O => 1%Z | S k => (Z.of_nat n * zfact k)%Z end.
Fixpoint zfacts (e : list nat) : Z := match e with [] => 1%Z | k :: e' => (zfact k * zfacts e')%Z end.
Definition words (e : list nat) : R := IZR (zfact (list_sum e)) / IZR (zfacts e).

Lemma zfact_pos n : 0 < IZR (zfact n).
Proof.
  induction n as [|n IH]; cbn [zfact]; [lra|]. rewrite mult_IZR. apply Rmult_lt_0_compat; auto.
  apply IZR_lt. lia.
Qed.
Lemma zfacts_pos e : 0 < IZR (zfacts e).
Proof.
  induction e as [|k e IH]; cbn [zfacts]; [lra|]. rewrite mult_IZR. apply Rmult_lt_0_compat; auto.
  apply zfact_pos.
Qed.
Lemma words_pos e : 0 < words e.
Proof. apply Rdiv_lt_0_compat; [apply zfact_pos|apply zfacts_pos]. Qed.

Lemma power_more a : forall e i, length e = length a -> (i < length e)%nat ->
  power (update i S e) a = nth i a 0 * power e a.
Proof.
  induction a as [|y a IH]; intros [|k e] [|i] L Hi; cbn in *; try lia; try discriminate.
  - ring.
  - rewrite IH by lia. ring.
Qed.
Lemma power_product z : forall y e, length z = length y ->
  power e (zip Rmult z y) = power e z * power e y.
Proof.
  induction z as [|a z IH]; intros [|b y] [|k e] L; cbn; try discriminate; try ring.
  rewrite IH by (now injection L). rewrite Rpow_mult_distr. ring.
Qed.

(* The sum of g over all words of length m. *)
Definition sum_to (n : nat) (f : nat -> R) : R := fold_right (fun i acc => f i + acc) 0 (seq 0 n).
Fixpoint over (n m : nat) (g : list nat -> R) : R :=
  match m with
  | O => g (repeat O n)
  | S k => sum_to n (fun i => over n k (fun e => g (update i S e)))
  end.
Lemma sum_same n f g : (forall i, (i < n)%nat -> f i = g i) -> sum_to n f = sum_to n g.
Proof.
  intros H. unfold sum_to. assert (G : forall i, In i (seq 0 n) -> f i = g i).
  { intros i Hi. apply in_seq in Hi. apply H. lia. }
  induction (seq 0 n) as [|i l IH]; cbn; auto. rewrite IH, G; auto; [now left|].
  intros j Hj. apply G. now right.
Qed.
Lemma sum_below n f g : (forall i, (i < n)%nat -> f i <= g i) -> sum_to n f <= sum_to n g.
Proof.
  intros H. unfold sum_to. assert (G : forall i, In i (seq 0 n) -> f i <= g i).
  { intros i Hi. apply in_seq in Hi. apply H. lia. }
  induction (seq 0 n) as [|i l IH]; cbn; [lra|]. apply Rplus_le_compat; [apply G; now left|].
  apply IH. intros j Hj. apply G. now right.
Qed.
Lemma sum_plus n f g : sum_to n (fun i => f i + g i) = sum_to n f + sum_to n g.
Proof. unfold sum_to. induction (seq 0 n) as [|i l IH]; cbn; [ring|]. rewrite IH. ring. Qed.
Lemma sum_scaled n f c : sum_to n (fun i => f i * c) = sum_to n f * c.
Proof. unfold sum_to. induction (seq 0 n) as [|i l IH]; cbn; [ring|]. rewrite IH. ring. Qed.
Lemma sum_shift n f : sum_to (S n) f = f O + sum_to n (fun i => f (S i)).
Proof.
  unfold sum_to. cbn [seq fold_right]. f_equal. rewrite <- seq_shift.
  induction (seq 0 n) as [|i l IH]; cbn; auto. now rewrite IH.
Qed.
Lemma over_same n m : forall g h, (forall e, length e = n -> g e = h e) -> over n m g = over n m h.
Proof.
  induction m as [|m IH]; intros g h H; cbn; [apply H, repeat_length|].
  apply sum_same. intros i _. apply IH. intros e He. apply H. now rewrite update_length.
Qed.
Lemma over_plus n m : forall g h, over n m (fun e => g e + h e) = over n m g + over n m h.
Proof.
  induction m as [|m IH]; intros g h; cbn; auto. rewrite <- sum_plus. apply sum_same.
  intros i _. apply IH.
Qed.
Lemma over_scaled n m : forall g c, over n m (fun e => g e * c) = over n m g * c.
Proof.
  induction m as [|m IH]; intros g c; cbn; auto. rewrite <- sum_scaled. apply sum_same.
  intros i _. apply IH.
Qed.
Lemma over_power a m : over (length a) m (fun e => power e a) = fold_right Rplus 0 a ^ m.
Proof.
  induction m as [|m IH]; cbn [over pow].
  { clear. induction a as [|y a IH]; cbn; auto. rewrite IH. ring. }
  rewrite <- IH. set (o := over _ m _).
  rewrite (sum_same _ _ (fun i => nth i a 0 * o)).
  - rewrite sum_scaled. f_equal. clear. induction a as [|y a IH]; [reflexivity|].
    cbn [length fold_right]. rewrite sum_shift. cbn [nth]. now rewrite <- IH.
  - intros i Hi. rewrite Rmult_comm. unfold o. rewrite <- over_scaled. apply over_same.
    intros e He. rewrite power_more by congruence. ring.
Qed.

Lemma list_sum_pred e : forall i, (0 < nth i e O)%nat -> S (list_sum (update i pred e)) = list_sum e.
Proof.
  induction e as [|k e IH]; intros [|i] H; cbn [nth update] in *; try lia.
  - destruct k; [lia|]. reflexivity.
  - change (S (k + list_sum (update i pred e)) = (k + list_sum e)%nat). rewrite <- (IH i H). lia.
Qed.
Lemma zfacts_pred e : forall i, (0 < nth i e O)%nat ->
  zfacts e = (Z.of_nat (nth i e O) * zfacts (update i pred e))%Z.
Proof.
  induction e as [|k e IH]; intros [|i] H; cbn [nth update zfacts] in *; try lia.
  - destruct k; [lia|]. cbn [pred zfact]. ring.
  - rewrite (IH i H). ring.
Qed.
Lemma words_pred e i : (0 < nth i e O)%nat ->
  words (update i pred e) = words e * INR (nth i e O) / INR (list_sum e).
Proof.
  intros H. unfold words. rewrite (zfacts_pred e i H), <- (list_sum_pred e i H).
  cbn [zfact]. rewrite !mult_IZR, <- !INR_IZR_INZ.
  pose proof (zfact_pos (list_sum (update i pred e))). pose proof (zfacts_pos (update i pred e)).
  assert (0 < INR (nth i e O)) by now apply lt_0_INR.
  assert (0 < INR (S (list_sum (update i pred e)))) by (apply lt_0_INR; lia).
  field. repeat split; lra.
Qed.
Lemma update_back e : forall i, (0 < nth i e O)%nat -> update i S (update i pred e) = e.
Proof.
  induction e as [|k e IH]; intros [|i] H; cbn in *; try lia.
  - destruct k; [lia|reflexivity].
  - now rewrite IH.
Qed.
Lemma sum_exponents e : sum_to (length e) (fun i => INR (nth i e O)) = INR (list_sum e).
Proof.
  induction e as [|k e IH]; [reflexivity|]. cbn [length list_sum fold_right].
  rewrite sum_shift, plus_INR. cbn [nth]. f_equal. exact IH.
Qed.
Fixpoint counted (g : list nat -> R) (E : list (list nat)) : R :=
  match E with [] => 0 | e :: E' => words e * g e + counted g E' end.
Definition one_less (i : nat) (E : list (list nat)) : list (list nat) :=
  map (update i pred) (filter (fun e => Nat.ltb 0 (nth i e O)) E).
Lemma counted_over n m : forall g E, (forall e, 0 <= g e) -> NoDup E ->
  Forall (fun e => length e = n /\ list_sum e = m) E -> counted g E <= over n m g.
Proof.
  induction m as [|m IH]; intros g E Hg HE H.
  - cbn [over]. assert (Z0 : forall e, length e = n -> list_sum e = O -> e = repeat O n).
    { clear. induction n as [|n IH]; intros [|k e] L S0; try discriminate; [reflexivity|].
      change (k + list_sum e = 0)%nat in S0. injection L as L. cbn [repeat].
      f_equal; [lia|]. apply IH; auto. lia. }
    destruct E as [|e [|e' E]]; cbn.
    + apply Hg.
    + destruct (Forall_inv H) as [L S0]. pose proof (Z0 e L S0) as ->.
      assert (W : words (repeat O n) = 1).
      { unfold words. rewrite S0. clear. cbn [zfact].
        assert (G : zfacts (repeat O n) = 1%Z) by (induction n; cbn [repeat zfacts zfact]; lia).
        rewrite G. lra. }
      rewrite W. pose proof (Hg (repeat O n)). lra.
    + destruct (Forall_inv H) as [L S0]. destruct (Forall_inv (Forall_inv_tail H)) as [L' S0'].
      inversion HE as [|? ? N _]. exfalso. apply N. left.
      now rewrite (Z0 e L S0), (Z0 e' L' S0').
  - cbn [over].
    apply Rle_trans with (sum_to n (fun i => counted (fun e => g (update i S e)) (one_less i E))).
    2:{ apply sum_below. intros i Hi. apply IH; [intros; apply Hg| |].
        - unfold one_less. assert (G : NoDup (filter (fun e => Nat.ltb 0 (nth i e O)) E)) by now apply NoDup_filter.
          assert (P : forall e, In e (filter (fun e => Nat.ltb 0 (nth i e O)) E) -> (0 < nth i e O)%nat).
          { intros e He. apply filter_In in He as [_ He]. now apply Nat.ltb_lt in He. }
          revert G P. generalize (filter (fun e => Nat.ltb 0 (nth i e O)) E). clear.
          induction l as [|e l IH]; intros G P; cbn; constructor.
          + intros Hin. apply in_map_iff in Hin as [e' [E' Hin]]. inversion G as [|? ? N _]; subst.
            apply N. rewrite <- (update_back e i), <- E', update_back; auto;
              apply P; [now right|now left].
          + inversion G; subst. apply IH; auto. intros e' He'. apply P. now right.
        - unfold one_less. apply Forall_forall. intros e' He'. apply in_map_iff in He' as [e [<- He]].
          apply filter_In in He as [He Hp]. apply Nat.ltb_lt in Hp. rewrite Forall_forall in H.
          destruct (H e He) as [L S0]. rewrite update_length. split; auto.
          pose proof (list_sum_pred e i Hp). lia. }
    apply Req_le. clear HE IH Hg. induction H as [|e E [L S0] H IH].
    { cbn. unfold sum_to. induction (seq 0 n); cbn; lra. }
    cbn [counted]. rewrite IH.
    rewrite (sum_same n (fun i => counted (fun e => g (update i S e)) (one_less i (e :: E)))
      (fun i => INR (nth i e O) * (words e * g e / INR (S m))
      + counted (fun e => g (update i S e)) (one_less i E))).
    + rewrite sum_plus, sum_scaled. apply (f_equal (fun v => v + _)).
      rewrite <- L at 1. rewrite sum_exponents, S0.
      assert (P : 0 < INR (S m)) by (apply lt_0_INR; lia). set (c := INR (S m)) in *.
      clearbody c. clear - P. field. lra.
    + intros i Hi. unfold one_less. cbn [filter]. destruct (Nat.ltb_spec 0 (nth i e O)) as [P|P].
      * cbn [map counted]. rewrite words_pred, update_back, S0 by auto. unfold Rdiv. ring.
      * replace (nth i e O) with O by lia. cbn [INR]. ring.
Qed.

(* Monomials of degree m, each with a number. *)
Fixpoint valued (l : list (list nat * R)) (z : list R) : R :=
  match l with [] => 0 | (e, q) :: l' => q * power e z + valued l' z end.
Fixpoint weight (l : list (list nat * R)) : R :=
  match l with [] => 0 | (e, q) :: l' => q * q / words e + weight l' end.
Lemma fold_dot z : forall y, length z = length y -> fold_right Rplus 0 (zip Rmult z y) = dot z y.
Proof.
  induction z as [|a z IH]; intros [|b y] L; try discriminate; cbn; auto. rewrite IH; auto.
Qed.
Theorem valued_apart n m l c z y : length z = n -> length y = n -> NoDup (map fst l) ->
  Forall (fun t => length (fst t) = n /\ list_sum (fst t) = m) l ->
  0 <= c -> weight l <= c * c ->
  Rabs (valued l z - valued l y) <= c * (norm (minus z y) * spread m (norm z) (norm y)).
Proof.
  intros Lz Ly HN HF Hc HW.
  pose (t := map (fun p : list nat * R => (snd p, power (fst p) z - power (fst p) y, words (fst p))) l).
  assert (Ht : Forall (fun e : R * R * R => 0 < snd e) t).
  { apply Forall_map, Forall_forall. intros p _. cbn. apply words_pos. }
  destruct (cauchy t Ht) as [A [B C]].
  assert (E : triple t = valued l z - valued l y).
  { unfold t. clear. induction l as [|[e q] l IH]; cbn; [ring|]. rewrite IH. ring. }
  assert (W : first_part t = weight l).
  { unfold t. clear. induction l as [|[e q] l IH]; cbn; auto. now rewrite IH. }
  set (g := fun e => (power e z - power e y) * (power e z - power e y)).
  assert (S2 : second_part t = counted g (map fst l)).
  { unfold t. clear. induction l as [|[e q] l IH]; cbn; auto. now rewrite IH. }
  set (D := norm (minus z y) * spread m (norm z) (norm y)).
  assert (HD : 0 <= D).
  { apply Rmult_le_pos; [apply norm_nonneg|]. apply spread_nonneg; apply norm_nonneg. }
  assert (G : second_part t <= D * D).
  { rewrite S2. eapply Rle_trans.
    { apply (counted_over n m); auto.
      - intros e. apply (Rle_0_sqr (power e z - power e y)).
      - apply Forall_map. exact HF. }
    eapply Rle_trans; [|apply apart_below; congruence]. apply Req_le.
    rewrite (over_same n m g (fun e => power e (zip Rmult z z) + power e (zip Rmult z y) * -2
      + power e (zip Rmult y y))).
    - rewrite !over_plus, over_scaled.
      pose proof (over_power (zip Rmult z z) m) as O1. pose proof (over_power (zip Rmult z y) m) as O2.
      pose proof (over_power (zip Rmult y y) m) as O3.
      rewrite zip_length in O1, O2, O3 by congruence. rewrite fold_dot in O1, O2, O3 by congruence.
      rewrite Lz in O1, O2. rewrite Ly in O3. rewrite O1, O2, O3. ring.
    - intros e _. unfold g. rewrite !power_product by congruence. ring. }
  rewrite E, W in C. apply square_below.
  - apply Rmult_le_pos; auto.
  - rewrite <- Rabs_mult, Rabs_right by (apply Rle_ge; apply (Rle_0_sqr (valued l z - valued l y))).
    eapply Rle_trans; [exact C|]. replace (c * D * (c * D)) with ((c * c) * (D * D)) by ring.
    rewrite W in A. apply Rmult_le_compat; auto.
Qed.
