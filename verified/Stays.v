(* The theorem: what is inside a checked funnel stays inside. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Positive Claim Calculus Condition Definite Pushed Funnel.
Import ListNotations.
Open Scope R_scope.

Section Stays.
Context {K : Ints}.

(* Continuity of polynomials along continuous functions. *)
Lemma c_plus f g t : continuity_pt f t -> continuity_pt g t -> continuity_pt (fun u => f u + g u) t.
Proof. apply continuity_pt_plus. Qed.
Lemma c_mult f g t : continuity_pt f t -> continuity_pt g t -> continuity_pt (fun u => f u * g u) t.
Proof. apply continuity_pt_mult. Qed.
Lemma c_const c t : continuity_pt (fun _ => c) t.
Proof. apply continuity_pt_const. intros a b. reflexivity. Qed.
Lemma c_minus f g t : continuity_pt f t -> continuity_pt g t -> continuity_pt (fun u => f u - g u) t.
Proof. apply continuity_pt_minus. Qed.
Lemma c_power f k t : continuity_pt f t -> continuity_pt (fun u => f u ^ k) t.
Proof.
  intros H. induction k as [|k IH]; cbn [pow]; [apply c_const|]. now apply (c_mult f).
Qed.
Lemma c_bval S t a : continuity_pt S t -> continuity_pt (fun u => bval (S u) a) t.
Proof.
  intros H. induction a as [|y a IH]; cbn [bval]; [apply c_const|].
  apply (c_plus (fun u => r y * (1 - S u) ^ length a) (fun u => S u * bval (S u) a)).
  - apply (c_mult (fun _ => r y)); [apply c_const|].
    apply (c_power (fun u => 1 - S u)). apply (c_minus (fun _ => 1)); auto. apply c_const.
  - now apply (c_mult S).
Qed.
Lemma c_mval X t m : (forall i, continuity_pt (fun u => X u i) t) ->
  continuity_pt (fun u => mval (X u) m) t.
Proof.
  intros H. induction m as [|i m IH]; cbn [mval]; [apply c_const|].
  now apply (c_mult (fun u => X u i)).
Qed.
Lemma c_pval S X t p : continuity_pt S t -> (forall i, continuity_pt (fun u => X u i) t) ->
  continuity_pt (fun u => pval (S u) (X u) p) t.
Proof.
  intros HS HX. induction p as [|[m a] p IH]; cbn [pval]; [apply c_const|].
  apply (c_plus (fun u => bval (S u) a * mval (X u) m)); auto.
  apply (c_mult (fun u => bval (S u) a)); [now apply c_bval|now apply c_mval].
Qed.

Section Segment.
Variables (d : problem) (w : witness) (g : segment) (off : list num) (ps : list piece) (n : nat).
Hypothesis Hlimits : Forall proper (limits d).
Hypothesis Hmargin : 0 < val (margin w).
Hypothesis Hok : segment_ok n d g = true.
Hypothesis Hoff : off_ok n d g off = true.
Hypothesis Hcov : covered d w off ps = true.
Hypothesis Hps : forallb (piece_ok d w (products (basis w)) g off) ps = true.
Let F := segment_facts d g n Hok.

(* between lo and hi, under the input act *)
Variables (x : list (R -> R)) (act : R -> list R) (lo hi : R).
Hypothesis Hx : length x = n.
Hypothesis Cx : forall t, begins g <= t <= ends g -> lo <= t <= hi ->
  Forall (fun f => continuity_pt f t) x.
Definition moves (t : R) : Prop := exists w, in_box w (box d) /\
  Forall2 (fun f v => right_derivative f t v) x (field g t (at_time x t) (act t) w).
Hypothesis Dx : forall t, begins g < t < ends g -> lo < t < hi ->
  within_off off (input d g (place g t) (at_time x t)) (act t) /\ moves t.

Definition dev (t : R) : list R := deviation g (place g t) (at_time x t).
Definition gap (t : R) : R := form (P g (place g t)) (dev t) (dev t) - rho g (place g t).

Lemma duration_pos : 0 < duration g.
Proof. destruct F. unfold duration. lra. Qed.
Lemma d_place t : derivable_pt_lim (place g) t (/ duration g).
Proof.
  pose proof duration_pos. unfold place.
  apply (limit_same (fun u => (u - begins g) * / duration g)); [reflexivity|].
  eapply limit_equal; [derive|]. cbn. ring.
Qed.
Lemma place_in t : begins g <= t <= ends g -> 0 <= place g t <= 1.
Proof.
  intros Ht. pose proof duration_pos as D. unfold place. split.
  - apply Rmult_le_pos; [lra|]. left. now apply Rinv_0_lt_compat.
  - apply (Rmult_le_reg_r (duration g)); auto. unfold Rdiv. rewrite Rmult_assoc, Rinv_l by lra.
    unfold duration. lra.
Qed.
Lemma line_place t : line (place g t) (time (start g)) (time (stop g)) = t.
Proof.
  pose proof duration_pos as D. unfold line, place, duration, begins, ends in *. field. lra.
Qed.
Lemma d_along c t : (length c <= 4)%nat ->
  derivable_pt_lim (fun u => along (place g u) c) t
    (curve' (map val c) (place g t) * / duration g).
Proof.
  intros H. apply (derivable_pt_lim_comp (place g) (curve (map val c))); [apply d_place|].
  apply d_curve. now rewrite map_length.
Qed.
Lemma place_continuous t : continuity_pt (place g) t.
Proof. eapply d_continuous, d_place. Qed.

Lemma at_time_length t : length (at_time x t) = n.
Proof. unfold at_time. now rewrite map_length. Qed.
Lemma dev_length t : length (dev t) = n.
Proof.
  destruct F. unfold dev, deviation. rewrite zip_length; rewrite ?map_length, at_time_length; auto.
Qed.
Lemma dev_continuous t : begins g <= t <= ends g -> lo <= t <= hi ->
  forall i, continuity_pt (fun u => env (dev u) i) t.
Proof.
  intros Ht Hr i. unfold env, dev, deviation. pose proof (Cx t Ht Hr) as C.
  destruct F as [_ _ _ _ Hcv _ _ _ _ _].
  assert (DA : forall c, (0 < length c <= 4)%nat ->
    continuity_pt (fun u => along (place g u) c) t).
  { intros c Hc. eapply d_continuous, d_along. lia. }
  clear - C Hcv DA. revert C Hcv. generalize (nominal g).
  generalize (pred (Pos.to_nat i)). induction x as [|f fs IH]; intros k cs C Hc.
  { apply (continuous_same (fun _ => 0)); [|apply c_const]. now destruct k. }
  destruct cs as [|c cs].
  { apply (continuous_same (fun _ => 0)); [|apply c_const]. now destruct k. }
  inversion C; inversion Hc; subst. destruct k as [|k]; cbn [at_time map zip nth].
  - apply (c_minus f (fun u => along (place g u) c)); auto.
  - apply IH; auto.
Qed.

Lemma d_dev t : begins g < t < ends g -> forall ut w0,
  Forall2 (fun f v => right_derivative f t v) x (field g t (at_time x t) ut w0) ->
  slopes dev t (map (fun v => v * / duration g) (relative g (place g t) (at_time x t) ut w0)).
Proof.
  intros Ht ut w0 Hd. unfold relative. rewrite line_place.
  set (vs := field g t _ _ _) in *. clearbody vs. destruct F as [_ _ _ _ Hcv _ _ _ _ _].
  exists (zip (fun f c u => f u - along (place g u) c) x (nominal g)). split.
  - intros u. unfold dev, deviation. generalize (nominal g).
    clear. induction x as [|f fs IH]; intros [|c cs]; cbn; auto. f_equal. apply IH.
  - pose proof duration_pos as D.
    assert (DA : forall c, (0 < length c <= 4)%nat ->
      derivable_pt_lim (fun u => along (place g u) c) t
        (curve' (map val c) (place g t) * / duration g)) by (intros; apply d_along; lia).
    clear - Hd Hcv D DA. revert Hcv. generalize (nominal g).
    induction Hd as [|f v fs vs Hf Hfs IH]; intros [|c cs] Hc; cbn; constructor; inversion Hc; subst.
    + eapply right_equal.
      { apply (r_minus f (fun u => along (place g u) c)); [exact Hf|]. now apply from_right, DA. }
      field. lra.
    + now apply IH.
Qed.
Lemma d_P t : slopes2 (fun u => P g (place g u)) t (map (map (fun v => v * / duration g)) (P' g)).
Proof.
  exists (zip (zip (fun a b u => line (place g u) a b)) (shape (start g)) (shape (stop g))). split.
  - intros u. unfold P. generalize (shape (start g)) (shape (stop g)).
    clear. induction l as [|row l IH]; intros [|row' l']; cbn; auto. f_equal; auto.
    revert row'. induction row as [|a row IHr]; intros [|b row']; cbn; auto. f_equal. apply IHr.
  - unfold P'. generalize (shape (start g)) (shape (stop g)).
    assert (D : forall a b, right_derivative (fun u => line (place g u) a b) t
      ((val b - val a) * / duration g)).
    { intros a b. apply from_right. unfold line. eapply limit_equal.
      { apply (d_plus (fun u => (1 - place g u) * val a) (fun u => place g u * val b)).
        - apply (d_mult (fun u => 1 - place g u) (fun _ => val a)); [|apply d_const].
          apply (d_minus (fun _ => 1) (place g)); [apply d_const|apply d_place].
        - apply (d_mult (place g) (fun _ => val b)); [apply d_place|apply d_const]. }
      cbn. ring. }
    clear - D. induction l as [|row l IH]; intros [|row' l']; cbn; constructor; auto.
    revert row'. induction row as [|a row IHr]; intros [|b row']; cbn; constructor; auto.
Qed.
Lemma dot_scaled c a : forall b, dot (map (fun v => v * c) a) b = dot a b * c.
Proof. induction a as [|y a IH]; intros [|z b]; cbn; try ring. rewrite IH. ring. Qed.
Lemma form_scaled c M : forall y z, form (map (map (fun v => v * c)) M) y z = form M y z * c.
Proof.
  induction M as [|[|a b] M IH]; intros [|y0 y] [|z0 z]; cbn; try ring.
  rewrite IH, !dot_scaled. ring.
Qed.
Lemma d_gap t : begins g < t < ends g -> forall ut w0,
  Forall2 (fun f v => right_derivative f t v) x (field g t (at_time x t) ut w0) ->
  right_derivative gap t (growth g (place g t) (at_time x t) ut w0 * / duration g).
Proof.
  intros Ht ut w0 Hd. pose proof (d_dev t Ht ut w0 Hd) as Hdev.
  pose proof (d_form _ _ _ _ _ _ _ (d_P t) Hdev Hdev) as D.
  eapply right_equal.
  { unfold gap. apply (r_minus (fun u => form (P g (place g u)) (dev u) (dev u))
      (fun u => rho g (place g u))); [exact D|].
    apply from_right. unfold rho, line. apply (d_plus (fun u => (1 - place g u) * val (level (start g)))
      (fun u => place g u * val (level (stop g)))).
    - apply (d_mult (fun u => 1 - place g u) (fun _ => val (level (start g)))); [|apply d_const].
      apply (d_minus (fun _ => 1) (place g)); [apply d_const|apply d_place].
    - apply (d_mult (place g) (fun _ => val (level (stop g)))); [apply d_place|apply d_const]. }
  rewrite form_scaled, form_scaled_r. rewrite (form_symmetric _ (map _ _)), form_scaled_r.
  unfold growth, rho'. fold (dev t). ring.
Qed.

Lemma means_gap : exists p, forall t,
  means (place g t) (env (dev t)) p (gap t).
Proof.
  set (B := fbernstein (fplace 0 0) (fremaining 0 0)).
  exists (fsub (fform (fshape B g) (fdeviation g) (fdeviation g)) (flevel B g)).
  intros t. destruct F.
  assert (Hs : place g t * IZR (2 ^ 0) = IZR 0 + place g t) by (cbn; ring).
  assert (Hl : length (at_time x t) = length (nominal g)) by (rewrite at_time_length; congruence).
  apply means_sub.
  - apply means_fform.
    + apply (means_shape (place g t) (place g t) (dev t) 0 0); auto. lia.
    + now apply (means_deviation (place g t) (place g t) (dev t) g (at_time x t)).
    + now apply (means_deviation (place g t) (place g t) (dev t) g (at_time x t)).
  - apply (means_level (place g t) (place g t) (dev t) 0 0); auto. lia.
Qed.
Lemma gap_continuous t : begins g <= t <= ends g -> lo <= t <= hi -> continuity_pt gap t.
Proof.
  intros Ht Hr. destruct means_gap as [p Hp].
  apply (continuous_same (fun u => pval (place g u) (env (dev u)) (Polynomials.num p) * / r (den p))).
  { intros u. destruct (Hp u) as [D V]. rewrite V. field. lra. }
  apply (c_mult (fun u => pval (place g u) (env (dev u)) (Polynomials.num p))); [|apply c_const].
  apply c_pval; [apply place_continuous|now apply dev_continuous].
Qed.
Lemma bound_continuous t : begins g <= t <= ends g -> lo <= t <= hi ->
  continuity_pt (fun u => outer_bound w ps (place g u) (dev u) * / duration g) t.
Proof.
  intros Ht Hr. apply (c_mult (fun u => outer_bound w ps (place g u) (dev u))); [|apply c_const].
  clear Hcov Hps. induction ps as [|p l IH]; cbn [outer_bound]; [apply c_const|].
  assert (C : continuity_pt (fun u => outer_at w p (place g u) (dev u)) t).
  { unfold outer_at. apply (c_mult (fun u => pval (place g u * IZR (2 ^ depth p) - IZR (index p))
      (env (dev u)) (Polynomials.num (fmu (multiplier w) (mu p))))); [|apply c_const].
    apply (c_pval (fun u => place g u * IZR (2 ^ depth p) - IZR (index p)) (fun u => env (dev u)));
      [|now apply dev_continuous].
    apply (c_minus (fun u => place g u * IZR (2 ^ depth p)) (fun _ => IZR (index p)));
      [|apply c_const].
    apply (c_mult (place g)); [apply place_continuous|apply c_const]. }
  apply (c_plus (fun u => 1 + outer_at w p (place g u) (dev u)
    * outer_at w p (place g u) (dev u))); auto.
  apply (c_plus (fun _ => 1)); [apply c_const|].
  now apply (c_mult (fun u => outer_at w p (place g u) (dev u))).
Qed.

Lemma segment_stays ta t : begins g <= ta -> lo <= ta -> ta <= t <= ends g -> t <= hi ->
  inside_segment g x ta -> inside_segment g x t.
Proof.
  intros Ha Hlo Ht Hhi H.
  assert (G : gap t <= 0); [|unfold gap in G; unfold inside_segment; fold (dev t); lra].
  apply (barrier gap (fun u => outer_bound w ps (place g u) (dev u) * / duration g) ta t);
    auto; try lra.
  - intros v Hv. apply gap_continuous; lra.
  - intros v Hv. apply bound_continuous; lra.
  - intros v Hv. destruct (Dx v ltac:(lra) ltac:(lra)) as [Hu [w0 [Hw Hd]]].
    eexists. split; [apply (d_gap v ltac:(lra) (act v) w0 Hd)|]. intros Hpos. unfold gap in Hpos.
    pose proof (growth_bounded d w g off ps n Hlimits Hmargin Hok Hoff Hcov Hps (place g v)
      (at_time x v) (act v) w0 (place_in v ltac:(lra)) (at_time_length v) Hw Hu Hpos) as B.
    pose proof (Rinv_0_lt_compat _ duration_pos) as D.
    apply (Rmult_lt_compat_r _ _ _ D) in B. fold (dev v) in B. unfold gap. nra.
  - unfold inside_segment in H. fold (dev ta) in H. unfold gap. lra.
Qed.
End Segment.

(* Segments joined. *)
Definition member_stays (x : list (R -> R)) (lo hi : R) (g : segment) : Prop :=
  forall ta t, begins g <= ta -> lo <= ta -> ta <= t <= ends g -> t <= hi ->
  inside_segment g x ta -> inside_segment g x t.
Lemma place_start g : place g (begins g) = 0.
Proof. unfold place. unfold Rdiv. ring. Qed.
Lemma place_end g : begins g < ends g -> place g (ends g) = 1.
Proof. intros H. unfold place, duration. field. lra. Qed.
Lemma along_ends c : (0 < length c <= 4)%nat ->
  along 0 c = val (first_of c) /\ along 1 c = val (last_of c).
Proof.
  intros H. unfold along, curve, first_of, last_of. rewrite map_length.
  destruct c as [|c0 [|c1 [|c2 [|c3 [|c4 c]]]]]; cbn in H; try lia; cbn; split; ring.
Qed.
Lemma zip_line_row s A B : (forall a b, line s a b = val b) -> length A = length B ->
  zip (line s) A B = map val B.
Proof.
  intros H. revert B. induction A as [|a A IH]; intros [|b B] L; try discriminate; cbn; auto.
  rewrite H, IH; auto.
Qed.
Lemma zip_line k s : (forall a b, line s a b = val b) -> forall A B,
  triangular k A -> triangular k B -> zip (zip (line s)) A B = map (map val) B.
Proof.
  intros H. induction k as [|k IH]; intros [|a A] [|b B] HA HB; cbn [triangular] in *; try tauto.
  destruct HA as [LA HA], HB as [LB HB]. cbn. rewrite IH by auto. f_equal.
  apply zip_line_row; auto. congruence.
Qed.
Lemma zip_line_row_left s A B : (forall a b, line s a b = val a) -> length A = length B ->
  zip (line s) A B = map val A.
Proof.
  intros H. revert B. induction A as [|a A IH]; intros [|b B] L; try discriminate; cbn; auto.
  rewrite H, IH; auto.
Qed.
Lemma zip_line_left k s : (forall a b, line s a b = val a) -> forall A B,
  triangular k A -> triangular k B -> zip (zip (line s)) A B = map (map val) A.
Proof.
  intros H. induction k as [|k IH]; intros [|a A] [|b B] HA HB; cbn [triangular] in *; try tauto.
  destruct HA as [LA HA], HB as [LB HB]. cbn. rewrite IH by auto. f_equal.
  apply zip_line_row_left; auto. congruence.
Qed.
Lemma line_0 a b : line 0 a b = val a.
Proof. unfold line. ring. Qed.
Lemma line_1 a b : line 1 a b = val b.
Proof. unfold line. ring. Qed.
(* One after the other. *)
Lemma after g gs : linked (g :: gs) = true -> Forall (fun g => begins g < ends g) (g :: gs) ->
  forall h, In h gs -> ends g <= begins h.
Proof.
  revert g. induction gs as [|g1 gs IH]; intros g Hl Ht h Hh; [destruct Hh|].
  cbn [linked] in Hl. apply andb_prop in Hl as [Hl1 Hl2]. apply andb_prop in Hl1 as [Hk _].
  apply knot_eqb_eq in Hk. inversion Ht as [|? ? H1 H2]; subst. inversion H2; subst.
  assert (E : ends g = begins g1) by (unfold ends, begins; now rewrite Hk).
  destruct Hh as [<-|Hh]; [lra|]. specialize (IH g1 Hl2 H2 h Hh). lra.
Qed.
Lemma linked_tail g gs : linked (g :: gs) = true -> linked gs = true.
Proof. destruct gs; auto. cbn [linked]. intros H. now apply andb_prop in H. Qed.
Lemma linked_same n d g g' x : segment_ok n d g = true -> segment_ok n d g' = true ->
  linked [g; g'] = true -> let z g := deviation g (place g (ends g)) (at_time x (ends g)) in
  let z' := deviation g' (place g' (ends g)) (at_time x (ends g)) in
  form (P g (place g (ends g))) (z g) (z g) = form (P g' (place g' (ends g))) z' z' /\
  rho g (place g (ends g)) = rho g' (place g' (ends g)).
Proof.
  intros H H' Hl z z'. cbn [linked] in Hl. rewrite Bool.andb_true_r in Hl.
  apply andb_prop in Hl as [Hk Hn]. apply knot_eqb_eq in Hk. apply (list_eqb_eq _ num_eqb_eq) in Hn.
  destruct (segment_facts d g n H) as [_ _ _ _ C T _ _ [S0 S] _].
  destruct (segment_facts d g' n H') as [_ _ _ _ C' T' _ _ [S' S''] _].
  assert (E : ends g = begins g') by (unfold ends, begins; now rewrite Hk).
  unfold z, z'. rewrite (place_end g T).
  replace (place g' (ends g)) with 0 by (rewrite E; symmetry; apply place_start).
  assert (Dev : deviation g 1 (at_time x (ends g)) = deviation g' 0 (at_time x (ends g))).
  { unfold deviation. f_equal.
    transitivity (map val (map last_of (nominal g))).
    - rewrite map_map. apply map_ext_in. intros c Hc. rewrite Forall_forall in C.
      now destruct (along_ends c (C c Hc)).
    - rewrite Hn, map_map. apply map_ext_in. intros c Hc. rewrite Forall_forall in C'.
      symmetry. now destruct (along_ends c (C' c Hc)). }
  rewrite Dev. unfold P, rho. rewrite line_0, line_1.
  rewrite (zip_line n 1 line_1 _ _ S0 S), (zip_line_left n 0 line_0 _ _ S' S''), Hk. auto.
Qed.
Lemma chain n d x lo hi gs : Forall (fun g => segment_ok n d g = true) gs -> linked gs = true ->
  Forall (member_stays x lo hi) gs ->
  forall g0, In g0 gs ->
  forall ta t, (match gs with g :: _ => begins g | [] => ta end) <= ta <= t -> lo <= ta -> t <= hi ->
  (forall g, In g gs -> begins g <= ta <= ends g -> inside_segment g x ta) ->
  begins g0 <= t <= ends g0 -> inside_segment g0 x t.
Proof.
  induction gs as [|g gs IH]; intros Hok Hl Hs g0 H0 ta t Ht Hlo Hhi Hin Hg0; [destruct H0|].
  inversion Hok as [|? ? Hok1 Hok2]; subst. inversion Hs as [|? ? Hs1 Hs2]; subst.
  destruct H0 as [<-|H0].
  { apply (Hs1 ta t); try lra. apply Hin; [now left|]. lra. }
  destruct gs as [|g' gs]; [destruct H0|].
  inversion Hok2 as [|? ? Hok3 _]; subst.
  assert (Times : Forall (fun g => begins g < ends g) (g' :: gs)).
  { eapply Forall_impl; [|exact Hok2]. intros h Hh. now destruct (segment_facts d h n Hh). }
  pose proof (after g' gs (linked_tail _ _ Hl) Times) as Order.
  assert (L : linked [g; g'] = true).
  { cbn [linked] in *. apply andb_prop in Hl as [Hl1 _]. now rewrite Hl1. }
  pose proof (linked_tail _ _ Hl) as Hl2.
  cbn [linked] in Hl. apply andb_prop in Hl as [Hl1 _]. apply andb_prop in Hl1 as [Hk _].
  apply knot_eqb_eq in Hk.
  assert (E : ends g = begins g') by (unfold ends, begins; now rewrite Hk).
  inversion Times as [|? ? T' _]; subst.
  assert (Hb : begins g' <= begins g0).
  { destruct H0 as [<-|H0]; [lra|]. pose proof (Order g0 H0). lra. }
  destruct (Rle_lt_dec (begins g') ta) as [B|B].
  - apply (IH Hok2 Hl2 Hs2 g0 H0 ta t); auto; try lra. intros h Hh. apply Hin. now right.
  - apply (IH Hok2 Hl2 Hs2 g0 H0 (begins g') t); auto; try lra.
    intros h Hh Hr. destruct Hh as [<-|Hh]; [|specialize (Order h Hh); lra].
    rewrite <- E. assert (U : inside_segment g x (ends g)).
    { apply (Hs1 ta (ends g)); try lra. apply Hin; [now left|]. lra. }
    unfold inside_segment in *. destruct (linked_same n d g g' x Hok1 Hok3 L) as [E1 E2].
    cbn zeta in E1. now rewrite <- E1, <- E2.
Qed.

Lemma last_end gs g : In g gs -> linked gs = true ->
  Forall (fun g => begins g < ends g) gs -> begins (hd g gs) <= begins g /\ ends g <= last (map ends gs) 0.
Proof.
  revert g. induction gs as [|g1 gs IH]; intros g Hin Hl Ht; [destruct Hin|].
  inversion Ht as [|? ? T1 T2]; subst. destruct gs as [|g2 gs].
  { destruct Hin as [<-|[]]. cbn. lra. }
  cbn [linked] in Hl. apply andb_prop in Hl as [Hl1 Hl2]. apply andb_prop in Hl1 as [Hk _].
  apply knot_eqb_eq in Hk.
  assert (E : ends g1 = begins g2) by (unfold ends, begins; now rewrite Hk).
  change (last (map ends (g1 :: g2 :: gs)) 0) with (last (map ends (g2 :: gs)) 0). cbn [hd].
  destruct (IH g2 (or_introl eq_refl) Hl2 T2) as [_ A]. inversion T2; subst.
  destruct Hin as [<-|Hin]; [lra|]. destruct (IH g Hin Hl2 T2) as [B C]. cbn [hd] in B. lra.
Qed.

Definition first_size (d : problem) : nat :=
  match segments d with [] => O | g :: _ => length (nominal g) end.
Lemma checked_segments d offs w : check d offs w = true ->
  Forall (fun g => segment_ok (first_size d) d g = true) (segments d) /\
  length offs = length (segments d) /\
  forall g off, In (g, off) (combine (segments d) offs) -> exists ps,
    off_ok (first_size d) d g off = true /\ covered d w off ps = true /\
    forallb (piece_ok d w (products (basis w)) g off) ps = true.
Proof.
  intros H. unfold check in H. fold (first_size d) in H.
  apply andb_prop in H as [_ H]. apply andb_prop in H as [Hlen H]. apply andb_prop in Hlen as [Hlen Lo].
  apply Nat.eqb_eq in Hlen, Lo.
  assert (Each : forall g off, In (g, off) (combine (segments d) offs) -> exists ps,
    segment_ok (first_size d) d g = true /\ off_ok (first_size d) d g off = true /\
    covered d w off ps = true /\ forallb (piece_ok d w (products (basis w)) g off) ps = true).
  { intros g off Hg. rewrite forallb_forall in H.
    assert (G : exists ps, In (g, off, ps) (combine (combine (segments d) offs) (pieces w))).
    { assert (L : length (combine (segments d) offs) = length (pieces w)).
      { rewrite combine_length, Lo, Nat.min_id. auto. }
      clear - Hg L. revert Hg L. generalize (pieces w).
      induction (combine (segments d) offs) as [|g1 gs IH]; intros [|p ps] Hg Hlen; cbn in *;
        try tauto; try discriminate. destruct Hg as [->|Hg]; [eauto|].
      destruct (IH ps Hg) as [q Hq]; eauto. }
    destruct G as [ps G]. specialize (H _ G). cbn beta iota in H.
    apply andb_prop in H as [A B]. apply andb_prop in A as [A1 A2]. apply andb_prop in A1 as [A1 A3].
    eauto 6. }
  split; [|split]; auto.
  - apply Forall_forall. intros g Hg.
    assert (G : exists off, In (g, off) (combine (segments d) offs)).
    { clear - Hg Lo. revert Hg Lo. generalize offs. induction (segments d) as [|g1 gs IH];
        intros [|o os] Hg L; cbn in *; try tauto; try discriminate. destruct Hg as [->|Hg]; [eauto|].
      destruct (IH os Hg) as [q Hq]; eauto. }
    destruct G as [off G]. destruct (Each g off G) as [ps [A _]]. exact A.
  - intros g off Hg. destruct (Each g off Hg) as [ps [_ A]]. eauto.
Qed.

(* What the other theorems read of a funnel that was decided. *)
Record checked (d : problem) (w : witness) : Prop := {
  c_margin : 0 < val (margin w);
  c_limits : Forall proper (limits d);
  c_linked : linked (segments d) = true;
  c_segments : Forall (fun g => segment_ok (first_size d) d g = true) (segments d);
  c_times : Forall (fun g => begins g < ends g) (segments d);
  c_range : forall g, In g (segments d) -> begin d <= begins g /\ ends g <= finish d }.
Lemma check_facts d offs w : check d offs w = true -> checked d w.
Proof.
  intros H. destruct (checked_segments d offs w H) as [Hok _].
  unfold check in H. apply andb_prop in H as [H1 _]. apply andb_prop in H1 as [H1 H3].
  apply andb_prop in H1 as [Hm Hl]. set (n := first_size d) in *.
  assert (Hlim : Forall proper (limits d)).
  { apply Forall_forall. intros l Hin'. rewrite forallb_forall in H3. specialize (H3 l Hin').
    destruct l as [[a b]|]; cbn; auto. now apply num_ltb_lt. }
  assert (Times : Forall (fun g => begins g < ends g) (segments d)).
  { eapply Forall_impl; [|exact Hok]. intros g Hg. now destruct (segment_facts d g n Hg). }
  constructor; auto.
  { apply num_ltb_lt in Hm. now rewrite val_zero in Hm. }
  intros g Hg. destruct (last_end (segments d) g Hg Hl Times) as [A B]. split; auto.
  unfold begin. destruct (segments d); [destruct Hg|]. exact A.
Qed.
(* By segment: x is a list of functions that are continuous, and between knots obey the equations
   under an input that is off by so much. *)
Definition follows (d : problem) (offs : list (list num)) (x : list (R -> R))
  (u : segment -> R -> list R) (lo hi : R) : Prop :=
  length x = first_size d /\
  (forall t, lo <= t <= hi -> Forall (fun f => continuity_pt f t) x) /\
  forall g off t, In (g, off) (combine (segments d) offs) -> begins g < t < ends g -> lo < t < hi ->
    within_off off (input d g (place g t) (at_time x t)) (u g t) /\ moves d g x (u g) t.

Theorem stays_until d offs w : check d offs w = true -> forall x u lo hi, begin d <= lo ->
  follows d offs x u lo hi -> forall ta t, lo <= ta -> ta <= t <= hi -> inside d x ta -> inside d x t.
Proof.
  intros H x u lo hi Hb [Lx [Cx Dx]] ta t Ha Ht Hin.
  destruct (checked_segments d offs w H) as [Hok [Lo Each]].
  destruct (check_facts d offs w H) as [Hm Hlim Hl _ Times Range]. set (n := first_size d) in *.
  intros g Hg Hgt. apply (chain n d x ta hi (segments d) Hok Hl) with (ta := ta);
    auto; try lra.
  2:{ unfold begin in Hb. destruct (segments d); lra. }
  apply Forall_forall. intros h Hh.
  assert (G : exists off, In (h, off) (combine (segments d) offs)).
  { clear - Hh Lo. revert Hh Lo. generalize offs. induction (segments d) as [|g1 gs IH];
      intros [|o os] Hg L; cbn in *; try tauto; try discriminate. destruct Hg as [->|Hg]; [eauto|].
      destruct (IH os Hg) as [q Hq]; eauto. }
  destruct G as [off G]. destruct (Each h off G) as [ps [O [B C]]].
  assert (A : segment_ok n d h = true) by (rewrite Forall_forall in Hok; auto).
  intros ta' t' Ha' Hlo Ht' Hhi Hin'.
  apply (segment_stays d w h off ps n Hlim Hm A O B C x (u h) ta hi Lx) with (ta := ta'); auto.
  - intros v _ Hv. apply Cx. lra.
  - intros v Hv Hv'. apply Dx; auto. lra.
Qed.

Lemma solution_length d w x : checked d w -> (0 < length (segments d))%nat -> solution d x ->
  length x = first_size d.
Proof.
  intros C Hne [_ Dx]. destruct (segments d) as [|g gs] eqn:E; [cbn in Hne; lia|].
  assert (Hg : In g (segments d)) by (rewrite E; now left).
  pose proof (c_segments d w C) as Hok. rewrite Forall_forall in Hok.
  pose proof (segment_facts d g _ (Hok g Hg)) as [_ El _ _ _ T _ _ _ _].
  destruct (Dx g ((begins g + ends g) / 2) ltac:(rewrite <- E; exact Hg) ltac:(lra)) as [w0 [_ F]].
  apply Condition.Forall2_length in F. unfold field in F. rewrite map_length in F. congruence.
Qed.
Theorem stays d w : check d (unmoved d) w = true -> (0 < length (segments d))%nat ->
  forall x, solution d x -> forall ta, begin d <= ta -> inside d x ta ->
  forall t, ta <= t <= finish d -> inside d x t.
Proof.
  intros H Hne x Hx ta Ha Hin t Ht. pose proof (check_facts _ _ _ H) as C.
  pose proof (solution_length d w x C Hne Hx) as Lx. destruct Hx as [Cx Dx].
  set (u := fun g v => input d g (place g v) (at_time x v)).
  apply (stays_until d _ w H x u ta (finish d) Ha) with (ta := ta); auto; [|lra].
  split; [|split]; auto; [intros v Hv; apply Cx; lra|]. intros g off v Hg Hv _.
  assert (Eo : off = []).
  { apply in_combine_r in Hg. unfold unmoved in Hg. apply in_map_iff in Hg as [? [<- _]]. reflexivity. }
  subst off. split; [reflexivity|]. apply in_combine_l in Hg. exact (Dx g v Hg Hv).
Qed.
End Stays.
