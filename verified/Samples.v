(* What is proved of a sampled funnel of an explicit model, in full: its numbers, the motions, what is
   assumed of the disturbance, and where they stay. Nothing here is about how it is decided. *)
From Coq Require Import ZArith Reals List.
From Verified Require Import Forms Claim Tubes.
Import ListNotations.
Open Scope R_scope.

Definition norm (v : list R) : R := sqrt (dot v v).

(* x+ = f(x, u): of each monomial in (x, u) the exponents, and a coefficient for each state. The data
   that the model was identified from are in the ranges of x and u. *)
Record map_file := Map {
  powers : list (list nat); coefficients : matrix; x_range : list (num * num);
  u_range : list (num * num) }.
(* At samples 0, 1, ...: the inputs, the nominal states (one more), the gains. *)
Record track_file := Track { inputs : matrix; states : matrix; feedback : list matrix }.
Inductive assumption := Response | Peak | Energy | Fading.
Record sampled_file := Sampled {
  assumed_form : assumption; bound : num; forgets_by : num; weighs : num;
  tube_radii : list num; inlet_radii : list num; half_widths : matrix;
  scales : list matrix; responses : list matrix }.

Definition equations_of (m : map_file) : list equation :=
  map (fun i => zip pair (powers m) (map (fun row => nth i row (0%Z, xH)) (coefficients m)))
    (seq 0 (length (x_range m))).
Definition maps_to (m : map_file) (x u : list R) : list R :=
  map (fun e => rate e (x ++ u)) (equations_of m).

Section Samples.
Variables (m : map_file) (p : track_file) (s : sampled_file).

Definition steps : nat := length (inputs p).
Definition row (k : nat) (M : matrix) : list R := map val (nth k M []).
Definition times (k : nat) (Ms : list matrix) (z : list R) : list R :=
  image (map (map val) (nth k Ms [])) z.
Definition radius (radii : list num) (k : nat) : R := val (nth k radii (0%Z, xH)).

(* the state relative to the nominal one at sample k, its size, and the policy's input *)
Definition off (k : nat) (x : list R) : list R := minus x (row k (states p)).
Definition size (k : nat) (z : list R) : R := norm (times k (scales s) z).
Definition commanded (k : nat) (x : list R) : list R :=
  minus (row k (inputs p)) (times k (feedback p) (off k x)).

(* An estimate x_0, ..., x_N under the policy, and its disturbance: d_k = x_(k+1) - f(x_k, u_k). *)
Definition motion (x d : nat -> list R) : Prop :=
  length (x O) = length (x_range m) /\
  forall k, (k < steps)%nat -> length (d k) = length (x_range m) /\
    x (S k) = plus (maps_to m (x k) (commanded k (x k))) (d k).

(* r_0 = 0, r_(k+1) = A_k r_k + d_k; E_0 = 0, E_(k+1) = rate E_k + gain |d_k|^2 *)
Fixpoint response (d : nat -> list R) (k : nat) : list R :=
  match k with
  | O => repeat 0 (length (x_range m))
  | S j => plus (times j (responses s) (response d j)) (d j)
  end.
Fixpoint energy (d : nat -> list R) (k : nat) : R :=
  match k with
  | O => 0
  | S j => val (forgets_by s) * energy d j + val (weighs s) * size (S j) (d j) ^ 2
  end.
(* The assumption, up to sample k; and what it adds to a radius. *)
Definition assumed (d : nat -> list R) (k : nat) : Prop :=
  match assumed_form s with
  | Peak => forall j, (j < k)%nat -> size (S j) (d j) <= val (bound s)
  | Response => forall j, (j <= k)%nat -> size j (response d j) <= val (bound s)
  | _ => forall j, (j <= k)%nat -> sqrt (energy d j) <= val (bound s)
  end.
Definition widened : R := match assumed_form s with Peak => 0 | _ => val (bound s) end.

(* In the box of the data, and so is the policy's input. *)
Definition in_data (k : nat) (x : list R) : Prop :=
  in_box x (x_range m) /\ ((k < steps)%nat -> in_box (commanded k x) (u_range m)).

Definition stays_in_tube : Prop :=
  forall x d, motion x d -> size O (off O (x O)) <= radius (tube_radii s) O ->
  forall k, (k <= steps)%nat -> assumed d k ->
  size k (off k (x k)) <= radius (tube_radii s) k + widened /\ in_data k (x k) /\
  forall i, (i < length (x_range m))%nat ->
    Rabs (nth i (off k (x k)) 0) <= nth i (row k (half_widths s)) 0.
Definition arrives_from_inlet : Prop :=
  forall x d, motion x d -> size O (off O (x O)) <= radius (inlet_radii s) O ->
  forall k, (k <= steps)%nat -> assumed d k ->
  size k (off k (x k)) <= radius (inlet_radii s) k + widened /\ in_data k (x k) /\
  forall i, (i < length (x_range m))%nat ->
    Rabs (nth i (off k (x k)) 0) * (radius (tube_radii s) k + widened)
      <= nth i (row k (half_widths s)) 0 * (radius (inlet_radii s) k + widened).
End Samples.
