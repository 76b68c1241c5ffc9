(* Boxes that are halved, and matrix polynomials on them by Bernstein coefficients. *)
From Coq Require Import ZArith Reals List Lra Lia Psatz.
From Verified Require Import Integers Forms Claim Condition Definite Goal Funnel Tubes Increments.
Import ListNotations.
Open Scope R_scope.

(* Stated bounds of one entry, with the weights that prove them (Ends.v). *)
Record stated_ends := Ends {
  low_end : num; high_end : num; low_weights : list num; high_weights : list num }.
(* A box halved, and halved again. *)
Inductive tree := Leaf (stated : option stated_ends) (Ns : list matrix) | Split (i : nat) (lower upper : tree).
Definition middle (a b : num) : num := nmul (1%Z, 2%positive) (nadd a b).
Section Leaves.
Variable ok : list (num * num) -> option stated_ends -> list matrix -> bool.
Fixpoint on_leaves (t : tree) (box : list (num * num)) : bool :=
  match t with
  | Leaf stated Ns => ok box stated Ns
  | Split i lower upper =>
      match nth_error box i with
      | Some (a, b) =>
          andb (on_leaves lower (update i (fun _ => (a, middle a b)) box))
            (on_leaves upper (update i (fun _ => (middle a b, b)) box))
      | None => false
      end
  end.
Lemma halves a b c w box : in_box w box -> forall i, nth_error box i = Some (a, b) ->
  in_box w (update i (fun _ => (a, c)) box) \/ in_box w (update i (fun _ => (c, b)) box).
Proof.
  induction 1 as [|y e w box He H IH]; intros [|i] E; try discriminate; cbn in *.
  - injection E as ->. cbn in He. destruct (Rle_lt_dec y (val c)); [left|right]; constructor; auto;
      cbn; lra.
  - destruct (IH i E) as [A|A]; [left|right]; constructor; auto.
Qed.
Lemma leaf_of t : forall box w, on_leaves t box = true -> in_box w box ->
  exists box' stated Ns, ok box' stated Ns = true /\ in_box w box'.
Proof.
  induction t as [stated Ns|i lower IHl upper IHu]; intros box w H Hw; cbn in H; [eauto|].
  destruct (nth_error box i) as [[a b]|] eqn:E; [|discriminate]. apply andb_prop in H as [H1 H2].
  destruct (halves a b (middle a b) w box Hw i E); eauto.
Qed.
End Leaves.

(* The Bernstein coefficients of a matrix polynomial on a box. In one variable w = lo (1 - s) + hi s:
   w^e = sum of a_k s^k (1 - s)^(d - k). *)
Fixpoint homog (l : list R) (s r : R) : R :=
  match l with [] => 0 | a :: l' => a * r ^ length l' + s * homog l' s r end.
Definition times_line (a b : R) (l : list R) : list R :=
  zip Rplus (map (Rmult a) l ++ [0]) (0 :: map (Rmult b) l).
Lemma homog_add a : forall b s r, length a = length b ->
  homog (zip Rplus a b) s r = homog a s r + homog b s r.
Proof.
  induction a as [|x a IH]; intros [|y b] s r H; try discriminate; cbn; [ring|].
  injection H as H. rewrite IH, zip_length, <- H by auto. ring.
Qed.
Lemma homog_scale c l s r : homog (map (Rmult c) l) s r = c * homog l s r.
Proof. induction l as [|a l IH]; cbn; [ring|]. rewrite IH, map_length. ring. Qed.
Lemma homog_end l s r : homog (l ++ [0]) s r = r * homog l s r.
Proof. induction l as [|a l IH]; cbn; [ring|]. rewrite IH, app_length. cbn. rewrite Nat.add_1_r. cbn. ring. Qed.
Lemma homog_line a b l s r : homog (times_line a b l) s r = (a * r + b * s) * homog l s r.
Proof.
  unfold times_line. rewrite homog_add by (rewrite app_length; cbn; rewrite !map_length; lia).
  rewrite homog_end, homog_scale. cbn. rewrite homog_scale. ring.
