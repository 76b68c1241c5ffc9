(* Uncertain inputs w that only add to the derivative: instead of every vertex of their box, its
   centre, and what the worst of them adds. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Claim Calculus Condition Definite.
Import ListNotations.
Open Scope R_scope.

(* A term has either no w in it, or one and nothing else; [skipped]: 1 + n + m. *)
Definition pushes_only (skipped : nat) (e : equation) : bool :=
  forallb (fun t => orb (forallb (Nat.eqb 0) (skipn skipped (fst t)))
                      (Nat.eqb (fold_right Nat.add O (fst t)) 1)) e.
(* What variable i adds to an equation, for each unit of it. *)
Fixpoint push (i : nat) (e : equation) : num :=
  match e with
  | [] => nzero
  | (k, c) :: e' => if Nat.eqb (nth i k O) 0 then push i e' else nadd c (push i e')
  end.
Definition middle (b : num * num) : num := nmul (1%Z, 2%positive) (nadd (fst b) (snd b)).
Definition radius (b : num * num) : num := nmul (1%Z, 2%positive) (nsub (snd b) (fst b)).

(* h r (kappa (z'Pg)^2 + 1 / kappa), of every w *)
Fixpoint cost (kappa : list num) (box : list (num * num)) (g : segment) (s : R) (z : list R)
  (i : nat) : R :=
  match kappa, box with
  | k :: kappa', b :: box' =>
      let a := form (P g s) z (map (fun e => val (push i e)) (equations g)) in
      duration g * (val (radius b) * (val k * (a * a) + / val k)) + cost kappa' box' g s z (S i)
  | _, _ => 0
  end.

Lemma power_split L : forall e (post : list R), exists c, forall y,
  power e (L ++ y :: post) = c * y ^ (nth (length L) e O).
Proof.
  induction L as [|a L IH]; intros [|k e] post; cbn [app power length nth].
  - exists 1. intros; cbn; ring.
  - exists (power e post). intros; ring.
  - exists 1. intros; cbn; ring.
  - destruct (IH e post) as [c Hc]. exists (a ^ k * c). intros y'. rewrite Hc. ring.
Qed.
Lemma power_none e v : fold_right Nat.add O e = O -> power e v = 1.
Proof.
  revert v. induction e as [|k e IH]; intros [|y v] H; cbn in *; auto.
  assert (k = O) as -> by lia. rewrite IH by lia. cbn. ring.
Qed.
Lemma power_alone L : forall e y post, fold_right Nat.add O e = 1%nat ->
  nth (length L) e O <> O -> power e (L ++ y :: post) = y /\ nth (length L) e O = 1%nat.
Proof.
  induction L as [|a L IH]; intros [|k e] y post H N; cbn [app power length nth fold_right] in *;
    try lia.
  - assert (k = 1%nat) as -> by lia. rewrite power_none by lia. split; [cbn; ring|auto].
  - assert (S : forall l j, (nth j l O <= fold_right Nat.add O l)%nat).
    { clear. induction l as [|a l IH]; intros [|j]; cbn; try lia. specialize (IH j). lia. }
    pose proof (S e (length L)). assert (k = O) as -> by lia.
    destruct (IH e y post ltac:(lia) N) as [-> E]. split; [cbn; ring|auto].
Qed.
Lemma rate_push n L y c post e : pushes_only n e = true -> (n <= length L)%nat ->
  rate e (L ++ y :: post) = rate e (L ++ c :: post) + (y - c) * val (push (length L) e).
Proof.
  intros H HL. induction e as [|[k a] e IH]; cbn [rate push]; [rewrite val_nzero; ring|].
  cbn [pushes_only forallb] in H. apply andb_prop in H as [H1 H2]. rewrite (IH H2). cbn [fst] in H1.
  destruct (Nat.eqb_spec (nth (length L) k O) 0) as [E|E].
  { destruct (power_split L k post) as [q Hq]. rewrite !Hq, E. cbn. ring. }
  apply Bool.orb_prop in H1 as [H1|H1].
  - exfalso. apply E. rewrite forallb_forall in H1.
    destruct (Nat.lt_ge_cases (length L) (length k)) as [C|C]; [|now apply nth_overflow].
    rewrite <- (firstn_skipn n k), app_nth2; rewrite firstn_length_le by lia; try lia.
    symmetry. apply Nat.eqb_eq, H1, nth_In. rewrite skipn_length. lia.
  - apply Nat.eqb_eq in H1. destruct (power_alone L k y post H1 E) as [-> _].
    destruct (power_alone L k c post H1 E) as [-> _]. rewrite val_add. ring.
Qed.

Lemma growth_push n g s x u pre y c post : Forall (fun e => pushes_only n e = true) (equations g) ->
  (1 + length (x ++ u))%nat = n -> length (equations g) = length (nominal g) ->
  growth g s x u (pre ++ y :: post) = growth g s x u (pre ++ c :: post)
    + (y - c) * (2 * duration g * form (P g s) (deviation g s x)
        (map (fun e => val (push (n + length pre) e)) (equations g))).
Proof.
  intros He Hn Hl. unfold growth.
  set (q := map (fun e => val (push (n + length pre) e)) (equations g)).
  assert (E : relative g s x u (pre ++ y :: post) =
    zip Rplus (relative g s x u (pre ++ c :: post)) (map (fun v => v * (duration g * (y - c))) q)).
  { unfold relative, field, q. set (t := line s _ _).
    assert (Lds : length (equations g)
      = length (map (fun c => curve' (map val c) s) (nominal g))) by (rewrite map_length; exact Hl).
    revert Lds. generalize (map (fun c => curve' (map val c) s) (nominal g)). clear Hl q.
    induction He as [|e es He Hes IH]; intros [|d ds] Ld; try discriminate; cbn [map zip]; auto.
    rewrite IH by (now injection Ld). f_equal.
    pose proof (rate_push n (t :: x ++ u ++ pre) y c post e He) as A.
    cbn [app length] in A. rewrite !app_length in A. rewrite app_length in Hn.
    rewrite <- !app_assoc in A. rewrite A by lia.
    replace (S (length x + (length u + length pre)))%nat with (n + length pre)%nat by lia. ring. }
  assert (A : form (P g s) (deviation g s x) (relative g s x u (pre ++ y :: post))
    = form (P g s) (deviation g s x) (relative g s x u (pre ++ c :: post))
      + form (P g s) (deviation g s x) q * (duration g * (y - c))).
  { rewrite E, form_symmetric, form_plus, (form_symmetric _ (map _ q)), form_scaled_r.
    - now rewrite (form_symmetric _ (relative _ _ _ _ _)).
    - rewrite map_length. unfold q, relative, field. rewrite zip_length; rewrite !map_length; auto. }
  rewrite A. ring.
Qed.

Lemma young k a : 0 < k -> 2 * Rabs a <= k * (a * a) + / k.
Proof.
  intros H. pose proof (Rinv_0_lt_compat _ H) as I.
  assert (E : k * (a * a) + / k - 2 * Rabs a = / k * ((k * Rabs a - 1) * (k * Rabs a - 1))).
  { assert (A : a * a = Rabs a * Rabs a).
    { rewrite <- Rabs_mult. symmetry. apply Rabs_right. pose proof (Rle_0_sqr a). unfold Rsqr in *. lra. }
    rewrite A. field. lra. }
  pose proof (Rmult_le_pos _ _ (Rlt_le _ _ I) (Rle_0_sqr (k * Rabs a - 1))). unfold Rsqr in *. lra.
Qed.
(* On the box, growth is below what it is at the centre and the cost. *)
Lemma below_pushed g s z D : 0 <= D -> D = duration g -> forall box kappa i G,
  length kappa = length box -> Forall (fun k => 0 < val k) kappa ->
  (forall pre y c post, G (pre ++ y :: post) = G (pre ++ c :: post)
    + (y - c) * (2 * D * form (P g s) z (map (fun e => val (push (i + length pre) e)) (equations g)))) ->
  forall w, in_box w box -> G w <= G (map val (map middle box)) + cost kappa box g s z i.
Proof.
  intros HD ED. induction box as [|b box IH]; intros [|k kappa] i G L Hk HG w Hw;
    try discriminate; inversion Hw as [|w0 ? w' ? H1 H2]; subst; cbn [map cost]; [lra|].
  inversion Hk as [|? ? K1 K2]; subst.
  pose proof (IH kappa (S i) (fun w => G (val (middle b) :: w)) ltac:(now injection L) K2) as A.
  assert (A' := A (fun pre y c post => ltac:(
    pose proof (HG (val (middle b) :: pre) y c post) as E; cbn [app length] in E;
    rewrite <- Nat.add_succ_comm in E; exact E)) w' H2). cbn beta in A'. clear A.
  pose proof (HG [] w0 (val (middle b)) w') as E. cbn [app length] in E. rewrite Nat.add_0_r in E.
  rewrite E. set (a := form (P g s) z _) in *.
  assert (R1 : Rabs (w0 - val (middle b)) <= val (radius b)).
  { unfold middle, radius. rewrite !val_mul, val_add, val_sub.
    replace (val (1%Z, 2%positive)) with (1 / 2) by (unfold val; cbn; field).
    apply Rabs_le. lra. }
  pose proof (young (val k) a K1) as Y.
  assert (B : (w0 - val (middle b)) * (2 * duration g * a)
    <= duration g * (val (radius b) * (val k * (a * a) + / val k))).
  { apply Rle_trans with (duration g * (Rabs (w0 - val (middle b)) * (2 * Rabs a))).
    - replace ((w0 - val (middle b)) * (2 * duration g * a))
        with (duration g * (2 * ((w0 - val (middle b)) * a))) by ring.
      apply Rmult_le_compat_l; auto.
      pose proof (Rle_abs ((w0 - val (middle b)) * a)) as T. rewrite Rabs_mult in T. lra.
    - apply Rmult_le_compat_l; auto. apply Rmult_le_compat; auto; try apply Rabs_pos.
      pose proof (Rabs_pos a). lra. }
  lra.
Qed.

Section Pushed.
Context {K : Ints}.

Definition fone_over (k : num) : F :=
  match fst k with Zpos p => fconst (Zpos (snd k)) p | _ => fconst 0 1 end.
Fixpoint fcost (kappa : list num) (box : list (num * num)) (h : F) (P : list (list F)) (z : list F)
  (g : segment) (i : nat) : F :=
  match kappa, box with
  | k :: kappa', b :: box' =>
      let a := fform P z (map (fun e => fnum (push i e)) (equations g)) in
      fadd (fmul h (fmul (fnum (radius b)) (fadd (fmul (fnum k) (fmul a a)) (fone_over k))))
        (fcost kappa' box' h P z g (S i))
  | _, _ => fconst 0 1
  end.
Definition fpushed (kappa : list num) (box : list (num * num)) (g : segment) (depth index : Z)
  (skipped : nat) : F :=
  let B := fbernstein (fplace depth index) (fremaining depth index) in
  fcost kappa box (fsub (fnum (time (stop g))) (fnum (time (start g)))) (fshape B g)
    (fdeviation g) g skipped.

Lemma fone_over_val r x k : 0 < val k -> means r x (fone_over k) (/ val k).
Proof.
  destruct k as [[|p|p] q]; unfold val; cbn [fst snd]; intros H.
  - exfalso. unfold Rdiv in H. lra.
  - unfold fone_over; cbn [fst snd]. eapply means_equal; [apply means_const|].
    field. split; now apply Rgt_not_eq, IZR_lt.
  - exfalso. assert (0 < IZR (Zpos q)) by now apply IZR_lt.
    assert (IZR (Zneg p) < 0) by now apply IZR_lt.
    apply (Rmult_lt_compat_r (IZR (Zpos q))) in H; auto. unfold Rdiv in H.
    rewrite Rmult_assoc, Rinv_l in H; lra.
Qed.
Lemma means_fpushed s r0 g x depth index kappa box skipped :
  let z := deviation g s x in
  (0 <= depth)%Z -> s * IZR (2 ^ depth) = IZR index + r0 -> length x = length (nominal g) ->
  Forall (fun k => 0 < val k) kappa ->
  means r0 (env z) (fpushed kappa box g depth index skipped) (cost kappa box g s z skipped).
Proof.
  intros z Hd Hs Hx Hk. unfold fpushed.
  pose proof (means_shape s r0 z depth index Hd Hs g) as HP.
  pose proof (means_deviation s r0 z g x eq_refl Hx) as Hz.
  assert (Hh : means r0 (env z) (fsub (fnum (time (stop g))) (fnum (time (start g)))) (duration g)).
  { apply means_sub; apply means_fnum. }
  revert box skipped. induction Hk as [|k kappa Hk Hks IH]; intros [|b box] i; cbn [fcost cost];
    try apply means_zero.
  apply means_add; [|apply IH].
  assert (A : means r0 (env z) (fform (fshape (fbernstein (fplace depth index) (fremaining depth index)) g)
      (fdeviation g) (map (fun e => fnum (push i e)) (equations g)))
    (form (P g s) z (map (fun e => val (push i e)) (equations g)))).
  { apply means_fform; auto. apply Forall2_map2. intros e. apply means_fnum. }
  apply means_mul; auto. apply means_mul; [apply means_fnum|].
  apply means_add; [|now apply fone_over_val]. apply means_mul; [apply means_fnum|].
  now apply means_mul.
Qed.
End Pushed.
