(* A policy that is held, late, or measures with an error: what inputs are off by at most is bounded
   by how fast the policy turns, and what starts in the funnel stays in it. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Claim Calculus Condition Definite Pushed Funnel Stays Goal Valid
  Files Moving Turning.
Import ListNotations.
Open Scope R_scope.

(* What the errors do to input i at most. *)
Definition shaken (g : segment) (errors : list num) (i : nat) : num :=
  largest (map (fun row => ndot (map nabs row) errors) (rows_of (row_of g i))).
(* The segments that [start - period, start] meets in more than their end, and g itself. *)
Definition seen (period : num) (g : segment) (all : list (segment * (list num * list num)))
  : list (segment * (list num * list num)) :=
  let since := nsub (time (start g)) period in
  filter (fun e => andb (num_ltb since (time (stop (fst e))))
    (num_leb (time (start (fst e))) (time (start g)))) all.
Definition worst (i : nat) (rows : list (list num)) : num :=
  largest (map (fun row => nth i row nzero) rows).
Definition prepared (d : problem) (errors : list num) (parts : list (segment * list num)) :=
  map (fun e => (fst e, (snd e, map (shaken (fst e) errors) (seq 0 (length (limits d)))))) parts.
Definition width_of (d : problem) (period : num) (all : list (segment * (list num * list num)))
  (e : segment * list num) : list num :=
  let s := seen period (fst e) all in
  map (fun i => nadd (nmul period (worst i (map (fun e => fst (snd e)) s)))
    (worst i (map (fun e => snd (snd e)) s))) (seq 0 (length (limits d))).
Definition offs_of (d : problem) (period : num) (errors : list num) (rates : list (list num))
  : list (list num) :=
  let parts := combine (segments d) rates in
  map (width_of d period (prepared d errors parts)) parts.

(* The policy does not jump. *)
Fixpoint smooth (gs : list segment) : bool :=
  match gs with
  | g :: ((g' :: _) as rest) =>
      andb (andb (list_eqb num_eqb (map last_of (feed g)) (map first_of (feed g')))
        (list_eqb (list_eqb num_eqb) (map (map last_of) (gains g)) (map (map first_of) (gains g'))))
        (smooth rest)
  | _ => true
  end.
Definition feeds_ok (g : segment) : bool :=
  forallb (fun c => andb (Nat.ltb 0 (length c)) (Nat.leb (length c) 4)) (feed g).

Section Held.
Context {K : Ints}.

(* By segment: the rates of the inputs, and what proves them; entries of (delta, w) that only push. *)
Record rate_witness := Rates {
  rates : list (list num); pushing : list bool; turns : list (list rate_piece) }.
Definition held_ok (d : problem) (period : num) (errors : list num) (w : witness) (r : rate_witness)
  : bool :=
  let offs := offs_of d period errors (rates r) in
  andb (andb (funnel_ok d offs w) (bounds_ok d offs))
  (andb (andb (andb (Nat.eqb (length (rates r)) (length (segments d)))
      (Nat.eqb (length errors) (first_size d)))
    (andb (forallb (num_leb nzero) errors) (forallb feeds_ok (segments d))))
  (andb (num_leb nzero period)
    (if num_leb period nzero then true else
      andb (andb (smooth (segments d)) (forallb (forallb (num_ltb nzero)) (rates r)))
        (andb (andb (forallb (fun row => Nat.eqb (length row) (length (limits d))) (rates r))
            (Nat.eqb (length (turns r)) (length (segments d))))
          (forallb (fun e => let '(g, row, off, qs) := e in rates_ok d w (pushing r) g off row qs)
            (combine (combine (combine (segments d) (rates r)) offs) (turns r))))))).

Lemma disjoint gs : linked gs = true -> Forall (fun g => begins g < ends g) gs ->
  forall g h, In g gs -> In h gs -> g = h \/ ends g <= begins h \/ ends h <= begins g.
Proof.
  induction gs as [|g0 gs IH]; intros Hl Ht g h Hg Hh; [destruct Hg|].
  pose proof (after g0 gs Hl Ht) as A. inversion Ht; subst.
  destruct Hg as [<-|Hg], Hh as [<-|Hh]; auto. apply IH; auto. now apply (linked_tail g0).
Qed.

Lemma paired {A B : Type} (a : A) : forall (l : list A) (l' : list B), length l' = length l ->
  In a l -> exists b, In (a, b) (combine l l').
Proof.
  induction l as [|x l IH]; intros [|y l'] L Ha; try discriminate; cbn in *; [destruct Ha|].
  destruct Ha as [->|Ha]; [eauto|]. destruct (IH l' ltac:(now injection L) Ha) as [b Hb]. eauto.
Qed.

(* The segment at a time: at a knot the one that begins there. *)
Fixpoint active (g : segment) (gs : list segment) (t : R) : segment :=
  match gs with
  | [] => g
  | g' :: gs' => if Rlt_dec t (ends g) then g else active g' gs' t
  end.
Lemma active_at gs : forall g t, linked (g :: gs) = true ->
  Forall (fun g => begins g < ends g) (g :: gs) -> begins g <= t <= last (map ends (g :: gs)) 0 ->
  In (active g gs t) (g :: gs) /\ begins (active g gs t) <= t <= ends (active g gs t) /\
  (t < last (map ends (g :: gs)) 0 -> t < ends (active g gs t)).
Proof.
  induction gs as [|g' gs IH]; intros g t Hl Ht Hr.
  { cbn in *. split; auto. }
  cbn [active]. destruct (Rlt_dec t (ends g)) as [L|L].
  { split; [now left|]. split; auto. lra. }
  pose proof Hl as Hl'. cbn [linked] in Hl'. apply andb_prop in Hl' as [Hk _].
  apply andb_prop in Hk as [Hk _]. apply knot_eqb_eq in Hk.
  assert (E : ends g = begins g') by (unfold ends, begins; now rewrite Hk).
  change (last (map ends (g :: g' :: gs)) 0) with (last (map ends (g' :: gs)) 0) in *.
  inversion Ht; subst. destruct (IH g' t (linked_tail _ _ Hl)) as [A [B C]]; auto; [lra|].
  split; [now right|]. auto.
Qed.
Lemma active_inside gs : forall g t h, linked (g :: gs) = true ->
  Forall (fun g => begins g < ends g) (g :: gs) -> In h (g :: gs) -> begins h <= t < ends h ->
  active g gs t = h.
Proof.
  induction gs as [|g' gs IH]; intros g t h Hl Ht Hh Hr.
  { destruct Hh as [<-|[]]. reflexivity. }
  cbn [active]. pose proof (after g (g' :: gs) Hl Ht) as A. inversion Ht; subst.
  destruct (Rlt_dec t (ends g)) as [L|L].
  - destruct Hh as [->|Hh]; auto. specialize (A h Hh). lra.
  - destruct Hh as [->|Hh]; [lra|]. apply IH; auto. now apply (linked_tail g).
Qed.

(* The unclipped input i of a segment's policy, for a state. *)
Definition plan (g : segment) (i : nat) (t : R) (y : list R) : R :=
  nth i (wanted g (place g t) (deviation g (place g t) y)) 0.

Section Problem.
Variables (d : problem) (period : num) (errors : list num) (w : witness) (r : rate_witness).
Hypothesis H : held_ok d period errors w r = true.
Let offs := offs_of d period errors (rates r).
Let n := first_size d.
Let m := length (limits d).
Let H_checked : check d offs w = true.
Proof.
  unfold held_ok in H. apply andb_prop in H as [A _]. apply andb_prop in A as [A _].
  unfold funnel_ok in A. apply andb_prop in A as [A _]. now apply andb_prop in A as [A _].
Qed.
Let C := check_facts d offs w H_checked.
Let Hl := c_linked d w C.
Let Ht := c_times d w C.
Let Hlim := c_limits d w C.

Lemma held_parts : bounds_ok d offs = true /\ goal_ok d (goal_multiplier w) = true /\
  (0 < length (segments d))%nat /\ length (rates r) = length (segments d) /\ length errors = n /\
  Forall (fun e => 0 <= val e) errors /\ forallb feeds_ok (segments d) = true /\ 0 <= val period /\
  (0 < val period -> smooth (segments d) = true /\
    Forall (Forall (fun e => 0 < val e)) (rates r) /\ Forall (fun row => length row = m) (rates r) /\
    length (turns r) = length (segments d) /\
    forallb (fun e => let '(g, row, off, qs) := e in rates_ok d w (pushing r) g off row qs)
      (combine (combine (combine (segments d) (rates r)) offs) (turns r)) = true).
Proof.
  pose proof H as A. unfold held_ok in A. cbn zeta in A. fold offs in A.
  apply andb_prop in A as [A B]. apply andb_prop in A as [A1 A2].
  unfold funnel_ok in A1. apply andb_prop in A1 as [_ A1]. apply andb_prop in A1 as [A0 A1].
  apply Nat.ltb_lt in A0.
  apply andb_prop in B as [B D]. apply andb_prop in B as [B1 B2]. apply andb_prop in B1 as [B1 B3].
  apply Nat.eqb_eq in B1, B3. apply andb_prop in B2 as [B2 B4]. apply andb_prop in D as [D E].
  apply num_leb_le in D. rewrite val_nzero in D.
  repeat split; auto.
  { apply Forall_forall. intros e He. rewrite forallb_forall in B2. specialize (B2 e He).
    apply num_leb_le in B2. now rewrite val_nzero in B2. }
  all: destruct (num_leb period nzero) eqn:Z; [apply num_leb_le in Z; rewrite val_nzero in Z; lra|].
  all: apply andb_prop in E as [E1 E2]; apply andb_prop in E1 as [E1 E3];
    apply andb_prop in E2 as [E2 E4]; apply andb_prop in E2 as [E2 E5]; auto.
  - apply Forall_forall. intros row Hr. rewrite forallb_forall in E3. specialize (E3 row Hr).
    apply Forall_forall. intros e He. rewrite forallb_forall in E3. specialize (E3 e He).
    apply num_ltb_lt in E3. now rewrite val_nzero in E3.
  - apply Forall_forall. intros row Hr. rewrite forallb_forall in E2. specialize (E2 row Hr).
    now apply Nat.eqb_eq in E2.
  - now apply Nat.eqb_eq in E5.
Qed.

Lemma segment_known g : In g (segments d) -> segment_ok n d g = true.
Proof. intros Hg. pose proof (c_segments d w C) as A. rewrite Forall_forall in A. auto. Qed.

(* With a segment: its rates, widths and rate pieces. *)
Lemma with_parts {A B D : Type} (f : segment * A -> B) (gs : list segment) (rs : list A)
  (ts : list D) : length rs = length gs ->
  forall g off, In (g, off) (combine gs (map f (combine gs rs))) ->
  exists row, In (g, row) (combine gs rs) /\ off = f (g, row) /\
    (length ts = length gs -> exists q,
      In (g, row, off, q) (combine (combine (combine gs rs) (map f (combine gs rs))) ts)).
Proof.
  revert rs ts. induction gs as [|g0 gs IH]; intros [|r0 rs] ts L g off Hin; try discriminate;
    cbn [combine map] in *; [destruct Hin|]. injection L as L. destruct Hin as [E|Hin].
  - injection E as <- <-. exists r0. split; [now left|]. split; auto.
    intros Lt. destruct ts as [|q ts]; [discriminate|]. exists q. now left.
  - destruct (IH rs (tl ts) L g off Hin) as [row [A1 [A2 A3]]]. exists row. split; [now right|].
    split; auto. intros Lt. destruct ts as [|q ts]; [discriminate|]. cbn [tl] in A3.
    injection Lt as Lt. destruct (A3 Lt) as [q' Hq]. exists q'. now right.
Qed.
Lemma row_exists g : In g (segments d) -> exists row, In (g, row) (combine (segments d) (rates r)).
Proof.
  intros Hg. destruct held_parts as [_ [_ [_ [L _]]]]. now apply paired.
Qed.

(* What bounds the inputs at a segment. *)
Definition all_parts := prepared d errors (combine (segments d) (rates r)).
Definition rate_bound (g : segment) (i : nat) : R :=
  val (worst i (map (fun e => fst (snd e)) (seen period g all_parts))).
Definition shake_bound (g : segment) (i : nat) : R :=
  val (worst i (map (fun e => snd (snd e)) (seen period g all_parts))).
Lemma in_seen g h row : In (h, row) (combine (segments d) (rates r)) ->
  begins g - val period < ends h -> begins h <= begins g ->
  In (h, (row, map (shaken h errors) (seq 0 m))) (seen period g all_parts).
Proof.
  intros Hh He Hb. unfold seen. apply filter_In. split.
  - unfold all_parts, prepared. apply in_map_iff. now exists (h, row).
  - cbn [fst]. apply andb_true_intro. split.
    + destruct (num_ltb (nsub (time (start g)) period) (time (stop h))) eqn:E; auto.
      apply num_ltb_not in E. rewrite val_sub in E. unfold begins, ends in *. lra.
    + unfold num_leb. destruct (num_ltb (time (start g)) (time (start h))) eqn:E; auto.
      apply num_ltb_lt in E. unfold begins in *. lra.
Qed.
Lemma rate_below g h row i : In (h, row) (combine (segments d) (rates r)) ->
  begins g - val period < ends h -> begins h <= begins g -> val (nth i row nzero) <= rate_bound g i.
Proof.
  intros Hh He Hb. unfold rate_bound, worst. apply largest_above. apply in_map_iff.
  exists row. split; auto. apply in_map_iff.
  exists (h, (row, map (shaken h errors) (seq 0 m))). split; auto. now apply in_seen.
Qed.
Lemma shake_below g h i : In h (segments d) -> (i < m)%nat ->
  begins g - val period < ends h -> begins h <= begins g -> val (shaken h errors i) <= shake_bound g i.
Proof.
  intros Hh Hi He Hb. destruct (row_exists h Hh) as [row Hrow].
  unfold shake_bound, worst. apply largest_above. apply in_map_iff.
  exists (map (shaken h errors) (seq 0 m)). split.
  - rewrite (nth_indep _ nzero (shaken h errors O)) by (rewrite map_length, seq_length; lia).
    rewrite map_nth, seq_nth; auto.
  - apply in_map_iff. exists (h, (row, map (shaken h errors) (seq 0 m))). split; auto. now apply in_seen.
Qed.
Lemma off_value g off i : In (g, off) (combine (segments d) offs) -> (i < m)%nat ->
  length off = m /\ val (nth i off nzero) = val period * rate_bound g i + shake_bound g i.
Proof.
  intros Hg Hi. destruct held_parts as [_ [_ [_ [L _]]]].
  destruct (with_parts (width_of d period all_parts) (segments d) (rates r) (@nil unit) L g off Hg)
    as [row [_ [-> _]]]. unfold width_of. cbn [fst]. split; [now rewrite map_length, seq_length|].
  set (f := fun i => nadd _ _). rewrite (nth_indep _ nzero (f O)) by (rewrite map_length, seq_length; lia).
  rewrite map_nth, seq_nth by auto. unfold f. rewrite val_add, val_mul. reflexivity.
Qed.

Lemma gains_even g : In g (segments d) -> even_gains g = true.
Proof.
  intros Hg. destruct held_parts as [B [_ [_ [L _]]]]. unfold bounds_ok in B. rewrite forallb_forall in B.
  assert (G : exists off, In (g, off) (combine (segments d) offs)).
  { destruct (checked_segments d offs w H_checked) as [_ [Lo _]]. now apply paired. }
  destruct G as [off G]. specialize (B _ G). cbn [fst snd] in B. now apply andb_prop in B as [B _].
Qed.

(* The policy, in numbers. *)
Lemma plan_value g i t y : In g (segments d) -> (i < m)%nat ->
  plan g i t y = along (place g t) (nth i (feed g) [])
    - dot (map (along (place g t)) (row_of g i)) (deviation g (place g t) y).
Proof.
  intros Hg Hi. pose proof (segment_known g Hg) as Hok. destruct (segment_facts d g n Hok).
  unfold plan, wanted. rewrite (zip_nth _ [] []) by (fold m in f_feed, f_gains; lia). reflexivity.
Qed.
Lemma deviation_error g s y e : length y = length (nominal g) -> length e = length y ->
  deviation g s (zip Rplus y e) = zip Rplus (deviation g s y) e.
Proof.
  unfold deviation. generalize (map (along s) (nominal g)) (map_length (along s) (nominal g)).
  generalize (nominal g). intros cs vs Lv. intros Ly Le.
  assert (L : length vs = length y) by congruence. clear cs Lv Ly. revert vs e L Le.
  induction y as [|y0 y IH]; intros [|v vs] [|e0 e] L Le; try discriminate; cbn; auto.
  f_equal; [ring|]. apply IH; auto.
Qed.
Lemma abs_dot row e es : Forall2 (fun v most => Rabs v <= val most) e es -> Forall (fun q => 0 <= val q) es ->
  Rabs (dot (map val row) e) <= val (ndot (map nabs row) es).
Proof.
  intros He Hn. rewrite val_dot. revert row. induction He as [|v q e es Hv He IH]; intros [|a row];
    cbn [map dot]; try (rewrite Rabs_R0; lra).
  inversion Hn as [|? ? N1 N2]; subst. eapply Rle_trans; [apply Rabs_triang|].
  rewrite Rabs_mult, val_nabs. specialize (IH N2 row).
  pose proof (Rmult_le_compat_l (Rabs (val a)) _ _ (Rabs_pos _) Hv). lra.
Qed.
Lemma plan_error g i t y e : In g (segments d) -> (i < m)%nat -> begins g <= t <= ends g ->
  length y = n -> Forall2 (fun v most => Rabs v <= val most) e errors ->
  Rabs (plan g i t (zip Rplus y e) - plan g i t y) <= val (shaken g errors i).
Proof.
  intros Hg Hi Hr Ly He. pose proof (segment_known g Hg) as Hok. destruct (segment_facts d g n Hok).
  destruct held_parts as [_ [_ [_ [_ [Le [Hpos _]]]]]].
  pose proof (Condition.Forall2_length _ _ _ He) as Lee.
  rewrite !plan_value, deviation_error by (auto; congruence).
  set (s := place g t) in *. assert (Hs : 0 <= s <= 1) by now apply (place_in d g n Hok).
  assert (Lz : length (deviation g s y) = n).
  { unfold deviation. rewrite zip_length; rewrite ?map_length; congruence. }
  rewrite dot_plus by congruence.
  replace (along s (nth i (feed g) []) - (dot (map (along s) (row_of g i)) (deviation g s y)
      + dot (map (along s) (row_of g i)) e)
    - (along s (nth i (feed g) []) - dot (map (along s) (row_of g i)) (deviation g s y)))
    with (- dot (map (along s) (row_of g i)) e) by ring.
  rewrite Rabs_Ropp. unfold shaken.
  destruct (even_row g i n (gains_even g Hg) f_nominal ltac:(fold m in f_gains; lia))
    as [_ [[E _]|[k [Hk [Ek Hrow]]]]].
  { rewrite E. cbn [map dot]. rewrite Rabs_R0. apply largest_above. }
  apply (dot_rows_bound _ k); auto. intros j Hj. eapply Rle_trans; [apply (abs_dot _ e errors He Hpos)|].
  apply largest_above. apply in_map_iff. exists (map (fun c => nth j c nzero) (row_of g i)). split; auto.
  unfold rows_of. apply in_map_iff. exists j. split; auto. apply in_seq. lia.
Qed.

(* The policy does not jump at a knot. *)
Lemma plan_joined g g' i y : In g (segments d) -> In g' (segments d) -> (i < m)%nat ->
  smooth [g; g'] = true -> linked [g; g'] = true -> plan g i (ends g) y = plan g' i (ends g) y.
Proof.
  intros Hg Hg' Hi Hs Hk. pose proof (segment_known g Hg) as Hok. pose proof (segment_known g' Hg') as Hok'.
  destruct (segment_facts d g n Hok) as [Ln _ Lf Lg Cn T _ _ _ _].
  destruct (segment_facts d g' n Hok') as [Ln' _ Lf' Lg' Cn' T' _ _ _ _].
  cbn [smooth linked] in *. rewrite !Bool.andb_true_r in *.
  apply andb_prop in Hs as [S1 S2]. apply andb_prop in Hk as [Hk Hn].
  apply knot_eqb_eq in Hk. apply (list_eqb_eq _ num_eqb_eq) in Hn.
  apply (list_eqb_eq _ num_eqb_eq) in S1. apply (list_eqb_eq _ (list_eqb_eq _ num_eqb_eq)) in S2.
  assert (E : ends g = begins g') by (unfold ends, begins; now rewrite Hk).
  rewrite !plan_value by auto. rewrite (place_end g T), E, (place_start g').
  destruct held_parts as [_ [_ [_ [_ [_ [_ [Hf _]]]]]]].
  assert (Feed : forall h, In h (segments d) -> length (feed h) = m -> (0 < length (nth i (feed h) []) <= 4)%nat).
  { intros h Hh L. rewrite forallb_forall in Hf. specialize (Hf h Hh). unfold feeds_ok in Hf.
    rewrite forallb_forall in Hf. specialize (Hf (nth i (feed h) []) ltac:(apply nth_In; lia)).
    apply andb_prop in Hf as [A B]. apply Nat.ltb_lt in A. apply Nat.leb_le in B. auto. }
  assert (Row : forall h, In h (segments d) -> length (gains h) = m -> length (nominal h) = n ->
    Forall (fun c => (0 < length c <= 4)%nat) (row_of h i)).
  { intros h Hh L Lh. destruct (even_row h i n (gains_even h Hh) Lh ltac:(lia))
      as [_ [[Er _]|[k [Hk' [_ Hrow]]]]]; [rewrite Er; constructor|].
    eapply Forall_impl; [|exact Hrow]. intros c ->. auto. }
  f_equal; [|f_equal].
  - destruct (along_ends _ (Feed g Hg Lf)) as [_ ->]. destruct (along_ends _ (Feed g' Hg' Lf')) as [-> _].
    f_equal. apply (f_equal (fun l => nth i l nzero)) in S1.
    rewrite (nth_indep _ nzero (last_of [])) in S1 by (rewrite map_length; fold m in Lf; lia).
    rewrite (nth_indep (map first_of _) nzero (first_of [])) in S1 by (rewrite map_length; fold m in Lf'; lia).
    now rewrite !map_nth in S1.
  - transitivity (map val (map last_of (row_of g i))).
    { rewrite map_map. apply map_ext_in. intros c Hc. pose proof (Row g Hg Lg Ln) as A.
      rewrite Forall_forall in A. now destruct (along_ends c (A c Hc)). }
    transitivity (map val (map first_of (row_of g' i))).
    2:{ rewrite map_map. apply map_ext_in. intros c Hc. pose proof (Row g' Hg' Lg' Ln') as A.
      rewrite Forall_forall in A. now destruct (along_ends c (A c Hc)). }
    f_equal. apply (f_equal (fun l => nth i l [])) in S2. unfold row_of.
    rewrite (nth_indep _ [] (map last_of [])) in S2 by (rewrite map_length; fold m in Lg; lia).
    rewrite (nth_indep (map (map first_of) _) [] (map first_of [])) in S2 by (rewrite map_length; fold m in Lg'; lia).
    now rewrite !map_nth in S2.
  - unfold deviation. f_equal. transitivity (map val (map last_of (nominal g))).
    + rewrite map_map. apply map_ext_in. intros c Hc. rewrite Forall_forall in Cn.
      now destruct (along_ends c (Cn c Hc)).
    + rewrite Hn, map_map. apply map_ext_in. intros c Hc. rewrite Forall_forall in Cn'.
      symmetry. now destruct (along_ends c (Cn' c Hc)).
Qed.
Lemma plan_active i y : (i < m)%nat -> forall gs g t h, incl (g :: gs) (segments d) ->
  smooth (g :: gs) = true -> linked (g :: gs) = true -> Forall (fun g => begins g < ends g) (g :: gs) ->
  In h (g :: gs) -> begins h <= t <= ends h -> plan h i t y = plan (active g gs t) i t y.
Proof.
  intros Hi. induction gs as [|g' gs IH]; intros g t h Hin Hs Hk Htt Hh Hr.
  { destruct Hh as [<-|[]]. reflexivity. }
  cbn [active]. pose proof (after g (g' :: gs) Hk Htt) as A.
  destruct (Rlt_dec t (ends g)) as [L|L].
  { destruct Hh as [->|Hh]; auto. specialize (A h Hh). lra. }
  assert (Hin' : incl (g' :: gs) (segments d)) by (intros a Ha; apply Hin; now right).
  cbn [smooth] in Hs. apply andb_prop in Hs as [S1 S2]. pose proof (linked_tail _ _ Hk) as Hk2.
  cbn [linked] in Hk. apply andb_prop in Hk as [K1 _]. inversion Htt as [|? ? T1 T2]; subst.
  destruct Hh as [<-|Hh]; [|now apply IH].
  assert (Et : t = ends g) by lra. rewrite Et.
  rewrite (plan_joined g g' i y); auto.
  - apply IH; auto; [now left|]. pose proof K1 as K2. apply andb_prop in K2 as [K2 _].
    apply knot_eqb_eq in K2. assert (E : ends g = begins g') by (unfold ends, begins; now rewrite K2).
    inversion T2; subst. lra.
  - apply Hin. now left.
  - apply Hin'. now left.
  - cbn [smooth]. now rewrite S1.
  - cbn [linked]. now rewrite K1.
Qed.

Lemma c_dot fs : forall gs t, Forall (fun f => continuity_pt f t) fs ->
  Forall (fun f => continuity_pt f t) gs ->
  continuity_pt (fun v => dot (at_time fs v) (at_time gs v)) t.
Proof.
  induction fs as [|f fs IH]; intros [|g gs] t Hf Hg; cbn [at_time map dot]; try apply c_const.
  inversion Hf; inversion Hg; subst.
  apply (c_plus (fun v => f v * g v) (fun v => dot (at_time fs v) (at_time gs v))); auto.
  now apply c_mult.
Qed.
Lemma within_close off a v : length off = m -> length a = m -> length v = m ->
  (forall i, (i < m)%nat -> Rabs (nth i v 0 - nth i a 0) <= val (nth i off nzero)) ->
  within_off off a v.
Proof.
  intros Lo La Lv B.
  assert (G : in_box (zip Rminus v a) (around off) /\ v = zip Rplus a (zip Rminus v a)).
  { rewrite <- Lo in *. clear Lo. revert a v La Lv B. induction off as [|o os IH];
      intros [|a0 a] [|v0 v] La Lv B; try discriminate; cbn.
    { split; auto. constructor. }
    destruct (IH a v ltac:(now injection La) ltac:(now injection Lv)) as [I E].
    { intros i Hi. exact (B (S i) ltac:(cbn; lia)). }
    specialize (B O ltac:(cbn; lia)). cbn in B. split.
    - constructor; auto. cbn [fst snd]. rewrite val_opp. pose proof (Rle_abs (v0 - a0)).
      pose proof (Rle_abs (- (v0 - a0))). rewrite Rabs_Ropp in *. lra.
    - rewrite <- E. f_equal. ring. }
  destruct G as [I E]. unfold within_off. destruct off as [|o os]; [|eauto].
  cbn in Lo. rewrite <- Lo in *. destruct a, v; try discriminate; auto.
Qed.

Section Solution.
Variables (since : R) (x : list (R -> R)) (u : R -> list R) (g0 : segment) (gs0 : list segment).
Hypothesis Hseg : segments d = g0 :: gs0.
Hypothesis Hsol : held_solution d period errors since x u.
Hypothesis Hsince : begin d <= since <= finish d.
Hypothesis Hinside : inside d x since.

Lemma x_length : length x = n.
Proof.
  destruct Hsol as [A _]. rewrite Forall_forall in A. assert (Hg : In g0 (segments d)) by (rewrite Hseg; now left).
  rewrite (A g0 Hg). now destruct (segment_facts d g0 n (segment_known g0 Hg)).
Qed.
Lemma at_length t : length (at_time x t) = n.
Proof. unfold at_time. rewrite map_length. apply x_length. Qed.
Definition now (t : R) : segment := active g0 gs0 t.
Lemma now_ok t : since <= t <= finish d -> In (now t) (segments d) /\
  begins (now t) <= t <= ends (now t) /\ (t < finish d -> t < ends (now t)).
Proof.
  intros Hr. pose proof Hl as A. pose proof Ht as B. unfold finish, begin in *. rewrite Hseg in *.
  apply active_at; auto. lra.
Qed.
Lemma now_is h t : In h (segments d) -> begins h <= t < ends h -> now t = h.
Proof. intros Hh Hr. pose proof Hl as A. pose proof Ht as B. rewrite Hseg in *. now apply active_inside. Qed.
Lemma same_now h t y i : 0 < val period -> (i < m)%nat -> In h (segments d) -> begins h <= t <= ends h ->
  plan h i t y = plan (now t) i t y.
Proof.
  intros Hp Hi Hh Hr. destruct held_parts as [_ [_ [_ [_ [_ [_ [_ [_ Q]]]]]]]].
  destruct (Q Hp) as [S _]. pose proof Hl as A. pose proof Ht as B. unfold now.
  apply plan_active; auto; rewrite <- Hseg; auto. apply incl_refl.
Qed.
Lemma only g h t : In g (segments d) -> In h (segments d) -> begins g < t < ends g ->
  begins h <= t <= ends h -> g = h.
Proof.
  intros Hg Hh Hr Hr'. destruct (disjoint _ Hl Ht g h Hg Hh) as [E|[E|E]]; auto; lra.
Qed.
Lemma until_finish g : In g (segments d) -> ends g <= finish d.
Proof. intros Hg. now destruct (c_range d w C g Hg). Qed.

(* The policy's input i along the solution, before and after it is clipped. *)
Definition wish (i : nat) (t : R) : R := plan (now t) i t (at_time x t).
Definition limit (i : nat) : option (num * num) := nth i (limits d) None.
Definition phi (i : nat) (t : R) : R := clip (limit i) (wish i t).

Lemma wanted_length g s z : In g (segments d) -> length (wanted g s z) = length (limits d).
Proof.
  intros Hg. destruct (segment_facts d g n (segment_known g Hg)) as [_ _ Lf Lg _ _ _ _ _ _].
  unfold wanted. rewrite zip_length; congruence.
Qed.
Lemma input_length g s y : In g (segments d) -> length (input d g s y) = m.
Proof.
  intros Hg. unfold input. rewrite zip_length; auto. symmetry. now apply wanted_length.
Qed.
Lemma input_entry g s y i : In g (segments d) -> (i < m)%nat ->
  length (input d g s y) = m /\
  nth i (input d g s y) 0 = clip (limit i) (nth i (wanted g s (deviation g s y)) 0).
Proof.
  intros Hg Hi. split; [now apply input_length|]. unfold input.
  rewrite (zip_nth _ None 0) by (rewrite ?wanted_length; auto). reflexivity.
Qed.
Lemma phi_here g t i : In g (segments d) -> (i < m)%nat -> begins g < t < ends g ->
  nth i (input d g (place g t) (at_time x t)) 0 = phi i t.
Proof.
  intros Hg Hi Hr. destruct (input_entry g (place g t) (at_time x t) i Hg Hi) as [_ ->].
  unfold phi, wish. rewrite (now_is g t Hg) by lra. reflexivity.
Qed.
Lemma applied_at g t : In g (segments d) -> begins g < t < ends g -> since <= t ->
  length (u t) = m /\ exists tau e, since <= tau <= t /\ t - val period <= tau /\
    Forall2 (fun v most => Rabs v <= val most) e errors /\
    forall i, (i < m)%nat ->
      nth i (u t) 0 = clip (limit i) (plan (now tau) i tau (zip Rplus (at_time x tau) e)).
Proof.
  intros Hg Hr Hst. destruct Hsol as [_ [_ S]]. destruct (S g t Hg Hr) as [A _].
  destruct (A Hst) as [h [tau [e [Hh [Hr' [B1 [B2 [B3 ->]]]]]]]].
  split; [now apply input_length|]. exists tau, e. split; [lra|]. split; [lra|]. split; auto.
  intros i Hi. destruct (input_entry h (place h tau) (zip Rplus (at_time x tau) e) i Hh Hi) as [_ ->].
  f_equal. fold (plan h i tau (zip Rplus (at_time x tau) e)).
  destruct held_parts as [_ [_ [_ [_ [_ [_ [_ [P0 _]]]]]]]].
  destruct (Rle_lt_dec (val period) 0) as [Z|Z]; [|now apply same_now].
  assert (tau = t) as -> by lra. rewrite (now_is g t Hg) by lra. now rewrite (only g h t Hg Hh Hr Hr').
Qed.

(* What is applied is as close to the policy as the equations allow. *)
Definition good (t : R) : Prop := forall g off, In (g, off) (combine (segments d) offs) ->
  begins g < t < ends g -> within_off off (input d g (place g t) (at_time x t)) (u t).
Lemma good_if t : since <= t -> (forall g i tau, In g (segments d) -> begins g < t < ends g ->
    (i < m)%nat -> since <= tau <= t -> t - val period <= tau ->
    Rabs (phi i tau - phi i t) <= val period * rate_bound g i) -> good t.
Proof.
  intros Hst B g off Hin Hr. pose proof (in_combine_l _ _ _ _ Hin) as Hg.
  destruct (applied_at g t Hg Hr Hst) as [Lu [tau [e [T1 [T2 [He Hu]]]]]].
  destruct (Nat.eq_dec m 0) as [Z|Z].
  { pose proof (input_length g (place g t) (at_time x t) Hg) as Li. rewrite Z in *.
    destruct (checked_segments d offs w H_checked) as [_ [_ Each]].
    destruct (Each g off Hin) as [_ [O _]]. unfold off_ok in O. unfold within_off.
    assert (Eu : u t = input d g (place g t) (at_time x t)).
    { destruct (u t), (input d g (place g t) (at_time x t)); auto; discriminate. }
    destruct off as [|o os]; auto. exfalso. apply andb_prop in O as [O _]. apply Nat.eqb_eq in O.
    fold m in O. rewrite Z in O. discriminate. }
  apply within_close; auto.
  { now destruct (off_value g off O Hin ltac:(lia)). }
  { now apply input_length. }
  intros i Hi. destruct (off_value g off i Hin Hi) as [_ ->].
  rewrite (phi_here g t i Hg Hi Hr), (Hu i Hi).
  pose proof (until_finish g Hg) as Uf.
  destruct (now_ok tau ltac:(lra)) as [Na [Nb Nc]]. specialize (Nc ltac:(lra)).
  set (a := now tau) in *.
  assert (Ba : begins a <= begins g).
  { destruct (disjoint _ Hl Ht g a Hg Na) as [<-|[E|E]]; lra. }
  assert (E1 : Rabs (clip (limit i) (plan a i tau (zip Rplus (at_time x tau) e)) - phi i tau)
    <= shake_bound g i).
  { unfold phi, wish. fold a. eapply Rle_trans; [apply clip_lipschitz|].
    eapply Rle_trans; [apply plan_error; auto; apply at_length|].
    apply shake_below; auto. lra. }
  pose proof (B g i tau Hg Hr Hi T1 T2) as E2.
  replace (clip (limit i) (plan a i tau (zip Rplus (at_time x tau) e)) - phi i t)
    with ((clip (limit i) (plan a i tau (zip Rplus (at_time x tau) e)) - phi i tau)
      + (phi i tau - phi i t)) by ring.
  eapply Rle_trans; [apply Rabs_triang|]. lra.
Qed.

Lemma followed c : since <= c <= finish d -> (forall t, since <= t < c -> good t) ->
  follows d offs x (fun _ => u) since c.
Proof.
  intros Hc G. destruct Hsol as [_ [S1 S2]]. split; [apply x_length|]. split.
  - intros s Hs. apply S1. lra.
  - intros g off s Hin Hs Hr'. split; [apply (G s ltac:(lra) g off); auto|].
    destruct (S2 g s (in_combine_l _ _ _ _ Hin) Hs) as [_ M]. apply M. lra.
Qed.
Lemma inside_until c : since <= c <= finish d -> (forall t, since <= t < c -> good t) ->
  forall t, since <= t <= c -> inside d x t.
Proof.
  intros Hc G t Hr. exact (stays_until d offs w H_checked x (fun _ => u) since c ltac:(lra)
    (followed c Hc G) since t ltac:(lra) ltac:(lra) Hinside).
Qed.

(* Along the solution the policy is continuous, and turns at its rate. *)
Lemma curves_known g i : In g (segments d) -> (i < m)%nat ->
  (length (nth i (feed g) []) <= 4)%nat /\ Forall (fun c => (length c <= 4)%nat) (row_of g i).
Proof.
  intros Hg Hi. destruct (segment_facts d g n (segment_known g Hg)) as [Ln _ Lf Lg _ _ _ _ _ _].
  destruct held_parts as [_ [_ [_ [_ [_ [_ [Hf _]]]]]]]. split.
  - rewrite forallb_forall in Hf. specialize (Hf g Hg). unfold feeds_ok in Hf.
    rewrite forallb_forall in Hf. specialize (Hf (nth i (feed g) []) ltac:(apply nth_In; fold m in Lf; lia)).
    apply andb_prop in Hf as [_ B]. now apply Nat.leb_le in B.
  - destruct (even_row g i n (gains_even g Hg) Ln ltac:(fold m in Lg; lia))
      as [_ [[Er _]|[k [Hk' [_ Hrow]]]]]; [rewrite Er; constructor|].
    eapply Forall_impl; [|exact Hrow]. intros c ->. lia.
Qed.
Lemma plan_continuous g i t : In g (segments d) -> (i < m)%nat -> since <= t <= finish d ->
  continuity_pt (fun v => plan g i v (at_time x v)) t.
Proof.
  intros Hg Hi Hr. pose proof (segment_known g Hg) as Hok. destruct (curves_known g i Hg Hi) as [Lf Lr].
  apply (continuous_same (fun v => along (place g v) (nth i (feed g) [])
    - dot (at_time (map (fun c v => along (place g v) c) (row_of g i)) v)
        (at_time (zip (fun f c v => f v - along (place g v) c) x (nominal g)) v))).
  { intros v. rewrite plan_value by auto. f_equal. f_equal.
    - unfold at_time. rewrite map_map. reflexivity.
    - unfold deviation. generalize (nominal g). clear. induction x as [|f fs IH]; intros [|c cs]; cbn; auto.
      f_equal. apply IH. }
  assert (D : forall c, (length c <= 4)%nat -> continuity_pt (fun v => along (place g v) c) t).
  { intros c Hc. eapply d_continuous, (d_along d g n Hok c t Hc). }
  apply (c_minus (fun v => along (place g v) (nth i (feed g) []))); auto. apply c_dot.
  - apply Forall_forall. intros f Hf. apply in_map_iff in Hf as [c [<- Hc]].
    rewrite Forall_forall in Lr. now apply D, Lr.
  - destruct Hsol as [_ [S _]]. specialize (S t Hr). destruct (segment_facts d g n Hok) as [_ _ _ _ Cn _ _ _ _ _].
    clear - S Cn D. revert S Cn. generalize (nominal g). induction x as [|f fs IH]; intros [|c cs] S Cn;
      cbn; constructor; inversion S; inversion Cn; subst.
    + apply (c_minus f (fun v => along (place g v) c)); auto. apply D. lia.
    + now apply IH.
Qed.
Fixpoint joined_plan (i : nat) (g : segment) (gs : list segment) : R -> R :=
  match gs with
  | [] => fun t => plan g i t (at_time x t)
  | g' :: gs' => glued (ends g) (fun t => plan g i t (at_time x t)) (joined_plan i g' gs')
  end.
Lemma joined_is i gs : forall g t, joined_plan i g gs t = plan (active g gs t) i t (at_time x t).
Proof.
  induction gs as [|g' gs IH]; intros g t; cbn [joined_plan active]; auto. unfold glued.
  destruct (Rlt_dec t (ends g)); auto.
Qed.
Lemma joined_continuous i t : (i < m)%nat -> since <= t <= finish d -> forall gs g,
  incl (g :: gs) (segments d) -> smooth (g :: gs) = true -> linked (g :: gs) = true ->
  Forall (fun g => begins g < ends g) (g :: gs) -> continuity_pt (joined_plan i g gs) t.
Proof.
  intros Hi Hr. induction gs as [|g' gs IH]; intros g Hin Hs Hk Htt; cbn [joined_plan].
  { apply plan_continuous; auto. apply Hin. now left. }
  assert (Hin' : incl (g' :: gs) (segments d)) by (intros a Ha; apply Hin; now right).
  pose proof (linked_tail _ _ Hk) as Hk2. inversion Htt as [|? ? T1 T2]; subst.
  cbn [smooth linked] in Hs, Hk. apply andb_prop in Hs as [S1 S2]. apply andb_prop in Hk as [K1 _].
  apply glued_continuous.
  - apply plan_continuous; auto. apply Hin. now left.
  - apply IH; auto.
  - rewrite joined_is. pose proof K1 as K2. apply andb_prop in K2 as [K2 _]. apply knot_eqb_eq in K2.
    assert (E : ends g = begins g') by (unfold ends, begins; now rewrite K2).
    rewrite (active_inside gs g' (ends g) g' Hk2 T2 (or_introl eq_refl)).
    2:{ inversion T2; subst. lra. }
    apply plan_joined; auto.
    + apply Hin. now left.
    + apply Hin'. now left.
    + cbn [smooth]. now rewrite S1.
    + cbn [linked]. now rewrite K1.
Qed.
Lemma wish_continuous i t : 0 < val period -> (i < m)%nat -> since <= t <= finish d ->
  continuity_pt (wish i) t.
Proof.
  intros Hp Hi Hr. destruct held_parts as [_ [_ [_ [_ [_ [_ [_ [_ Q]]]]]]]]. destruct (Q Hp) as [S _].
  apply (continuous_same (joined_plan i g0 gs0)).
  { intros v. apply joined_is. }
  pose proof Hl as A. pose proof Ht as B.
  apply joined_continuous; auto; rewrite <- Hseg; auto. apply incl_refl.
Qed.
Lemma phi_continuous i t : 0 < val period -> (i < m)%nat -> since <= t <= finish d ->
  continuity_pt (phi i) t.
Proof.
  intros Hp Hi Hr k Hk. destruct (wish_continuous i t Hp Hi Hr k Hk) as [e [He N]].
  exists e. split; auto. intros v Hv. specialize (N v Hv). cbn in *. unfold R_dist in *.
  eapply Rle_lt_trans; [apply clip_lipschitz|exact N].
Qed.
Lemma d_plan g i t w0 : In g (segments d) -> (i < m)%nat -> begins g < t < ends g ->
  Forall2 (fun f v => right_derivative f t v) x (field g t (at_time x t) (u t) w0) ->
  right_derivative (wish i) t (turn g (place g t) (at_time x t) (u t) w0 i * / duration g).
Proof.
  intros Hg Hi Hr Hd. pose proof (segment_known g Hg) as Hok. destruct (curves_known g i Hg Hi) as [Lf Lr].
  apply (right_near (fun v => plan g i v (at_time x v)) _ t _ (ends g - t)); [lra| |].
  { intros v Hv. unfold wish. now rewrite (now_is g v Hg) by lra. }
  apply (right_same (fun v => along (place g v) (nth i (feed g) [])
    - dot (map (along (place g v)) (row_of g i)) (dev g x v))).
  { intros v. now rewrite plan_value by auto. }
  eapply right_equal.
  { apply (r_minus (fun v => along (place g v) (nth i (feed g) []))).
    - apply from_right, (d_along d g n Hok); auto.
    - apply d_dot; [|apply (d_dev d g n Hok x x_length t Hr (u t) w0 Hd)].
      exists (map (fun c v => along (place g v) c) (row_of g i)). split.
      + intros v. unfold at_time. rewrite map_map. reflexivity.
      + instantiate (1 := map (fun v => v * / duration g)
          (map (fun c => curve' (map val c) (place g t)) (row_of g i))).
        clear - Lr Hok. induction Lr as [|c row Hc Hrow IH]; cbn; constructor; auto.
        now apply from_right, (d_along d g n Hok). }
  unfold turn. rewrite dot_scaled, dot_scaled_r. fold (dev g x t). unfold dev. ring.
Qed.

(* Until a time before which everything is good, the policy moves by less than its rate allows. *)
Lemma phi_moves i tau c top : 0 < val period -> (i < m)%nat -> since <= tau -> tau < c -> c <= finish d ->
  (forall t, since <= t < c -> good t) ->
  (forall h row, In (h, row) (combine (segments d) (rates r)) -> tau < ends h -> begins h < c ->
    val (nth i row nzero) <= top) -> 0 < top ->
  Rabs (phi i c - phi i tau) < top * (c - tau).
Proof.
  intros Hp Hi H1 H2 H3 G B Htop. unfold phi.
  apply (clip_moves (limit i) (wish i) (map begins (segments d))); auto.
  - unfold limit. destruct (Nat.lt_ge_cases i (length (limits d))) as [L|L]; [|now rewrite nth_overflow].
    pose proof Hlim as A. rewrite Forall_forall in A. specialize (A _ (nth_In _ None L)).
    now destruct (nth i (limits d) None) as [[a b]|].
  - intros t Hr. apply wish_continuous; auto. lra.
  - intros t Hr Hk. destruct (now_ok t ltac:(lra)) as [Na [Nb Nc]]. specialize (Nc ltac:(lra)).
    set (g := now t) in *.
    assert (Hin : begins g < t < ends g).
    { split; auto. destruct (Req_dec (begins g) t) as [E|]; [|lra]. exfalso. apply Hk.
      apply in_map_iff. now exists g. }
    destruct Hsol as [_ [_ S2]]. destruct (S2 g t Na Hin) as [_ M].
    destruct (M ltac:(lra)) as [w0 [Hw Hd]].
    exists (turn g (place g t) (at_time x t) (u t) w0 i * / duration g).
    split; [now apply d_plan|]. intros Hf.
    destruct held_parts as [_ [_ [_ [Lr [_ [_ [_ [_ Q]]]]]]]]. destruct (Q Hp) as [_ [_ [_ [Lt R]]]].
    destruct (checked_segments d offs w H_checked) as [_ [Lo Each]].
    destruct (paired g (segments d) offs Lo Na) as [off Hoff].
    destruct (with_parts (width_of d period all_parts) (segments d) (rates r) (turns r) Lr g off Hoff)
      as [row [Hrow [_ Hq]]]. destruct (Hq Lt) as [qs Hqs].
    rewrite forallb_forall in R. specialize (R _ Hqs). cbn beta iota in R.
    destruct (Each g off Hoff) as [_ [O _]].
    pose proof (segment_known g Na) as Hok.
    pose proof (turn_bounded d w g off row (pushing r) qs n Hlim Hok O R (place g t) (at_time x t)
      (u t) w0 i (place_in d g n Hok t ltac:(lra)) (at_length t) Hw) as TB.
    assert (Hd0 : 0 < duration g).
    { unfold duration. lra. }
    pose proof (Rinv_0_lt_compat _ Hd0) as Hd1.
    rewrite Rabs_mult, (Rabs_right (/ duration g)) by lra.
    assert (T : Rabs (turn g (place g t) (at_time x t) (u t) w0 i) < duration g * val (nth i row nzero)).
    { exact (TB (G t ltac:(lra) g off Hoff Hin) Hi
        (inside_until c ltac:(lra) G t ltac:(lra) g Na ltac:(lra)) Hf). }
    apply (Rmult_lt_compat_r _ _ _ Hd1) in T.
    replace (duration g * val (nth i row nzero) * / duration g) with (val (nth i row nzero)) in T
      by (field; lra).
    pose proof (B g row Hrow ltac:(lra) ltac:(lra)). lra.
Qed.
Lemma rate_bound_pos g i : 0 < val period -> (i < m)%nat -> In g (segments d) -> 0 < rate_bound g i.
Proof.
  intros Hp Hi Hg. destruct (row_exists g Hg) as [row Hrow].
  destruct held_parts as [_ [_ [_ [_ [_ [_ [_ [_ Q]]]]]]]]. destruct (Q Hp) as [_ [A [B _]]].
  pose proof (in_combine_r _ _ _ _ Hrow) as Hin. rewrite Forall_forall in A, B.
  specialize (A row Hin). specialize (B row Hin). rewrite Forall_forall in A.
  specialize (A (nth i row nzero) ltac:(apply nth_In; lia)).
  pose proof (Ht) as Tm. rewrite Forall_forall in Tm. specialize (Tm g Hg).
  pose proof (rate_below g g row i Hrow ltac:(lra) ltac:(lra)). lra.
Qed.

Lemma for_all_inputs (Q : nat -> R -> Prop) k :
  (forall i, (i < k)%nat -> exists e, 0 < e /\ forall s, s < e -> Q i s) ->
  exists e, 0 < e /\ forall i s, (i < k)%nat -> s < e -> Q i s.
Proof.
  induction k as [|k IH]; intros A.
  { exists 1. split; [lra|]. intros i s Hi. lia. }
  destruct IH as [e [He B]]. { intros i Hi. apply A. lia. }
  destruct (A k ltac:(lia)) as [e' [He' B']]. exists (Rmin e e'). split; [now apply Rmin_glb_lt|].
  intros i s Hi Hs. destruct (Nat.eq_dec i k) as [->|Ne].
  - apply B'. eapply Rlt_le_trans; [exact Hs|apply Rmin_r].
  - apply B; [lia|]. eapply Rlt_le_trans; [exact Hs|apply Rmin_l].
Qed.

(* A little longer. *)
Lemma good_longer c : 0 < val period -> since <= c < finish d -> (forall t, since <= t < c -> good t) ->
  exists e, 0 < e /\ forall t, c <= t < c + e -> good t.
Proof.
  intros Hp Hc G. destruct (now_ok c ltac:(lra)) as [Na [Nb Nc]]. specialize (Nc ltac:(lra)).
  set (g := now c) in *.
  destruct (for_all_inputs (fun i s => 0 <= s -> forall tau, since <= tau <= c + s ->
    c + s - val period <= tau -> Rabs (phi i tau - phi i (c + s)) <= val period * rate_bound g i) m)
    as [e [He E]].
  { intros i Hi. pose proof (rate_bound_pos g i Hp Hi Na) as Hr.
    set (a := Rmax since (c - val period)).
    assert (Ha : a <= c) by (apply Rmax_lub; lra).
    assert (Ha' : since <= a /\ c - val period <= a) by (split; [apply Rmax_l|apply Rmax_r]).
    destruct (continuity_ab_maj (fun v => Rabs (phi i v - phi i c)) a c Ha) as [b [Hb Hab]].
    { intros v Hv. apply (continuity_pt_comp (fun v => phi i v - phi i c) Rabs).
      - apply (c_minus (phi i)); [apply phi_continuous; auto; lra|apply c_const].
      - apply Rcontinuity_abs. }
    set (top := Rabs (phi i b - phi i c)) in *.
    assert (Hroom : top < val period * rate_bound g i).
    { unfold top. destruct (Req_dec b c) as [->|Ne].
      - rewrite Rminus_diag_eq, Rabs_R0 by auto. now apply Rmult_lt_0_compat.
      - assert (M : Rabs (phi i c - phi i b) < rate_bound g i * (c - b)).
        { apply (phi_moves i b c (rate_bound g i)); auto; try lra.
          intros h row Hrow Hh1 Hh2. apply (rate_below g h row i Hrow); [lra|].
          pose proof (in_combine_l _ _ _ _ Hrow) as Hh.
          pose proof Ht as Tm. rewrite Forall_forall in Tm. specialize (Tm h Hh).
          destruct (disjoint _ Hl Ht g h Na Hh) as [<-|[F|F]]; lra. }
        rewrite Rabs_minus_sym. eapply Rlt_le_trans; [exact M|]. rewrite Rmult_comm.
        apply Rmult_le_compat_r; lra. }
    set (gap := val period * rate_bound g i - top) in *.
    assert (Hgap : 0 < gap / 2) by (unfold gap; lra).
    destruct (phi_continuous i c Hp Hi ltac:(lra) (gap / 2) Hgap) as [e [He N]].
    assert (Near : forall v, Rabs (v - c) < e -> Rabs (phi i v - phi i c) < gap / 2).
    { intros v Hv. destruct (Req_dec v c) as [->|Ne]; [rewrite Rminus_diag_eq, Rabs_R0 by auto; exact Hgap|].
      apply N. split; [split; [exact Logic.I|auto]|exact Hv]. }
    exists (Rmin e (val period)). split; [now apply Rmin_glb_lt|]. intros s Hs Hs0 tau T1 T2.
    assert (Hse : s < e) by (eapply Rlt_le_trans; [exact Hs|apply Rmin_l]).
    pose proof (Near (c + s) ltac:(rewrite Rabs_right; lra)) as F.
    replace (phi i tau - phi i (c + s)) with ((phi i tau - phi i c) - (phi i (c + s) - phi i c)) by ring.
    assert (F2 : Rabs (phi i tau - phi i c) <= top + gap / 2).
    { destruct (Rle_lt_dec tau c) as [L|L].
      - pose proof (Hb tau ltac:(split; [apply Rmax_lub; lra|lra])) as A. fold top in A. lra.
      - pose proof (Near tau ltac:(rewrite Rabs_right; lra)). pose proof (Rabs_pos (phi i b - phi i c)) as A.
        fold top in A. lra. }
    unfold Rminus at 1. eapply Rle_trans; [apply Rabs_triang|]. rewrite Rabs_Ropp. unfold gap in *. lra. }
  exists (Rmin e (ends g - c)). split; [apply Rmin_glb_lt; lra|]. intros t Hr.
  assert (L1 : t - c < e) by (pose proof (Rmin_l e (ends g - c)); lra).
  assert (L2 : t < ends g) by (pose proof (Rmin_r e (ends g - c)); lra).
  apply good_if; [lra|]. intros h i tau Hh Hr' Hi T1 T2.
  assert (h = g) as -> by (apply (only h g t Hh Na Hr'); lra).
  replace t with (c + (t - c)) in * by ring. apply (E i (t - c)); auto; lra.
Qed.
Lemma good_always t : since <= t < finish d -> good t.
Proof.
  destruct held_parts as [_ [_ [_ [_ [_ [_ [_ [P0 _]]]]]]]].
  destruct (Rle_lt_dec (val period) 0) as [Z|Hp].
  { intros Hr. apply good_if; [lra|]. intros g i tau Hg Hr' Hi T1 T2. assert (tau = t) as -> by lra.
    rewrite Rminus_diag_eq, Rabs_R0 by auto. assert (val period = 0) as -> by lra. lra. }
  pose (E := fun c => since <= c <= finish d /\ forall s, since <= s < c -> good s).
  destruct (completeness E) as [c [Hub Hlub]].
  { exists (finish d). intros s [Hs _]. lra. }
  { exists since. split; [lra|]. intros s Hs. lra. }
  assert (Hc : since <= c <= finish d).
  { split; [apply Hub; split; [lra|]; intros s Hs; lra|]. apply Hlub. intros s [Hs _]. lra. }
  assert (G : forall s, since <= s < c -> good s).
  { intros s Hs. apply Classical_Prop.NNPP. intros N. assert (c <= s); [|lra]. apply Hlub.
    intros v [Hv Gv]. apply Rnot_lt_le. intros L. apply N, Gv. lra. }
  destruct (Req_dec c (finish d)) as [->|Ne]; [exact (G t)|]. exfalso.
  destruct (good_longer c Hp ltac:(lra) G) as [e [He F]].
  set (b := Rmin (c + e) (finish d)).
  assert (Hb : c < b) by (apply Rmin_glb_lt; lra).
  assert (b <= c); [|lra]. apply Hub. split.
  - split; [lra|apply Rmin_r].
  - intros s Hs. destruct (Rlt_le_dec s c) as [L|L]; [apply G; lra|]. apply F.
    pose proof (Rmin_l (c + e) (finish d)). fold b in H0. lra.
Qed.
Lemma held_stays t : since <= t <= finish d -> inside d x t.
Proof. intros Hr. apply (inside_until (finish d)); auto; [lra|]. intros s Hs. now apply good_always. Qed.
Lemma bounds_here t : since <= t <= finish d -> held_in_bounds d x u t.
Proof.
  intros Hr g b Hg Hb. pose proof (segment_known g Hg) as Hok.
  destruct (segment_facts d g n Hok) as [Ln _ Lf Lg _ T _ _ _ _].
  destruct held_parts as [B _]. destruct (checked_segments d offs w H_checked) as [_ [Lo Each]].
  destruct (paired g (segments d) offs Lo Hg) as [off Hoff].
  unfold bounds_ok in B. rewrite forallb_forall in B. specialize (B _ Hoff). cbn [fst snd] in B.
  apply andb_prop in B as [He B]. rewrite forallb_forall in B. specialize (B b Hb).
  pose proof (at_length t) as Lat.
  assert (Kept : begins g <= t <= ends g -> form (P g (place g t)) (dev g x t) (dev g x t) <= rho g (place g t)).
  { intros Hr'. exact (held_stays t Hr g Hg Hr'). }
  assert (State : begins g <= t <= ends g -> (fst b < n)%nat ->
    val (fst (snd b)) <= nth (fst b) (at_time x t) 0 <= val (snd (snd b))).
  { intros Hr' Hj. pose proof (proj2 (Nat.ltb_lt _ _) Hj) as Hj'.
    refine (bound_kept d g n Hok off (place g t) (at_time x t) b _ Hlim He B
      (place_in d g n Hok t Hr') Lat (Kept Hr') _ _).
    - rewrite app_nth1 by lia. unfold slack. rewrite Hj', Rminus_diag_eq, Rabs_R0, val_nzero by auto. lra.
    - unfold limit_of. now rewrite Hj'. }
  split; [intros Hr' Hj; apply State; auto; congruence|]. intros Hr'.
  destruct (Nat.lt_ge_cases (fst b) n) as [Hj|Hj].
  { rewrite app_nth1 by lia. apply State; auto. lra. }
  set (i := (fst b - n)%nat). rewrite app_nth2 by lia. rewrite Lat. fold i.
  assert (Hi : (i < m)%nat).
  { destruct b as [j [low high]]. cbn [fst] in *. unfold bound_ok in B. rewrite Ln in B.
    destruct (entry d g j) as [[centre rows] lim]. apply andb_prop in B as [B _].
    apply andb_prop in B as [B _]. apply Nat.ltb_lt in B. fold m in B. unfold i. lia. }
  destruct (applied_at g t Hg Hr' ltac:(lra)) as [Lu [tau [e [_ [_ [_ Hu]]]]]].
  pose proof (good_always t ltac:(pose proof (until_finish g Hg); lra) g off Hoff Hr') as Gd.
  assert (Hnlt : Nat.ltb (fst b) n = false) by now apply Nat.ltb_ge.
  refine (bound_kept d g n Hok off (place g t) (at_time x t) b _ Hlim He B
    (place_in d g n Hok t ltac:(lra)) Lat (Kept ltac:(lra)) _ _).
  - rewrite app_nth2 by lia. rewrite Lat. fold i. unfold slack. rewrite Hnlt. fold i.
    unfold within_off in Gd. destruct off as [|o os] eqn:Eo.
    { destruct (off_value g [] i Hoff Hi) as [L0 _]. cbn in L0. lia. }
    rewrite <- Eo in *. destruct Gd as [delta [Hd ->]].
    pose proof (input_length g (place g t) (at_time x t) Hg) as Li.
    destruct (off_value g off i Hoff Hi) as [L0 _].
    pose proof (Condition.Forall2_length _ _ _ Hd) as Ld. unfold around in Ld. rewrite map_length in Ld.
    rewrite (zip_nth _ 0 0) by lia.
    replace (nth i (input d g (place g t) (at_time x t)) 0 + nth i delta 0
      - nth i (input d g (place g t) (at_time x t)) 0) with (nth i delta 0) by ring.
    clear - Hd L0 Hi. rewrite <- L0 in Hi. clear L0. unfold around, in_box in Hd. clearbody i. revert i Hi delta Hd.
    induction off as [|o os IH]; intros i Hi delta Hd; [cbn in Hi; lia|].
    inversion Hd as [|v ? l ? A B]; subst. cbn [fst snd] in A. rewrite val_opp in A.
    destruct i as [|i]; cbn [nth]; [apply Rabs_le; lra|]. apply IH; auto. cbn in Hi. lia.
  - unfold limit_of. rewrite Hnlt. fold i. rewrite (Hu i Hi). apply clip_within.
    pose proof Hlim as A. rewrite Forall_forall in A. apply A, nth_In. exact Hi.
Qed.
End Solution.

(* What starts inside stays inside, within its bounds, and ends in its goal. *)
Theorem held_proved since x u : held_solution d period errors since x u ->
  begin d <= since <= finish d -> inside d x since ->
  (forall t, since <= t <= finish d -> inside d x t /\ held_in_bounds d x u t) /\ in_goal d x.
Proof.
  intros Hs Hr Hi. destruct held_parts as [_ [Hg [Hne _]]].
  assert (E : exists g0 gs0, segments d = g0 :: gs0).
  { clear - Hne. destruct (segments d) as [|g0 gs0]; [cbn in Hne; lia|eauto]. }
  destruct E as [g0 [gs0 E]].
  assert (S : forall t, since <= t <= finish d -> inside d x t).
  { intros t Ht'. now apply (held_stays since x u g0 gs0 E Hs Hr Hi). }
  split.
  - intros t Ht'. split; auto. now apply (bounds_here since x u g0 gs0 E Hs Hr Hi).
  - apply (goal_reached d w (goal_multiplier w) C Hg); auto.
    + exact (x_length since x u g0 gs0 E Hs).
    + apply S. lra.
Qed.
End Problem.

(* The same of files. Entries of (delta, w) that only push do so in all time spans. *)
Definition pushing_of (f : field_file) : list bool :=
  map (fun j => forallb (forallb (alone (1 + states f + j))) (spans f))
    (seq 0 (inputs f + length (uncertain f))).
Definition held_files_ok f p u g (period : num) (errors : list num) (w : witness)
  (rs : list (list num)) (ts : list (list rate_piece)) : bool :=
  andb (andb (field_ok f) (andb (policy_ok f p) (shape_ok f p u g)))
    (andb (held_ok (stated f p u g) period errors w (Rates rs (pushing_of f) ts))
      (if pushed w then forallb (forallb (pushes_only (1 + states f + inputs f))) (spans f)
       else true)).

Theorem held_theorem f p u g period errors w rs ts :
  held_files_ok f p u g period errors w rs ts = true ->
  forall since x act, held_solution (stated f p u g) period errors since x act ->
  begin (stated f p u g) <= since <= finish (stated f p u g) -> inside (stated f p u g) x since ->
  (forall t, since <= t <= finish (stated f p u g) ->
    inside (stated f p u g) x t /\ held_in_bounds (stated f p u g) x act t) /\
  in_goal (stated f p u g) x.
Proof.
  unfold held_files_ok. intros H since x act Hx Hr Hi. apply andb_prop in H as [_ H].
  apply andb_prop in H as [H _]. now apply (held_proved _ period errors w (Rates rs (pushing_of f) ts)).
Qed.
End Held.
