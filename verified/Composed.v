(* Funnels that follow each other in time, each ending inside the next, are one funnel. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Claim Definite Funnel Stays Goal Valid Files.
Import ListNotations.
Open Scope R_scope.

(* x is in the funnel d from ta on, within its bounds, and ends in its goal. *)
Definition kept (d : problem) (x : list (R -> R)) (ta : R) : Prop :=
  (forall t, ta <= t <= finish d -> inside d x t /\ in_bounds d x t) /\ in_goal d x.
(* A solution of all stages that is in one of them, at a time of its own, is kept in it, and in each
   that follows from its beginning on. *)
Fixpoint carried (ds : list problem) (x : list (R -> R)) : Prop :=
  match ds with
  | [] => True
  | d :: rest =>
      (forall ta, begin d <= ta <= finish d -> inside d x ta ->
        kept d x ta /\ Forall (fun e => kept e x (begin e)) rest) /\ carried rest x
  end.
Definition composed (ds : list problem) : Prop :=
  forall x, Forall (fun d => solution d x) ds -> carried ds x.

Record stage := Stage {
  dynamics : field_file; control : policy_file; tunnel : funnel_file;
  aim : option (list num * list (list num)) }.
Definition stated_by (g : stage) : problem :=
  stated (dynamics g) (control g) (tunnel g) (aim g).

Section Composed.
Context {K : Ints}.

Definition starting (g : segment) : list num * list (list num) :=
  (map first_of (nominal g), map (map (fun e => ndiv e (level (start g)))) (shape (start g))).
Definition aimed (d : problem) (g : segment) : problem :=
  Problem (segments d) (limits d) (box d) (Some (starting g)).
(* [d] ends when [e] begins, and inside it there. *)
Definition enters (d e : problem) (lambda : num) : bool :=
  match rev (segments d), segments e with
  | h :: _, g :: _ =>
      andb (andb (num_eqb (time (stop h)) (time (start g)))
          (Nat.eqb (length (nominal h)) (length (nominal g))))
        (goal_ok (aimed d g) lambda)
  | _, _ => false
  end.
Fixpoint joined (ds : list problem) (lambdas : list num) : bool :=
  match ds, lambdas with
  | [_], [] => true
  | d :: ((e :: _) as rest), l :: lambdas' => andb (enters d e l) (joined rest lambdas')
  | _, _ => false
  end.
Definition stage_ok (s : stage) (w : witness) : bool :=
  files_ok (dynamics s) (control s) (tunnel s) (aim s) w.
Definition composed_ok (gs : list stage) (ws : list witness) (lambdas : list num) : bool :=
  andb (Nat.eqb (length gs) (length ws))
    (andb (forallb (fun e => stage_ok (fst e) (snd e)) (combine gs ws))
      (joined (map stated_by gs) lambdas)).

Lemma first_positive a : 0 < val a -> (0 < fst a)%Z.
Proof.
  intros H. apply lt_IZR, (Rmult_lt_reg_r (/ IZR (Zpos (snd a)))).
  - now apply Rinv_0_lt_compat, IZR_lt.
  - rewrite Rmult_0_l. exact H.
Qed.
Lemma form_divided rho k : 0 < val rho -> forall M y z, triangular k M ->
  form (map (map val) (map (map (fun e => ndiv e rho)) M)) y z * val rho = form (vals M) y z.
Proof.
  intros H. pose proof (first_positive rho H) as Hp.
  induction k as [|k IH]; intros [|row M] y z T; cbn [triangular] in T; try tauto.
  { cbn. ring. }
  destruct T as [L T]. destruct row as [|a b]; [discriminate|]. destruct y as [|y0 y], z as [|z0 z];
    cbn [map vals form]; try ring.
  assert (D : forall v, dot (map val (map (fun e => ndiv e rho) b)) v * val rho = dot (map val b) v).
  { clear - H Hp. induction b as [|b0 b IH]; intros [|v0 v]; cbn [map dot]; try ring.
    rewrite val_div by auto. rewrite <- (IH v). field. lra. }
  specialize (IH M y z T). rewrite val_div by auto. rewrite <- !D. unfold vals in *. rewrite <- IH.
  field. lra.