Qed.
Lemma homog_nonneg l s r : 0 <= s -> 0 <= r -> Forall (fun a => 0 <= a) l -> 0 <= homog l s r.
Proof.
  intros Hs Hr H. induction H; cbn; [lra|]. pose proof (pow_le r (length l) Hr). nra.
Qed.

Definition by_line (a b : num) (l : list num) : list num :=
  zip nadd (map (nmul a) l ++ [nzero]) (nzero :: map (nmul b) l).
Fixpoint again {A : Type} (k : nat) (f : A -> A) (a : A) : A :=
  match k with O => a | S j => f (again j f a) end.
(* of w^e, in degree d *)
Definition powers (lo hi : num) (d e : nat) : list num :=
  again (d - e) (by_line none none) (again e (by_line lo hi) [none]).
Definition pascal (l : list Z) : list Z := zip Z.add (l ++ [0%Z]) (0%Z :: l).
Definition binomials (d : nat) : list Z := again d pascal [1%Z].

Lemma map_zip {A B C D E F} (f : A -> B -> C) (g : D -> E -> F) (h : C -> F) (i : A -> D) (j : B -> E) :
  (forall a b, h (f a b) = g (i a) (j b)) -> forall a b,
  map h (zip f a b) = zip g (map i a) (map j b).
Proof. intros H. induction a as [|x a IH]; intros [|y b]; cbn; auto. now rewrite H, IH. Qed.
Lemma val_by_line a b l : map val (by_line a b l) = times_line (val a) (val b) (map val l).
Proof.
  unfold by_line, times_line. rewrite (map_zip _ Rplus _ val val) by apply val_add.
  rewrite map_app, !map_map. cbn. rewrite map_map, val_nzero.
  f_equal; [f_equal|f_equal]; apply map_ext; intros; apply val_mul.
Qed.
Lemma IZR_pascal l : map IZR (pascal l) = times_line 1 1 (map IZR l).
Proof.
  unfold pascal, times_line. rewrite (map_zip _ Rplus _ IZR IZR) by apply plus_IZR.
  rewrite map_app. cbn. f_equal; [f_equal|f_equal]; rewrite map_map; apply map_ext; intros; ring.
Qed.
Lemma powers_val lo hi d e s : (e <= d)%nat ->
  homog (map val (powers lo hi d e)) s (1 - s) = (val lo * (1 - s) + val hi * s) ^ e.
Proof.
  intros _. unfold powers.
  assert (A : homog (map val (again e (by_line lo hi) [none])) s (1 - s)
    = (val lo * (1 - s) + val hi * s) ^ e).
  { induction e as [|e IH]; cbn [again]; [cbn; rewrite val_none; ring|].
    rewrite val_by_line, homog_line, IH. cbn. ring. }
  rewrite <- A. generalize (again e (by_line lo hi) [none]). intros l.
  induction (d - e)%nat as [|k IH]; cbn [again]; auto.
  rewrite val_by_line, homog_line, IH, val_none. ring.
Qed.
Lemma binomials_val d s : homog (map IZR (binomials d)) s (1 - s) = 1.
Proof.
  unfold binomials. induction d as [|d IH]; cbn [again]; [cbn; ring|].
  rewrite IZR_pascal, homog_line, IH. ring.
Qed.
Lemma by_line_length a b l : length (by_line a b l) = S (length l).
Proof. unfold by_line. rewrite zip_length; rewrite app_length; cbn; rewrite !map_length; lia. Qed.
Lemma powers_length lo hi d e : (e <= d)%nat -> length (powers lo hi d e) = S d.
Proof.
  intros H. unfold powers.
  assert (A : forall k f l, (forall l : list num, length (f l) = S (length l)) ->
    length (again k f l) = (k + length l)%nat).
  { induction k as [|k IH]; intros f l Hf; cbn; auto. now rewrite Hf, IH. }
  rewrite !A by apply by_line_length. cbn. lia.
