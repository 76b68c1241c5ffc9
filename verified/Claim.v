(* What is proved of a continuous funnel, in full: its numbers, the closed loop, its solutions, and
   what it means to be inside. Nothing here is about how it is decided. *)
From Coq Require Import ZArith Reals List.
From Verified Require Import Forms.
Import ListNotations.
Open Scope R_scope.

(* A number of a file: a fraction. *)
Definition num := (Z * positive)%type.
Definition val (a : num) : R := IZR (fst a) / IZR (Zpos (snd a)).

(* Curves in s in [0, 1], by Bernstein control points, at most four. *)
Definition bernstein (d : nat) (s : R) : list R :=
  match d with
  | O => [1]
  | 1%nat => [1 - s; s]
  | 2%nat => [(1 - s) * (1 - s); 2 * (s * (1 - s)); s * s]
  | 3%nat => [(1 - s) * ((1 - s) * (1 - s)); 3 * (s * ((1 - s) * (1 - s)));
              3 * (s * s * (1 - s)); s * s * s]
  | _ => []
  end.
Definition curve (points : list R) (s : R) : R := dot (bernstein (pred (length points)) s) points.

(* A knot: its time, P as the rows of its upper triangle, and rho. *)
Record knot := Knot { time : num; shape : list (list num); level : num }.

(* A polynomial in (t, x, u, w): exponents, and a coefficient, of each term. *)
Definition equation := list (list nat * num).

(* The interval between two knots: control points of the nominal state, of the nominal input, of
   the gains by input and state; one equation for each state; bounds [j, low, high] of entries j
   of (x, u) inside which the equations are valid. *)
Record segment := Segment {
  start : knot; stop : knot;
  nominal : list (list num); feed : list (list num); gains : list (list (list num));
  equations : list equation; bounds : list (nat * (num * num)) }.

(* [limits]: for each input, what it is clipped to, if it is. [box]: the range of each w.
   [goal]: centre and P (upper triangle) of an ellipsoid. *)
Record problem := Problem {
  segments : list segment; limits : list (option (num * num)); box : list (num * num);
  goal : option (list num * list (list num)) }.

Definition begins (g : segment) : R := val (time (start g)).
Definition ends (g : segment) : R := val (time (stop g)).
Definition duration (g : segment) : R := ends g - begins g.
(* s in [0, 1] along the segment *)
Definition place (g : segment) (t : R) : R := (t - begins g) / duration g.

Definition along (s : R) (points : list num) : R := curve (map val points) s.
Definition line (s : R) (a b : num) : R := (1 - s) * val a + s * val b.
Definition P (g : segment) (s : R) : list (list R) :=
  zip (zip (line s)) (shape (start g)) (shape (stop g)).
Definition rho (g : segment) (s : R) : R := line s (level (start g)) (level (stop g)).

(* the state relative to the nominal one *)
Definition deviation (g : segment) (s : R) (x : list R) : list R :=
  zip Rminus x (map (along s) (nominal g)).

(* u = clip(u0 - K (x - x0)) *)
Definition wanted (g : segment) (s : R) (z : list R) : list R :=
  zip (fun u row => along s u - dot (map (along s) row) z) (feed g) (gains g).
Definition clip (limit : option (num * num)) (u : R) : R :=
  match limit with None => u | Some (low, high) => Rmax (val low) (Rmin (val high) u) end.
Definition input (d : problem) (g : segment) (s : R) (x : list R) : list R :=
  zip clip (limits d) (wanted g s (deviation g s x)).

Fixpoint power (e : list nat) (v : list R) : R :=
  match e, v with k :: e', y :: v' => y ^ k * power e' v' | _, _ => 1 end.
Fixpoint rate (e : equation) (v : list R) : R :=
  match e with [] => 0 | (k, c) :: e' => val c * power k v + rate e' v end.
Definition field (g : segment) (t : R) (x u w : list R) : list R :=
  map (fun e => rate e (t :: x ++ u ++ w)) (equations g).

Definition in_box (w : list R) (box : list (num * num)) : Prop :=
  Forall2 (fun a b => val (fst b) <= a <= val (snd b)) w box.

