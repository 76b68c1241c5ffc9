(* The numbers as the files of a continuous funnel hold them, and the problem that they state:
   [funnel_theorem] is about exactly these. Read [stated] too. *)
From Coq Require Import ZArith Reals List Lra Lia Bool.
From Verified Require Import Integers Forms Claim Condition Definite Pushed Funnel Stays Goal Valid.
Import ListNotations.

(* Rows of [valid]: entry of (x, u), low, high, and the time span if it is about one only. *)
Record field_file := Field {
  states : nat; inputs : nat; uncertain : list (num * num); breaks : list num;
  valid : list (nat * (num * num) * option nat); spans : list (list equation) }.
(* By interval and control point: the nominal input and the gains (by input and state). *)
Record policy_file := Policy {
  feeds : list (list (list num)); feedback : list (list (list (list num)));
  clips : list (nat * (num * num)) }.
(* Knots; by interval and control point the nominal state; P and rho at the knots. *)
Record funnel_file := Funnel {
  knots : list num; nominals : list (list (list num)); shapes : list (list (list num));
  levels : list num }.

Definition at_ {A : Type} (k : nat) (l : list (list A)) : list A := nth k l [].
Definition entry_of (i : nat) (l : list num) : num := nth i l nzero.
(* Control points of each of n entries. *)
Definition turned (n : nat) (points : list (list num)) : list (list num) :=
  map (fun i => map (entry_of i) points) (seq 0 n).
Definition upper (M : list (list num)) : list (list num) :=
  zip (@skipn num) (seq 0 (length M)) M.
(* An interval obeys the equations of the span that its start is in. *)
Definition span_at (f : field_file) (t : num) : nat :=
  length (filter (fun b => num_leb b t) (breaks f)).
Definition knot_of (u : funnel_file) (k : nat) : knot :=
  Knot (entry_of k (knots u)) (upper (at_ k (shapes u))) (entry_of k (levels u)).
Definition bounds_in (f : field_file) (span : nat) : list (nat * (num * num)) :=
  map fst (filter (fun row => match snd row with None => true | Some j => Nat.eqb j span end)
    (valid f)).
Definition segment_of (f : field_file) (p : policy_file) (u : funnel_file) (k : nat) : segment :=
  let span := span_at f (entry_of k (knots u)) in
  Segment (knot_of u k) (knot_of u (S k)) (turned (states f) (at_ k (nominals u)))
    (turned (inputs f) (at_ k (feeds p)))
    (map (fun i => turned (states f) (map (at_ i) (at_ k (feedback p)))) (seq 0 (inputs f)))
    (at_ span (spans f)) (bounds_in f span).
Definition clip_of (p : policy_file) (i : nat) : option (num * num) :=
  option_map snd (find (fun row => Nat.eqb (fst row) i) (clips p)).
Definition stated (f : field_file) (p : policy_file) (u : funnel_file)
  (g : option (list num * list (list num))) : problem :=
  Problem (map (segment_of f p u) (seq 0 (pred (length (knots u)))))
    (map (clip_of p) (seq 0 (inputs f))) (uncertain f)
    (option_map (fun g => (fst g, upper (snd g))) g).

(* The files have the sizes that they state; nothing else in them is dropped. *)
Definition sized {A : Type} (n : nat) (l : list A) : bool := Nat.eqb (length l) n.
Definition square (n : nat) (M : list (list num)) : bool :=
  andb (andb (sized n M) (forallb (sized n) M)) (list_eqb (list_eqb num_eqb) M (turned n M)).
Definition field_ok (f : field_file) : bool :=
  let n := states f in let m := inputs f in
  andb (andb (andb (forallb (fun b => num_leb (fst b) (snd b)) (uncertain f))
      (sized (S (length (breaks f))) (spans f)))
    (forallb (fun e => num_ltb (fst e) (snd e)) (combine (breaks f) (tl (breaks f)))))
  (andb (forallb (fun row => andb (Nat.ltb (fst (fst row)) (n + m))
      match snd row with None => true | Some j => Nat.ltb j (length (spans f)) end) (valid f))
    (forallb (fun es => andb (sized n es)
      (forallb (forallb (fun t => andb (sized (1 + n + m + length (uncertain f)) (fst t))
        (forallb (fun k => Nat.leb k 1) (skipn (1 + n + m) (fst t))))) es)) (spans f))).
Fixpoint distinct (l : list nat) : bool :=
  match l with [] => true | i :: l' => andb (negb (existsb (Nat.eqb i) l')) (distinct l') end.
Definition policy_ok (f : field_file) (p : policy_file) : bool :=
  let n := states f in let m := inputs f in
  andb (andb (forallb (forallb (sized m)) (feeds p))
    (forallb (forallb (fun M => andb (sized m M) (forallb (sized n) M))) (feedback p)))
  (andb (forallb (fun row => Nat.ltb (fst row) m) (clips p)) (distinct (map fst (clips p)))).
Definition ranked (t : num) (ts : list num) : bool :=
  orb (existsb (num_eqb t) ts)
    (orb (num_leb t (hd nzero ts)) (num_leb (last ts nzero) t)).
Definition curves_ok {A : Type} (count : nat) (l : list (list A)) : bool :=
  andb (sized count l) (forallb (fun c => andb (Nat.ltb 0 (length c)) (Nat.leb (length c) 4)) l).
Definition shape_ok (f : field_file) (p : policy_file) (u : funnel_file)
  (g : option (list num * list (list num))) : bool :=
  let n := states f in let count := pred (length (knots u)) in
  andb (andb (andb (curves_ok count (nominals u)) (curves_ok count (feeds p)))
    (andb (curves_ok count (feedback p)) (forallb (forallb (sized n)) (nominals u))))
  (andb (andb (sized (S count) (shapes u)) (forallb (square n) (shapes u)))
    (andb (andb (sized (S count) (levels u)) (forallb (fun b => ranked b (knots u)) (breaks f)))
      match g with None => true | Some (_, B) => square n B end)).

Open Scope R_scope.
Section Files.
Context {K : Ints}.

Definition files_ok f p u g (w : witness) : bool :=
  let d := stated f p u g in
  andb (andb (field_ok f) (andb (policy_ok f p) (shape_ok f p u g)))
    (andb (andb (funnel_ok d (unmoved d) w) (bounds_ok d (unmoved d)))
      (if pushed w then forallb (forallb (pushes_only (1 + states f + inputs f))) (spans f)
       else true)).

Theorem funnel_theorem f p u g w : files_ok f p u g w = true ->
  forall x, solution (stated f p u g) x ->
  forall ta, begin (stated f p u g) <= ta <= finish (stated f p u g) ->
  inside (stated f p u g) x ta ->
  (forall t, ta <= t <= finish (stated f p u g) ->
    inside (stated f p u g) x t /\ in_bounds (stated f p u g) x t) /\
  in_goal (stated f p u g) x.
Proof.
  unfold files_ok. cbn zeta. set (d := stated f p u g). intros H x Hx ta Hta Hin.
  apply andb_prop in H as [_ H]. apply andb_prop in H as [H _]. apply andb_prop in H as [H Hb].
  destruct (funnel_proved d w H x Hx ta Hta Hin) as [S G]. split; auto.
  unfold funnel_ok in H. apply andb_prop in H as [H Hne]. apply andb_prop in H as [H _].
  apply andb_prop in Hne as [Hne _]. apply Nat.ltb_lt in Hne. pose proof (check_facts _ _ _ H) as C.
  intros t Ht. split; auto. apply (valid_kept d w x t); auto; [|lra]. now apply (solution_length d w).
Qed.
End Files.