Qed.
Lemma binomials_length d : length (binomials d) = S d.
Proof.
  unfold binomials. induction d as [|d IH]; cbn [again]; auto.
  unfold pascal at 1. rewrite zip_length; rewrite app_length; cbn [length]; lia.
Qed.
Lemma binomials_positive d : Forall (fun c => (0 < c)%Z) (binomials d).
Proof.
  assert (A : forall l a, (0 <= a)%Z -> (l = [] -> 0 < a)%Z -> Forall (fun c => (0 < c)%Z) l ->
    Forall (fun c => (0 < c)%Z) (zip Z.add (l ++ [0%Z]) (a :: l))).
  { induction l as [|b l IH]; intros a Ha Hn H; cbn.
    - constructor; [specialize (Hn eq_refl); lia|constructor].
    - inversion H; subst. constructor; [lia|]. apply IH; auto; lia. }
  unfold binomials. induction d as [|d IH]; cbn [again]; [repeat constructor|].
  apply A; [lia| |exact IH]. intros E. fold (binomials d) in E.
  pose proof (binomials_length d) as L. rewrite E in L. discriminate.
Qed.

Definition terms := list (list nat * matrix).
Definition slice (rows : list (list num)) (k : nat) (c : Z) (ts : terms) : terms :=
  map (fun t => (tl (fst t),
    map (vscale (ndiv (nth k (nth (hd O (fst t)) rows []) nzero) (c, xH))) (snd t))) ts.
