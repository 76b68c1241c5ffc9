(* The end of a funnel lies in the goal, by the S-lemma; and the whole theorem. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Positive Claim Definite Funnel Stays.
Import ListNotations.
Open Scope R_scope.

(* M y, M by its upper triangle *)
Fixpoint nproduct (M : list (list num)) (y : list num) : list num :=
  match M, y with
  | (a :: b) :: M', y0 :: y' =>
      nadd (nmul a y0) (ndot b y') :: zip (fun e v => nadd (nmul e y0) v) b (nproduct M' y')
  | _, _ => []
  end.
(* the upper triangle of rho [lambda P / rho - B, - q; - q', 1 - lambda - d'q], q = B d *)
Fixpoint s_lemma (lambda rho : num) (P B : list (list num)) (q : list num) (corner : num)
  : list (list num) :=
  match P, B, q with
  | p :: P', b :: B', e :: q' =>
      (zip (fun u v => nsub (nmul lambda u) (nmul rho v)) p b ++ [nopp (nmul rho e)])
        :: s_lemma lambda rho P' B' q' corner
  | _, _, _ => [[nmul rho corner]]
  end.

Lemma dot_app a : forall b u v, length a = length u -> dot (a ++ b) (u ++ v) = dot a u + dot b v.
Proof.
  induction a as [|x a IH]; intros b [|y u] v H; try discriminate; cbn; [ring|].
  rewrite IH by (now injection H). ring.
Qed.
Lemma nproduct_val k : forall M y, triangular k M -> length y = k ->
  length (nproduct M y) = k /\
  forall z, length z = k -> dot z (map val (nproduct M y)) = form (vals M) z (map val y).
Proof.
  induction k as [|k IH]; intros [|row M] [|y0 y] HM Hy; cbn [triangular] in HM; try tauto;
    try discriminate.
  { cbn. split; auto. intros [|z0 z] H; [reflexivity|discriminate]. }
  destruct HM as [Lr HM]. destruct row as [|a b]; [discriminate|]. injection Lr as Lr.
  injection Hy as Hy. destruct (IH M y HM Hy) as [L V]. cbn [nproduct]. split.
  { cbn [length]. rewrite zip_length; congruence. }
  intros [|z0 z] Hz; [discriminate|]. injection Hz as Hz.
  cbn [map dot vals form]. rewrite val_add, val_mul, val_dot.
  assert (G : forall b m z, length b = length m ->
    dot z (map val (zip (fun e v => nadd (nmul e y0) v) b m))
      = val y0 * dot (map val b) z + dot z (map val m)).
  { clear. induction b as [|e b IH]; intros [|v m] [|z0 z] H; try discriminate; cbn [zip map dot];
      try ring. rewrite val_add, val_mul, IH by (now injection H). ring. }
  rewrite G by congruence. rewrite (V z Hz). unfold vals. ring.
Qed.
Lemma s_lemma_val lambda rho k : forall P B q corner z, triangular k P -> triangular k B ->
  length q = k -> length z = k ->
  form (vals (s_lemma lambda rho P B q corner)) (z ++ [1]) (z ++ [1]) =
    val lambda * form (vals P) z z - val rho * form (vals B) z z
    - 2 * (val rho * dot z (map val q)) + val rho * val corner.
Proof.
  induction k as [|k IH]; intros [|p P] [|b B] [|e q] corner [|z0 z] HP HB Hq Hz;
    cbn [triangular] in *; try tauto; try discriminate.
  { cbn -[nmul]. rewrite val_mul. ring. }
  destruct HP as [Lp HP], HB as [Lb HB]. injection Hq as Hq. injection Hz as Hz.
  destruct p as [|p0 p], b as [|b0 b]; try discriminate. injection Lp as Lp. injection Lb as Lb.
  cbn [s_lemma zip app vals map form dot]. rewrite val_sub, !val_mul.
  assert (D : dot (map val (zip (fun u v => nsub (nmul lambda u) (nmul rho v)) p b
      ++ [nopp (nmul rho e)])) (z ++ [1])
    = val lambda * dot (map val p) z - val rho * dot (map val b) z - val rho * val e).
  { rewrite map_app, dot_app.
    - cbn [map dot]. rewrite val_opp, val_mul. revert Lp Lb. rewrite <- Hz. clear.
      revert b z. induction p as [|u p IH]; intros [|v b] [|z0 z] Lp Lb; try discriminate;
        cbn [zip map dot]; try ring. rewrite val_sub, !val_mul.
      injection Lp as Lp. injection Lb as Lb. specialize (IH b z Lp Lb).
      apply (f_equal (fun w => w + val rho * val e * 1)) in IH. lra.
    - rewrite map_length, zip_length; congruence. }
  rewrite D. pose proof (IH P B q corner z HP HB Hq Hz) as E. rewrite E. ring.
Qed.
Section Goal.
Context {K : Ints}.

Definition goal_ok (d : problem) (lambda : num) : bool :=
  match goal d, rev (segments d) with
  | None, _ => true
  | Some (centre, B), g :: _ =>
      let n := length (nominal g) in
      let e := zip nsub (map last_of (nominal g)) centre in
      let q := nproduct B e in
      let corner := nsub (nsub none lambda) (ndot e q) in
      andb (andb (Nat.eqb (length centre) n) (triangle_ok n B))
        (andb (0 <=? fst lambda)%Z
          (semidefinite false
            (s_lemma lambda (level (stop g)) (shape (stop g)) B q corner)))
  | _, _ => false
  end.
(* P is definite at every knot, and the goal's matrix is, as the file format wants; that is not
   needed below. *)
Definition shapes_ok (d : problem) : bool :=
  andb match goal d with Some (_, B) => semidefinite true B | None => true end (forallb (fun g => andb (semidefinite true (shape (start g))) (semidefinite true (shape (stop g))))
    (segments d)).
Definition funnel_ok (d : problem) (offs : list (list num)) (w : witness) : bool :=
  andb (andb (check d offs w) (shapes_ok d))
    (andb (Nat.ltb 0 (length (segments d))) (goal_ok d (goal_multiplier w))).

Theorem goal_reached d w lambda : checked d w -> goal_ok d lambda = true ->
  (0 < length (segments d))%nat -> forall x, length x = first_size d -> inside d x (finish d) ->
  in_goal d x.
Proof.
  intros Hc Hg Hne x Hx S. unfold in_goal, goal_ok in *. destruct (goal d) as [[centre B]|]; auto.
  destruct (rev (segments d)) as [|g gs] eqn:Er; [discriminate|].
  assert (Es : segments d = rev gs ++ [g]).
  { rewrite <- (rev_involutive (segments d)), Er. reflexivity. }
  apply andb_prop in Hg as [G1 G2]. apply andb_prop in G1 as [G1 G3].
  apply andb_prop in G2 as [G2 G4]. apply Nat.eqb_eq in G1. apply triangle_ok_is in G3.
  apply Z.leb_le, IZR_le in G2.
  set (n := length (nominal g)) in *.
  pose proof (c_segments d w Hc) as Hok.
  assert (Hin_g : In g (segments d)) by (rewrite Es; apply in_or_app; right; now left).
  assert (Fin : finish d = ends g).
  { unfold finish. rewrite Es, map_app. cbn. now rewrite last_last. }
  rewrite Forall_forall in Hok. pose proof (Hok g Hin_g) as Okg.
  set (n0 := first_size d) in *.
  destruct (segment_facts d g n0 Okg) as [Ln Le _ _ C T _ Hrho [S0 S1] _].
  fold n in Ln.
  assert (Lx : length x = n) by congruence.
  pose proof (S g Hin_g ltac:(rewrite Fin; lra)) as I.
  rewrite Fin in *. unfold inside_segment in I. rewrite (place_end g T) in I.
  unfold P, rho in I. rewrite line_1, (zip_line n0 1 line_1 _ _ S0 S1) in I.
  set (z := deviation g 1 (at_time x (ends g))) in *.
  set (e := zip nsub (map last_of (nominal g)) centre) in *.
  set (q := nproduct B e) in *.
  assert (Lz : length z = n).
  { unfold z, deviation. rewrite zip_length; rewrite ?map_length; unfold at_time;
      rewrite ?map_length; exact Lx. }
  assert (Lem : length e = n).
  { unfold e. rewrite zip_length; rewrite map_length; [reflexivity|symmetry; exact G1]. }
  destruct (nproduct_val n B e G3 Lem) as [Lq Vq]. fold q in Lq, Vq.
  pose proof (semidefinite_sound _ _ (z ++ [1]) G4) as Q.
  rewrite <- Ln in S1. rewrite (s_lemma_val _ _ n) in Q; auto.
  rewrite !val_sub, val_none, val_dot in Q. rewrite (Vq z Lz) in Q.
  rewrite (Vq (map val e)) in Q by (rewrite map_length; auto).
  assert (E : zip Rminus (at_time x (ends g)) (map val centre) = zip Rplus z (map val e)).
  { unfold z, e, deviation.
    assert (Lat : length (at_time x (ends g)) = length (nominal g)) by
      (unfold at_time; rewrite map_length; exact Lx).
    revert Lat G1 C. unfold n. generalize (at_time x (ends g)). generalize (nominal g). clear.
    intros cs. revert centre. induction cs as [|c cs IH]; intros [|m centre] [|a l] La Lc C;
      try discriminate; cbn [map zip]; auto.
    inversion C as [|? ? Hc1 Hc2]; subst. destruct (along_ends c Hc1) as [_ A].
    rewrite IH by (try now injection La; try now injection Lc; auto). f_equal.
    rewrite val_sub, A. ring. }
  rewrite E. fold (vals B).
  assert (Lze : length z = length (map val e)) by (rewrite map_length; congruence).
  rewrite form_plus by auto. rewrite !(form_symmetric _ _ (zip Rplus z (map val e))).
  rewrite !form_plus by auto. rewrite (form_symmetric _ (map val e) z).
  assert (Lam : 0 <= val lambda).
  { unfold val. apply Rmult_le_pos; auto. left. now apply Rinv_0_lt_compat, IZR_lt. }
  set (W := form (vals (shape (stop g))) z z) in *. fold (vals (shape (stop g))) in I.
  fold W in I. set (rh := val (level (stop g))) in *. set (la := val lambda) in *.
  set (bzz := form (vals B) z z) in *. set (bze := form (vals B) z (map val e)) in *.
  set (bee := form (vals B) (map val e) (map val e)) in *.
  apply (Rmult_le_reg_l rh); auto.
  pose proof (Rmult_le_compat_l la _ _ Lam I). lra.
Qed.
Theorem funnel_proved d w : funnel_ok d (unmoved d) w = true -> forall x, solution d x ->
  forall ta, begin d <= ta <= finish d -> inside d x ta ->
  (forall t, ta <= t <= finish d -> inside d x t) /\ in_goal d x.
Proof.
  intros H x Hx ta Hta Hin. unfold funnel_ok in H.
  apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [Hc _].
  apply andb_prop in H2 as [Hne Hg]. apply Nat.ltb_lt in Hne.
  pose proof (stays d w Hc Hne x Hx ta (proj1 Hta) Hin) as S.
  pose proof (check_facts _ _ _ Hc) as C.
  split; auto.
  apply (goal_reached d w _ C Hg Hne x (solution_length d w x C Hne Hx)). apply S. lra.
Qed.
End Goal.