Qed.
Lemma first_only gs g g1 rest : gs = g1 :: rest -> linked gs = true ->
  Forall (fun g => begins g < ends g) gs -> In g gs -> begins g <= begins g1 -> g = g1.
Proof.
  intros -> Hl Ht Hin Hb. destruct Hin as [|Hin]; auto. exfalso. destruct rest as [|g2 rest]; [destruct Hin|].
  cbn [linked] in Hl. apply andb_prop in Hl as [Hl1 Hl2]. apply andb_prop in Hl1 as [Hk _].
  apply knot_eqb_eq in Hk. inversion Ht as [|? ? T1 T2]; subst.
  destruct (last_end (g2 :: rest) g Hin Hl2 T2) as [A _]. cbn [hd] in A.
  unfold ends, begins in *. rewrite Hk in T1. lra.
Qed.

Lemma enters_inside d e w w' lambda x : checked d w -> checked e w' ->
  (0 < length (segments d))%nat -> solution d x -> enters d e lambda = true ->
  inside d x (finish d) -> inside e x (begin e) /\ finish d = begin e.
Proof.
  intros Cd Ce Hne Sd H Hin. unfold enters in H.
  destruct (rev (segments d)) as [|h hs] eqn:Er; [discriminate|].
  destruct (segments e) as [|g gs] eqn:Eg; [discriminate|].
  apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [H0 H1].
  apply num_eqb_eq in H0. apply Nat.eqb_eq in H1.
  assert (Es : segments d = rev hs ++ [h]).
  { rewrite <- (rev_involutive (segments d)), Er. reflexivity. }
  assert (Fin : finish d = begin e).
  { unfold finish, begin. rewrite Es, map_app, Eg. cbn. rewrite last_last. unfold ends, begins. now rewrite H0. }
  split; auto.
  assert (Ca : checked (aimed d g) w) by (destruct Cd; constructor; assumption).
  pose proof (goal_reached (aimed d g) w lambda Ca H2 Hne x (solution_length d w x Cd Hne Sd) Hin) as G.
  unfold in_goal in G. cbn [goal aimed] in G. unfold starting in G.
  change (finish (aimed d g)) with (finish d) in G. rewrite Fin in G.
  destruct Ce as [_ _ Hl Hok Ht _].
  assert (Hg : In g (segments e)) by (rewrite Eg; now left).
  pose proof Hok as Hok'. rewrite Forall_forall in Hok. pose proof (Hok g Hg) as Okg.
  destruct (segment_facts e g (first_size e) Okg) as [_ _ _ _ C T R0 _ [S0 S1] _].
  intros g' Hg' Hr.
  assert (g' = g).
  { apply (first_only (segments e) g' g gs Eg).
    - exact Hl.
    - exact Ht.
    - exact Hg'.
    - unfold begin in Hr. rewrite Eg in Hr. lra. }
  subst g'. assert (B : begin e = begins g) by (unfold begin; now rewrite Eg). rewrite B in *.
  unfold inside_segment. rewrite place_start. unfold P, rho. rewrite line_0.
  rewrite (zip_line_left (first_size e) 0 line_0 _ _ S0 S1).
  assert (Dev : deviation g 0 (at_time x (begins g))
    = zip Rminus (at_time x (begins g)) (map val (map first_of (nominal g)))).
  { unfold deviation. f_equal. rewrite map_map. apply map_ext_in. intros c Hc.
    rewrite Forall_forall in C. now destruct (along_ends c (C c Hc)). }
  rewrite Dev. set (z := zip Rminus _ _) in *.
  fold (vals (shape (start g))). rewrite <- (form_divided (level (start g)) (first_size e)); auto.
  pose proof (Rmult_le_compat_r (val (level (start g))) _ _ (Rlt_le _ _ R0) G). lra.
Qed.

Lemma stage_checked s w : stage_ok s w = true -> checked (stated_by s) w /\
  (0 < length (segments (stated_by s)))%nat.
Proof.
  unfold stage_ok, files_ok. cbn zeta. intros H. apply andb_prop in H as [_ H].
  apply andb_prop in H as [H _]. apply andb_prop in H as [H _]. unfold funnel_ok in H.
  apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [H1 _]. apply andb_prop in H2 as [H2 _].
  apply Nat.ltb_lt in H2. split; auto. exact (check_facts _ _ _ H1).
Qed.
Lemma ordered d w : checked d w -> (0 < length (segments d))%nat -> begin d <= finish d.
Proof.
  intros [_ _ _ _ Ht Range] Hne. destruct (segments d) as [|g gs] eqn:E; [cbn in Hne; lia|].
  destruct (Range g (or_introl eq_refl)). inversion Ht; subst. lra.
Qed.

Theorem composed_theorem gs : forall ws lambdas, composed_ok gs ws lambdas = true ->
  composed (map stated_by gs).
Proof.
  assert (Rest : forall gs ws lambdas x, length gs = length ws ->
    forallb (fun e => stage_ok (fst e) (snd e)) (combine gs ws) = true ->
    joined (map stated_by gs) lambdas = true -> Forall (fun d => solution d x) (map stated_by gs) ->
    carried (map stated_by gs) x /\
    (forall d rest, map stated_by gs = d :: rest -> inside d x (begin d) ->
      Forall (fun e => kept e x (begin e)) (d :: rest))).
  { clear gs. induction gs as [|s gs IH]; intros [|w ws] lambdas x L HW HJ HS; try discriminate.
    cbn [combine forallb fst snd] in HW. apply andb_prop in HW as [W1 W2]. injection L as L.
    cbn [map] in *. inversion HS as [|? ? S1 S2]; subst.
    destruct (stage_checked s w W1) as [C N]. pose proof (ordered _ w C N) as O.
    assert (Here : forall ta, begin (stated_by s) <= ta <= finish (stated_by s) ->
      inside (stated_by s) x ta -> kept (stated_by s) x ta).
    { intros ta Hta Hin. exact (funnel_theorem _ _ _ _ w W1 x S1 ta Hta Hin). }
    assert (Next : inside (stated_by s) x (finish (stated_by s)) ->
      Forall (fun e => kept e x (begin e)) (map stated_by gs)).
    { intros Hend. destruct gs as [|s2 gs]; [constructor|]. destruct ws as [|w2 ws]; [discriminate|].
      destruct lambdas as [|l lambdas]; [discriminate|]. cbn [map joined] in HJ.
      apply andb_prop in HJ as [J1 J2].
      cbn [combine forallb fst snd] in W2. pose proof W2 as W2'. apply andb_prop in W2' as [W3 _].
      destruct (stage_checked s2 w2 W3) as [C2 _]. inversion S2 as [|? ? S3 _]; subst.
      destruct (enters_inside _ _ w w2 l x C C2 N S1 J1 Hend) as [Hin _].
      destruct (IH (w2 :: ws) lambdas x L W2 J2 S2) as [_ F]. exact (F _ _ eq_refl Hin). }
    assert (Tail : carried (map stated_by gs) x).
    { destruct gs as [|s2 gs]; [exact Logic.I|]. destruct lambdas as [|l lambdas]; [discriminate|].
      cbn [map joined] in HJ. apply andb_prop in HJ as [_ J2].
      now destruct (IH ws lambdas x L W2 J2 S2). }
    split.
    - cbn [carried]. split; auto. intros ta Hta Hin. pose proof (Here ta Hta Hin) as Hk. split; auto.
      apply Next. destruct Hk as [Hk _]. apply Hk. lra.
    - intros d rest E Hin. injection E as <- <-. pose proof (Here (begin (stated_by s)) ltac:(lra) Hin) as Hk.
      constructor; auto. apply Next. destruct Hk as [Hk _]. apply Hk. lra. }
  intros ws lambdas H x Hx. unfold composed_ok in H. apply andb_prop in H as [L H].
  apply andb_prop in H as [HW HJ]. apply Nat.eqb_eq in L. now destruct (Rest gs ws lambdas x L HW HJ Hx).
Qed.
End Composed.