Fixpoint vertices_on (box : list (num * num)) (ts : terms) : list matrix :=
  match box with
  | [] => [fold_right (fun t acc => madd (snd t) acc) [] ts]
  | (lo, hi) :: box' =>
      let d := fold_right (fun t acc => Nat.max (hd O (fst t)) acc) O ts in
      let rows := map (powers lo hi d) (seq 0 (S d)) in
      flat_map (fun e => vertices_on box' (slice rows (fst e) (snd e) ts))
        (combine (seq 0 (S d)) (binomials d))
  end.
Fixpoint valued (ts : terms) (w : list R) (f : matrix -> R) : R :=
  match ts with [] => 0 | (e, M) :: rest => power e w * f M + valued rest w f end.

Lemma at_row row M z : at_ (row :: M) z = dot (map val row) z :: at_ M z.
Proof. reflexivity. Qed.
Lemma at_madd A : forall B q z, dot q (at_ (madd A B) z) = dot q (at_ A z) + dot q (at_ B z).
Proof.
  induction A as [|a A IH]; intros [|b B] q z; cbn [madd]; rewrite ?at_row; cbn [at_ vals image map];
    rewrite ?dot_nil_r; try ring.
  destruct q as [|q0 q]; cbn [dot]; [ring|]. rewrite dot_vadd, IH. ring.
Qed.
Lemma at_vscale c M : forall q z, dot q (at_ (map (vscale c) M) z) = val c * dot q (at_ M z).
Proof.
  induction M as [|row M IH]; intros q z; cbn [map]; rewrite ?at_row; cbn [at_ vals image map];
    rewrite ?dot_nil_r; [ring|].
  destruct q as [|q0 q]; cbn [dot]; [ring|]. rewrite dot_vscale, IH. ring.
Qed.
Lemma vertices_bound q z : forall box ts c w, in_box w box ->
  (forall E, In E (vertices_on box ts) -> 0 <= c + dot q (at_ E z)) ->
  0 <= c + valued ts w (fun M => dot q (at_ M z)).
Proof.
  induction box as [|[lo hi] box IH]; intros ts c w Hw H; inversion Hw as [|w0 ? w' ? H0 Hw']; subst.
  { specialize (H _ (or_introl eq_refl)).
    enough (E : valued ts [] (fun M => dot q (at_ M z)) =
      dot q (at_ (fold_right (fun t acc => madd (snd t) acc) [] ts) z)) by lra.
    clear H. induction ts as [|[e M] ts IH]; cbn [valued fold_right snd].
    { cbn. now rewrite dot_nil_r. }
    rewrite at_madd, IH. replace (power e []) with 1 by now destruct e. ring. }
  cbn [fst snd] in H0.
  assert (Hs : exists s, 0 <= s <= 1 /\ w0 = val lo * (1 - s) + val hi * s).
  { destruct (Req_dec (val lo) (val hi)) as [E|E]; [exists 0; lra|].
    assert (D : 0 < val hi - val lo) by lra. exists ((w0 - val lo) / (val hi - val lo)).
    split; [|field; lra]. split.
    - apply Rmult_le_pos; [lra|]. left. now apply Rinv_0_lt_compat.
    - apply (Rmult_le_reg_r (val hi - val lo)); auto. unfold Rdiv. rewrite Rmult_assoc, Rinv_l; lra. }
  destruct Hs as [s [Hs ->]].
  cbn [vertices_on] in H. set (d := fold_right _ _ ts) in *.
  set (rows := map (powers lo hi d) (seq 0 (S d))) in *.
  pose (A := fun t : list nat * matrix => power (tl (fst t)) w' * dot q (at_ (snd t) z)).
  pose (row := fun t : list nat * matrix => map val (nth (hd O (fst t)) rows [])).
  pose (T := fold_right (fun t acc => zip Rplus (map (Rmult (A t)) (row t)) acc)
    (map (Rmult c) (map IZR (binomials d)))).
  assert (Hd : forall t, In t ts -> (hd O (fst t) <= d)%nat).
  { unfold d. clear. induction ts as [|u ts IH]; intros t Ht; [destruct Ht|].
    destruct Ht as [<-|Ht]; cbn; [lia|]. specialize (IH t Ht). lia. }
  assert (Hrow : forall t, In t ts -> nth (hd O (fst t)) rows [] = powers lo hi d (hd O (fst t))).
  { intros t Ht. specialize (Hd t Ht). unfold rows.
    rewrite (nth_indep _ [] (powers lo hi d O)) by (rewrite map_length, seq_length; lia).
    rewrite map_nth, seq_nth by lia. reflexivity. }
  assert (Hpow : forall t, In t ts ->
    power (fst t) ((val lo * (1 - s) + val hi * s) :: w') = homog (row t) s (1 - s) * power (tl (fst t)) w').
  { intros t Ht. unfold row. rewrite Hrow by auto. rewrite powers_val by auto.
    destruct (fst t) as [|k e]; cbn; [|ring]. now destruct w'; cbn; ring_simplify. }
  assert (Hlen : forall t, In t ts -> length (row t) = S d).
  { intros t Ht. unfold row. rewrite map_length, Hrow, powers_length; auto. }
  (* all entries of T are nonnegative, and T is what is sought *)
  assert (G : forall us, incl us ts -> length (T us) = S d /\
    homog (T us) s (1 - s) = c + valued us ((val lo * (1 - s) + val hi * s) :: w')
      (fun M => dot q (at_ M z)) /\
    forall k, (k < S d)%nat -> nth k (T us) 0 =
      IZR (nth k (binomials d) 0%Z) * (c + valued (slice rows k (nth k (binomials d) 0%Z) us) w'
        (fun M => dot q (at_ M z)))).
  { induction us as [|t us IHu]; intros Hi.
    - cbn [T fold_right]. unfold T. cbn [fold_right]. rewrite !map_length, binomials_length.
      split; auto. split.
      + rewrite homog_scale, binomials_val. cbn. ring.
      + intros k Hk. rewrite (nth_indep _ 0 (c * IZR 0)) by (rewrite !map_length, binomials_length; auto).
        rewrite map_nth, map_nth. cbn. ring.
    - assert (Ht : In t ts) by (apply Hi; now left).
      destruct IHu as [L [Hh Hn]]; [intros u Hu; apply Hi; now right|].
      assert (E : length (map (Rmult (A t)) (row t)) = length (T us)).
      { rewrite map_length, L. now apply Hlen. }
      change (T (t :: us)) with (zip Rplus (map (Rmult (A t)) (row t)) (T us)).
      split; [|split].
      + rewrite zip_length, E; auto.
      + rewrite homog_add, homog_scale, Hh by auto. destruct t as [e M] eqn:Et. cbn [valued].
        specialize (Hpow (e, M) Ht). cbn [fst] in Hpow. rewrite Hpow. unfold A. cbn [fst snd]. ring.
      + intros k Hk.
        assert (Z : forall (a b : list R) k, length a = length b -> (k < length a)%nat ->
          nth k (zip Rplus a b) 0 = nth k a 0 + nth k b 0).
        { clear. induction a as [|x a IH]; intros [|y b] [|k] H1 H2; cbn in *; try lia; auto.
          apply IH; lia. }
        rewrite Z by (rewrite ?E, ?L; auto).
        rewrite (nth_indep _ 0 (A t * 0)) by (rewrite map_length, Hlen; auto).
        rewrite map_nth, Hn by auto. unfold slice at 2. cbn [map]. destruct t as [e M] eqn:Et.
        cbn [valued fst snd]. fold (slice rows k (nth k (binomials d) 0%Z) us).
        rewrite at_vscale, val_div.
        2:{ cbn. pose proof (binomials_positive d) as B. rewrite Forall_forall in B. apply B.
            apply nth_In. rewrite binomials_length. auto. }
        assert (Ck : 0 < IZR (nth k (binomials d) 0%Z)).
        { apply IZR_lt. pose proof (binomials_positive d) as B. rewrite Forall_forall in B. apply B.
          apply nth_In. rewrite binomials_length. auto. }
        assert (Rk : nth k (row (e, M)) 0 = val (nth k (nth (hd O e) rows []) nzero)).
        { unfold row. cbn [fst]. rewrite (nth_indep _ 0 (val nzero)).
          - now rewrite map_nth.
          - change (k < length (row (e, M)))%nat. rewrite Hlen; auto. }
        rewrite Rk. unfold A. cbn [fst snd]. set (cc := nth k (binomials d) 0%Z) in *.
        replace (val (cc, 1%positive)) with (IZR cc) by (unfold val; cbn; field).
        field. lra. }
  destruct (G ts (incl_refl _)) as [L [Hh Hn]]. rewrite <- Hh. apply homog_nonneg; try lra.
  apply Forall_forall. intros a Ha. apply (In_nth _ _ 0) in Ha as [k [Hk <-]]. rewrite L in Hk.
  rewrite Hn by auto. apply Rmult_le_pos.
  - apply IZR_le. apply Z.lt_le_incl. pose proof (binomials_positive d) as B.
    rewrite Forall_forall in B. apply B, nth_In. now rewrite binomials_length.
  - apply IH; auto. intros E HE. apply H. apply in_flat_map.
    exists (k, nth k (binomials d) 0%Z). split; auto.
    assert (Q : forall (a b : list Z) (f : list nat) k, (k < length f)%nat -> length f = length b ->
      In (nth k f O, nth k b 0%Z) (combine f b)).
    { clear. intros _ b f. revert b. induction f as [|x f IH]; intros [|y b] k H1 H2; cbn in *; try lia.
      destruct k; [now left|]. right. apply IH; lia. }
    pose proof (Q [] (binomials d) (seq 0 (S d)) k) as Q'. rewrite seq_length in Q'.
    rewrite seq_nth in Q' by auto. apply Q'; auto. now rewrite binomials_length.
Qed.