Definition at_time (x : list (R -> R)) (t : R) : list R := map (fun f => f t) x.
Definition begin (d : problem) : R := match segments d with [] => 0 | g :: _ => begins g end.
Definition finish (d : problem) : R := last (map ends (segments d)) 0.

(* The derivative of f at t from the right. Where an input or w jumps, as a held one does, the state
   has none from both sides. *)
Definition right_derivative (f : R -> R) (t l : R) : Prop :=
  forall e, 0 < e -> exists d, 0 < d /\
    forall h, 0 < h < d -> Rabs ((f (t + h) - f t) / h - l) < e.

(* x is continuous, and between knots its derivative from the right is what the equations give under
   the policy, for some w in its box, which may be another one at each time. *)
Definition solution (d : problem) (x : list (R -> R)) : Prop :=
  (forall t, begin d <= t <= finish d -> Forall (fun f => continuity_pt f t) x) /\
  (forall g t, In g (segments d) -> begins g < t < ends g ->
    exists w, in_box w (box d) /\
      Forall2 (fun f v => right_derivative f t v) x
        (field g t (at_time x t) (input d g (place g t) (at_time x t)) w)).

(* W <= rho *)
Definition inside_segment (g : segment) (x : list (R -> R)) (t : R) : Prop :=
  let s := place g t in
  let z := deviation g s (at_time x t) in
  form (P g s) z z <= rho g s.
Definition inside (d : problem) (x : list (R -> R)) (t : R) : Prop :=
  forall g, In g (segments d) -> begins g <= t <= ends g -> inside_segment g x t.

(* Where the equations are valid: entries of (x, u) within their bounds. *)
Definition in_bounds (d : problem) (x : list (R -> R)) (t : R) : Prop :=
  forall g b, In g (segments d) -> begins g <= t <= ends g -> In b (bounds g) ->
  val (fst (snd b)) <= nth (fst b) (at_time x t ++ input d g (place g t) (at_time x t)) 0
    <= val (snd (snd b)).

(* (x - centre)'B(x - centre) <= 1 at the end *)
Definition in_goal (d : problem) (x : list (R -> R)) : Prop :=
  match goal d with
  | None => True
  | Some (centre, B) =>
      let z := zip Rminus (at_time x (finish d)) (map val centre) in
      form (map (map val) B) z z <= 1
  end.

(* A policy that is held, late, or measures with an error: the input at t is the policy's of some
   time tau at most [period] before, not before [since], for the state then, which is measured wrong
   by at most so much. At a knot it is the policy's on either side. *)
Definition was_applied (d : problem) (period : num) (errors : list num) (x : list (R -> R))
  (since t : R) (u : list R) : Prop :=
  exists g tau e, In g (segments d) /\ begins g <= tau <= ends g /\
    since <= tau /\ t - val period <= tau <= t /\
    Forall2 (fun v most => Rabs v <= val most) e errors /\
    u = input d g (place g tau) (zip Rplus (at_time x tau) e).
(* x starts at [since] and is continuous from then on; between knots its derivative from the right is
   what the equations give under u, for some w in its box. *)
Definition held_solution (d : problem) (period : num) (errors : list num) (since : R)
  (x : list (R -> R)) (u : R -> list R) : Prop :=
  Forall (fun g => length x = length (nominal g)) (segments d) /\
  (forall t, since <= t <= finish d -> Forall (fun f => continuity_pt f t) x) /\
  (forall g t, In g (segments d) -> begins g < t < ends g ->
    (since <= t -> was_applied d period errors x since t (u t)) /\
    (since < t -> exists w, in_box w (box d) /\
      Forall2 (fun f v => right_derivative f t v) x (field g t (at_time x t) (u t) w))).
(* The state within its bounds at every time, the input that is applied between knots. *)
Definition held_in_bounds (d : problem) (x : list (R -> R)) (u : R -> list R) (t : R) : Prop :=
  forall g b, In g (segments d) -> In b (bounds g) ->
  (begins g <= t <= ends g -> (fst b < length (nominal g))%nat ->
    val (fst (snd b)) <= nth (fst b) (at_time x t) 0 <= val (snd (snd b))) /\
  (begins g < t < ends g ->
    val (fst (snd b)) <= nth (fst b) (at_time x t ++ u t) 0 <= val (snd (snd b))).
