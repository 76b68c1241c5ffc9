(* No theorem is empty: every premise that is called a solution, a run or a motion is met by what a
   real robot, a real controller and a real recording do. Nothing else uses this file. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Forms Claim Calculus Tubes Samples Moving.
Import ListNotations.
Open Scope R_scope.

(* Continuous on one side. *)
Definition continuous_right (f : R -> R) (t : R) : Prop :=
  forall e, 0 < e -> exists d, 0 < d /\ forall h, 0 < h < d -> Rabs (f (t + h) - f t) < e.
Definition continuous_left (f : R -> R) (t : R) : Prop :=
  forall e, 0 < e -> exists d, 0 < d /\ forall h, 0 < h < d -> Rabs (f (t - h) - f t) < e.
Lemma both_sides f t : continuous_left f t -> continuous_right f t -> continuity_pt f t.
Proof.
  intros L R e He. destruct (L e He) as [d [Hd N]], (R e He) as [d' [Hd' N']].
  exists (Rmin d d'). split; [now apply Rmin_glb_lt|]. intros v [[_ Hv] Hdist]. cbn in *.
  unfold R_dist in *. pose proof (Rmin_l d d'). pose proof (Rmin_r d d'). apply Rabs_def2 in Hdist.
  destruct (Rlt_dec v t) as [B|B].
  - replace v with (t - (t - v)) by ring. apply N. lra.
  - replace v with (t + (v - t)) by ring. apply N'. lra.
Qed.
Lemma right_of f g t b : continuity_pt g t -> t < b -> (forall v, t <= v <= b -> f v = g v) ->
  continuous_right f t.
Proof.
  intros C Hb E e He. destruct (C e He) as [d [Hd N]]. exists (Rmin d (b - t)).
  split; [apply Rmin_glb_lt; lra|]. intros h Hh. pose proof (Rmin_l d (b - t)).
  pose proof (Rmin_r d (b - t)). rewrite !E by lra. apply N. split; [split; [exact I|lra]|].
  cbn. unfold R_dist. rewrite Rabs_right; lra.
Qed.
Lemma left_of f g t a : continuity_pt g t -> a < t -> (forall v, a <= v <= t -> f v = g v) ->
  continuous_left f t.
Proof.
  intros C Ha E e He. destruct (C e He) as [d [Hd N]]. exists (Rmin d (t - a)).
  split; [apply Rmin_glb_lt; lra|]. intros h Hh. pose proof (Rmin_l d (t - a)).
  pose proof (Rmin_r d (t - a)). rewrite !E by lra. apply N. split; [split; [exact I|lra]|].
  cbn. unfold R_dist. rewrite Rabs_left; lra.
Qed.

(* From a to b nothing is sampled and w does not jump: x is what the textbook calls a solution, ys,
   which has a derivative from both sides at every time between knots; v is the input there. *)
Definition smooth_part (d : problem) (v : segment -> R -> list R) (x : list (R -> R)) (a b : R)
  : Prop :=
  a < b /\ exists ys,
    (forall t, a <= t <= b -> Forall (fun f => continuity_pt f t) ys) /\
    Forall2 (fun f g => forall t, a <= t <= b -> f t = g t) x ys /\
    (forall g t, In g (segments d) -> begins g < t < ends g -> a <= t < b ->
      exists w, in_box w (box d) /\
        Forall2 (fun f s => derivable_pt_lim f t s) ys (field g t (at_time ys t) (v g t) w)).
(* Such parts, one after the other: up to when each lasts, and its input. *)
Fixpoint parts (d : problem) (x : list (R -> R)) (a : R)
  (rest : list (R * (segment -> R -> list R))) : Prop :=
  match rest with
  | [] => True
  | (b, v) :: rest' => smooth_part d v x a b /\ parts d x b rest'
  end.
Definition until {A : Type} (a : R) (rest : list (R * A)) : R := last (map fst rest) a.
Definition still (x : list (R -> R)) (a b : R) : Prop :=
  Forall (fun f => forall t, (t <= a -> f t = f a) /\ (b <= t -> f t = f b)) x.

Lemma until_step {A : Type} a b (v : A) rest : until a ((b, v) :: rest) = until b rest.
Proof.
  unfold until. cbn [map fst]. destruct (map fst rest) as [|c l] eqn:E; [reflexivity|].
  change (last (b :: c :: l) a) with (last (c :: l) a). clear E. revert c.
  induction l as [|e l IH]; intros c; [reflexivity|]. apply IH.
Qed.
Lemma parts_last d x : forall rest a, parts d x a rest -> a <= until a rest.
Proof.
  induction rest as [|[b v] rest IH]; intros a H; [cbn; lra|]. destruct H as [[Hab _] H].
  rewrite until_step. specialize (IH b H). lra.
Qed.
Lemma same_at x ys a b t : Forall2 (fun f g => forall t, a <= t <= b -> f t = g t) x ys ->
  a <= t <= b -> at_time x t = at_time ys t.
Proof.
  intros H Ht. unfold at_time. induction H as [|f g x ys E H IH]; cbn; [reflexivity|].
  now rewrite (E t Ht), IH.
Qed.

(* To the right of every time before the last: the part, its input, continuity and derivatives. *)
Lemma part_right d x : forall rest a t, parts d x a rest -> a <= t < until a rest ->
  exists a' b v, In (b, v) rest /\ a <= a' <= t /\ t < b /\
    (a' = a \/ In a' (map fst rest)) /\
    Forall (fun f => continuous_right f t) x /\
    forall g, In g (segments d) -> begins g < t < ends g ->
      exists w, in_box w (box d) /\
        Forall2 (fun f s => right_derivative f t s) x (field g t (at_time x t) (v g t) w).
Proof.
  induction rest as [|[b v] rest IH]; intros a t H Ht; [cbn in Ht; lra|].
  destruct H as [[Hab [ys [C [E D]]]] H]. rewrite until_step in Ht.
  destruct (Rlt_le_dec t b) as [L|L].
  - exists a, b, v. split; [now left|]. split; [lra|]. split; auto. split; [now left|]. split.
    + specialize (C t ltac:(lra)). clear - C E L Ht Hab.
      induction E as [|f g x ys Ef E IH]; constructor; inversion C; subst; auto.
      apply (right_of f g t b); auto. intros s Hs. apply Ef. lra.
    + intros g Hg Hr. destruct (D g t Hg Hr ltac:(lra)) as [w [Hw F]]. exists w. split; auto.
      rewrite (same_at x ys a b t E) by lra. set (s := field _ _ _ _ _) in *. clearbody s.
      clear - E F L Ht. revert s F.
      induction E as [|f y x ys Ef E IH]; intros s F; inversion F; subst; constructor; auto.
      apply (right_near y f t _ (b - t)); [lra| |now apply from_right].
      intros r Hr. symmetry. apply Ef. lra.
  - destruct (IH b t H ltac:(lra)) as [a' [b' [v' [Hin [A [B [S R]]]]]]].
    exists a', b', v'. split; [now right|]. split; [lra|]. split; auto. split; auto.
    right. cbn [map fst]. destruct S as [->|S]; [now left|now right].
Qed.
Lemma part_left d x : forall rest a t, parts d x a rest -> a < t <= until a rest ->
  Forall (fun f => continuous_left f t) x.
Proof.
  induction rest as [|[b v] rest IH]; intros a t H Ht; [cbn in Ht; lra|].
  destruct H as [[Hab [ys [C [E D]]]] H]. rewrite until_step in Ht.
  destruct (Rle_lt_dec t b) as [L|L]; [|exact (IH b t H (conj L (proj2 Ht)))].
  specialize (C t ltac:(lra)). clear - C E L Ht Hab.
  induction E as [|f g x ys Ef E IH]; constructor; inversion C; subst; auto.
  apply (left_of f g t a); auto; [lra|]. intros s Hs. apply Ef. lra.
Qed.
Lemma parts_continuous d x a rest : parts d x a rest -> still x a (until a rest) ->
  forall t, a <= t <= until a rest -> Forall (fun f => continuity_pt f t) x.
Proof.
  intros H S t Ht.
  assert (L : Forall (fun f => continuous_left f t) x).
  { destruct (Rle_lt_or_eq_dec a t (proj1 Ht)) as [N|<-]; [now apply (part_left d x rest a t H)|].
    eapply Forall_impl; [|exact S]. intros f F e He. exists 1. split; [lra|]. intros h Hh.
    rewrite (proj1 (F (a - h))) by lra. now rewrite Rminus_diag_eq, Rabs_R0. }
  assert (R : Forall (fun f => continuous_right f t) x).
  { destruct (Rle_lt_or_eq_dec t (until a rest) (proj2 Ht)) as [N|N].
    - destruct (part_right d x rest a t H ltac:(lra)) as [a' [b [v [_ [_ [_ [_ [C _]]]]]]]]. exact C.
    - rewrite N.
      eapply Forall_impl; [|exact S]. intros f F e He. exists 1. split; [lra|]. intros h Hh.
      rewrite (proj2 (F (until a rest + h))) by lra. now rewrite Rminus_diag_eq, Rabs_R0. }
  rewrite Forall_forall in *. intros f Hf. apply both_sides; auto.
Qed.

(* A run whose input is the policy's of each time. *)
Theorem a_run_is_a_solution d x rest : let policy g t := input d g (place g t) (at_time x t) in
  Forall (fun p => snd p = policy) rest -> parts d x (begin d) rest ->
  until (begin d) rest = finish d -> still x (begin d) (finish d) ->
  (forall g, In g (segments d) -> begin d <= begins g /\ ends g <= finish d) -> solution d x.
Proof.
  intros policy P H U S B. rewrite <- U in S. split.
  - rewrite <- U. now apply (parts_continuous d).
  - intros g t Hg Ht. destruct (B g Hg).
    destruct (part_right d x rest (begin d) t H ltac:(lra))
      as [a' [b [v [Hin [_ [_ [_ [_ D]]]]]]]].
    rewrite Forall_forall in P. specialize (P _ Hin). cbn [snd] in P. subst v. now apply D.
Qed.

(* A run of a zero-order hold. Each part has a sample: when it was taken, the segment of the policy
   then, and what was measured wrong; its input is the policy's for what was measured, and is held
   until the part ends, at the next sample, at a knot, or where w jumps. *)
Record held_part := Held { stop_at : R; taken : R; policy_of : segment; wrong : list R }.
Section Hold.
Variables (d : problem) (x : list (R -> R)).
Definition sampled_input (p : held_part) : list R :=
  input d (policy_of p) (place (policy_of p) (taken p))
    (zip Rplus (at_time x (taken p)) (wrong p)).
Definition as_part (p : held_part) : R * (segment -> R -> list R) :=
  (stop_at p, fun _ _ => sampled_input p).
Fixpoint applied (ps : list held_part) (t : R) : list R :=
  match ps with
  | [] => []
  | p :: ps' => if Rlt_dec t (stop_at p) then sampled_input p else applied ps' t
  end.
(* The sample of a part is no newer than its start a, and no older than the hold at its end. *)
Fixpoint sampled (period : num) (errors : list num) (since a : R) (ps : list held_part) : Prop :=
  match ps with
  | [] => True
  | p :: ps' =>
      (In (policy_of p) (segments d) /\ begins (policy_of p) <= taken p <= ends (policy_of p) /\
        since <= taken p <= a /\ stop_at p - taken p <= val period /\
        Forall2 (fun v most => Rabs v <= val most) (wrong p) errors) /\
      sampled period errors since (stop_at p) ps'
  end.
End Hold.

Lemma held_right d x period errors since : forall ps a t, parts d x a (map (as_part d x) ps) ->
  sampled d period errors since a ps -> a <= t < until a (map (as_part d x) ps) ->
  was_applied d period errors x since t (applied d x ps t) /\
  forall g, In g (segments d) -> begins g < t < ends g -> exists w, in_box w (box d) /\
    Forall2 (fun f s => right_derivative f t s) x (field g t (at_time x t) (applied d x ps t) w).
Proof.
  induction ps as [|p ps IH]; intros a t H S Ht; [cbn in Ht; lra|].
  change (map (as_part d x) (p :: ps))
    with ((stop_at p, fun (_ : segment) (_ : R) => sampled_input d x p) :: map (as_part d x) ps) in *.
  rewrite until_step in Ht. cbn [applied sampled] in *.
  destruct S as [[S1 [S2 [S3 [S4 S5]]]] S]. destruct (Rlt_dec t (stop_at p)) as [L|L].
  - split.
    + exists (policy_of p), (taken p), (wrong p). repeat split; auto; lra.
    + destruct H as [Hp _].
      destruct (part_right d x [as_part d x p] a t (conj Hp Logic.I) ltac:(cbn; lra))
        as [a' [b [v [Hin [_ [_ [_ [_ D]]]]]]]].
      destruct Hin as [E|[]]. injection E as <- <-. exact D.
  - destruct H as [_ H]. apply (IH (stop_at p) t H S). lra.
Qed.

Theorem a_zero_order_hold_is_a_held_solution d period errors since x ps :
  Forall (fun g => length x = length (nominal g)) (segments d) ->
  parts d x since (map (as_part d x) ps) -> sampled d period errors since since ps ->
  until since (map (as_part d x) ps) = finish d -> still x since (finish d) ->
  (forall g, In g (segments d) -> ends g <= finish d) ->
  held_solution d period errors since x (applied d x ps).
Proof.
  intros N H S U Q B. split; auto. rewrite <- U in Q. split.
  - rewrite <- U. now apply (parts_continuous d).
  - intros g t Hg Ht. specialize (B g Hg). split; intros Hs;
      destruct (held_right d x period errors since ps since t H S ltac:(lra)) as [A D]; auto.
Qed.

(* One that the definition of 0.2 did not allow: x' = u, knots at 0 and 1, u = - x sampled at 0 and
   1/2 s. It starts anywhere, and is not a line. *)
Module Example.
Definition n (a : Z) : num := (a, 1%positive).
Definition only : segment :=
  Segment (Knot (n 0) [[n 1]] (n 1)) (Knot (n 1) [[n 1]] (n 1)) [[n 0]] [[n 0]] [[[n 1]]]
    [[([0; 0; 1]%nat, n 1)]] [].
Definition robot : problem := Problem [only] [None] [] None.
Definition x (x0 t : R) : R :=
  if Rle_dec t 0 then x0
  else if Rle_dec t (1 / 2) then x0 * (1 - t)
  else if Rle_dec t 1 then x0 * (3 / 4 - t / 2) else x0 / 4.
Definition samples : list held_part := [Held (1 / 2) 0 only [0]; Held 1 (1 / 2) only [0]].

Lemma times : begins only = 0 /\ ends only = 1 /\ begin robot = 0 /\ finish robot = 1.
Proof. unfold begins, ends, begin, finish, val. cbn. unfold ends, begins, val. cbn. repeat split; lra. Qed.
Lemma robot_input x0 p : wrong p = [0] -> policy_of p = only ->
  sampled_input robot [x x0] p = [- x x0 (taken p)].
Proof.
  intros W O. unfold sampled_input, input, wanted, deviation, along, curve, clip. rewrite W, O.
  cbn. unfold val. cbn. f_equal. field.
Qed.
Lemma moved u t : field only t [u] [t] [] = [t].
Proof. unfold field. cbn. unfold val. cbn. f_equal. field. Qed.
Lemma line_part x0 p a slope b : a < stop_at p -> wrong p = [0] -> policy_of p = only ->
  - x x0 (taken p) = slope -> (forall t, a <= t <= stop_at p -> x x0 t = slope * t + b) ->
  smooth_part robot (fun _ _ => sampled_input robot [x x0] p) [x x0] a (stop_at p).
Proof.
  intros L W O Hs E. split; auto. exists [fun t => slope * t + b].
  assert (D : forall t, derivable_pt_lim (fun t => slope * t + b) t slope).
  { intros t. eapply limit_equal; [apply d_plus; [apply d_line|apply d_const]|ring]. }
  split; [|split].
  - intros t _. constructor; [|constructor]. eapply d_continuous, D.
  - constructor; [|constructor]. exact E.
  - intros g t [<-|[]] _ _. exists []. split; [constructor|]. rewrite robot_input, Hs by auto.
    unfold field. cbn. constructor; [|constructor]. eapply limit_equal; [apply D|].
    unfold val. cbn. field.
Qed.
Theorem it_runs x0 :
  held_solution robot (1%Z, 2%positive) [n 0] 0 [x x0] (applied robot [x x0] samples).
Proof.
  destruct times as [T0 [T1 [T2 T3]]].
  assert (X : x x0 0 = x0 /\ x x0 (1 / 2) = x0 / 2).
  { unfold x. repeat destruct (Rle_dec _ _); lra. }
  assert (F : val (1%Z, 2%positive) = 1 / 2) by (unfold val; cbn; lra).
  assert (Z : val (n 0) = 0) by (unfold val; cbn; field).
  apply a_zero_order_hold_is_a_held_solution.
  - repeat constructor.
  - cbn [map samples as_part parts stop_at]. repeat split; try lra.
    + apply (line_part x0 (Held (1 / 2) 0 only [0]) 0 (- x0) x0); cbn; auto; try lra.
      intros t Ht. unfold x. repeat destruct (Rle_dec _ _); try nra.
      assert (t = 0) by lra. subst. ring.
    + apply (line_part x0 (Held 1 (1 / 2) only [0]) (1 / 2) (- (x0 / 2)) (3 / 4 * x0)); cbn; auto; try lra.
      intros t Ht. unfold x. repeat destruct (Rle_dec _ _); try nra.
      assert (t = 1 / 2) by lra. subst. field.
  - cbn [samples sampled stop_at taken policy_of wrong]. rewrite T0, T1, F.
    repeat split; try (now left); try lra; (constructor; [rewrite Rabs_R0, Z; lra|constructor]).
  - rewrite T3. reflexivity.
  - rewrite T3. constructor; [|constructor]. intros t. unfold x.
    split; intros Ht; repeat destruct (Rle_dec _ _); try lra.
    assert (t = 1) as -> by lra. lra.
  - intros g [<-|[]]. rewrite T1, T3. lra.
Qed.
(* The same robot under its policy at every time. *)
Definition e (x0 t : R) : R := x0 * exp (- Rmax 0 (Rmin 1 t)).
Theorem it_runs_continuously x0 : solution robot [e x0].
Proof.
  destruct times as [T0 [T1 [T2 T3]]]. set (f := fun t => x0 * exp ((-1) * t)).
  assert (D : forall t, derivable_pt_lim f t (- f t)).
  { intros t. unfold f. eapply limit_equal.
    { apply (d_mult (fun _ => x0)); [apply d_const|].
      apply (derivable_pt_lim_comp (fun u => (-1) * u) exp); [apply d_line|apply derivable_pt_lim_exp]. }
    cbn beta. ring. }
  assert (E : forall t, 0 <= t <= 1 -> e x0 t = f t).
  { intros t Ht. unfold e, f. rewrite Rmin_right, Rmax_right by lra. f_equal. f_equal. ring. }
  apply (a_run_is_a_solution _ _
    [(1, fun g t => input robot g (place g t) (at_time [e x0] t))]).
  - repeat constructor.
  - rewrite T2. split; [|exact Logic.I]. split; [lra|]. exists [f]. split; [|split].
    + intros t _. constructor; [|constructor]. eapply d_continuous, D.
    + constructor; [|constructor]. exact E.
    + intros g t [<-|[]] _ Ht. exists []. split; [constructor|].
      unfold at_time, input, wanted, deviation, along, curve, clip, field. cbn. rewrite E by lra.
      constructor; [|constructor]. eapply limit_equal; [apply D|]. unfold val. cbn. field.
  - rewrite T3. reflexivity.
  - rewrite T2, T3. constructor; [|constructor]. intros t.
    split; intros Ht; unfold e, Rmax, Rmin; repeat destruct (Rle_dec _ _); try lra; f_equal; f_equal; lra.
  - intros g [<-|[]]. rewrite T0, T1, T2, T3. lra.
Qed.
End Example.

(* Any sequence of states is a motion, for some disturbance. *)
Lemma minus_then_plus a : forall b, length a = length b -> plus a (minus b a) = b.
Proof.
  unfold plus, minus. induction a as [|a0 a IH]; intros [|b0 b] H; try discriminate; [reflexivity|].
  cbn. rewrite IH by (now injection H). f_equal. ring.
Qed.
Theorem any_states_are_a_motion m p (x : nat -> list R) :
  (forall k, length (x k) = length (x_range m)) -> exists d, motion m p x d.
Proof.
  intros L. set (f := fun k => maps_to m (x k) (commanded p k (x k))).
  assert (Lf : forall k, length (f k) = length (x_range m)).
  { intros k. unfold f, maps_to, equations_of. now rewrite !map_length, seq_length. }
  exists (fun k => minus (x (S k)) (f k)). split; auto. intros k _. split.
  - unfold minus. rewrite zip_length; rewrite L; auto.
  - symmetry. apply minus_then_plus. now rewrite L.
Qed.

(* A difference equation runs from any state under any inputs, and so does the observer beside it,
   whatever was measured. *)
Section Linear.
Variables (a : list num).
Definition next (r : list R) (y0 : R) (x : list R) : list R :=
  plus (plus (map (fun c => val c * y0) a) (tl x ++ [0])) r.
Lemma next_length r y0 x : (0 < length a)%nat -> length x = length a -> length r = length a ->
  length (next r y0 x) = length a.
Proof.
  intros H Lx Lr. unfold next, plus.
  assert (T : length (tl x ++ [0]) = length a).
  { rewrite app_length. destruct x; cbn in *; lia. }
  assert (A : length (zip Rplus (map (fun c => val c * y0) a) (tl x ++ [0])) = length a).
  { rewrite zip_length; now rewrite map_length. }
  rewrite zip_length; congruence.
Qed.
Lemma linear_step d r x w : length x = length a -> length r = length a ->
  step (Linear a) d r x w [] (next r (hd 0 x + hd 0 d) x) [hd 0 x + hd 0 d].
Proof. intros Lx Lr. cbn [step hd]. repeat split; auto. Qed.

(* d and r may depend on the state, as under a policy. *)
Fixpoint states_from (d r : nat -> list R -> list R) (into : nat -> list R) (x0 : list R) (k : nat)
  : list R :=
  match k with
  | O => x0
  | S j => let x := states_from d r into x0 j in
      plus (next (r j x) (hd 0 x + hd 0 (d j x)) x) (into j)
  end.
Lemma states_length d r into x0 : (0 < length a)%nat -> length x0 = length a ->
  (forall k x, length (r k x) = length a) -> (forall k, length (into k) = length a) ->
  forall k, length (states_from d r into x0 k) = length a.
Proof.
  intros Ha H0 Hr Hi. induction k as [|k IH]; [exact H0|]. cbn [states_from]. unfold plus at 1.
  rewrite zip_length; rewrite next_length; auto.
Qed.
Lemma plus_nothing : forall x, plus x (repeat 0 (length x)) = x.
Proof. induction x as [|x0 x IH]; [reflexivity|]. unfold plus in *. cbn. rewrite IH. f_equal. ring. Qed.

Definition nothing (_ : nat) : list R := repeat 0 (length a).
Lemma simulated d r x0 : (0 < length a)%nat -> length x0 = length a ->
  (forall k x, length (r k x) = length a) -> let xs := states_from d r nothing x0 in
  forall k w, step (Linear a) (d k (xs k)) (r k (xs k)) (xs k) w [] (xs (S k))
    [hd 0 (xs k) + hd 0 (d k (xs k))].
Proof.
  intros Ha H0 Hr xs k w.
  assert (X : length (xs k) = length a).
  { apply states_length; auto. intros i. apply repeat_length. }
  replace (xs (S k)) with (next (r k (xs k)) (hd 0 (xs k) + hd 0 (d k (xs k))) (xs k));
    [now apply linear_step|].
  change (xs (S k)) with (plus (next (r k (xs k)) (hd 0 (xs k) + hd 0 (d k (xs k))) (xs k)) (nothing k)).
  unfold nothing. rewrite <- (next_length (r k (xs k)) (hd 0 (xs k) + hd 0 (d k (xs k))) (xs k)) by auto.
  now rewrite plus_nothing.
Qed.
Lemma observed d r L z0 (innovation : nat -> list R) : (0 < length a)%nat -> length L = length a ->
  length z0 = length a -> (forall k x, length (r k x) = length a) ->
  (forall k, length (innovation k) = 1%nat) ->
  let zs := states_from d r (fun k => image (map (map val) L) (innovation k)) z0 in
  forall k w, exists z' yz, step (Linear a) (d k (zs k)) (r k (zs k)) (zs k) w [] z' yz /\
    zs (S k) = plus z' (image (map (map val) L) (innovation k)) /\
    plus [hd 0 (zs k) + hd 0 (d k (zs k))] (innovation k) = plus yz (innovation k) /\
    length (innovation k) = length yz.
Proof.
  intros Ha HL H0 Hr He zs k w.
  assert (Z : length (zs k) = length a).
  { apply states_length; auto. intros i. unfold image. now rewrite !map_length. }
  exists (next (r k (zs k)) (hd 0 (zs k) + hd 0 (d k (zs k))) (zs k)), [hd 0 (zs k) + hd 0 (d k (zs k))].
  split; [now apply linear_step|]. auto.
Qed.

Theorem any_measurements_are_a_run L (d r : nat -> list R) x0 z0 innovation : (0 < length a)%nat ->
  length L = length a -> length x0 = length a -> length z0 = length a ->
  (forall k, length (r k) = length a) -> (forall k, length (innovation k) = 1%nat) ->
  exists s : run (Linear a) L,
    Tubes.x s O = x0 /\ Tubes.z s O = z0 /\ Tubes.e s = innovation.
Proof.
  intros Ha HL Hx Hz Hr He.
  exists (Run (Linear a) L d r (fun _ => []) _ (fun _ => []) _ _ (fun _ => []) innovation _
    (fun k => simulated (fun k _ => d k) (fun k _ => r k) x0 Ha Hx (fun k _ => Hr k) k [])
    (fun k => observed (fun k _ => d k) (fun k _ => r k) L z0 innovation Ha HL Hz (fun k _ => Hr k) He k [])).
  auto.
Qed.
(* The same around a plan, whatever it plays and however far its policy is engaged: the premises of
   stays_near_plan. *)
Theorem any_plan_is_followed b b0 c feedback L (u kappa : nat -> R) x0 z0 innovation :
  (0 < length a)%nat -> length b = length a -> length L = length a -> length x0 = length a ->
  length z0 = length a -> (forall k, length (innovation k) = 1%nat) ->
  exists x y z measured : nat -> list R, x O = x0 /\ z O = z0 /\
  (forall k, step (Linear a) [val b0 * u k + val c] (map (fun v => val v * u k) b)
    (x k) [] [] (x (S k)) (y k)) /\
  (forall k, let applied := u k - kappa k * dot (map val feedback) (minus (z k) (x k)) in
    exists z' yz, step (Linear a) [val b0 * applied + val c] (map (fun v => val v * applied) b)
      (z k) [] [] z' yz /\
    z (S k) = plus z' (image (map (map val) L) (innovation k)) /\
    measured k = plus yz (innovation k) /\ length (innovation k) = length yz).
Proof.
  intros Ha Hb HL Hx Hz He.
  pose proof (simulated (fun k _ => [val b0 * u k + val c]) (fun k _ => map (fun v => val v * u k) b)
    x0 Ha Hx ltac:(intros; cbn beta; rewrite map_length; auto)) as S.
  cbn zeta in S. set (xs := states_from _ _ _ x0) in S.
  pose (input_of k z := u k - kappa k * dot (map val feedback) (minus z (xs k))).
  pose proof (observed (fun k z => [val b0 * input_of k z + val c])
    (fun k z => map (fun v => val v * input_of k z) b) L z0 innovation Ha HL Hz
    ltac:(intros; cbn beta; rewrite map_length; auto) He) as O.
  cbn zeta in O. set (zs := states_from _ _ _ z0) in O.
  eexists xs, _, zs, _. split; [reflexivity|]. split; [reflexivity|]. split.
  - intros k. exact (S k []).
  - intros k. exact (O k []).
Qed.
End Linear.
