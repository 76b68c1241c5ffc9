(* What is proved of tubes and of the stability of identified models: their numbers, their solutions,
   an observer beside them. Nothing here is about how it is decided. *)
From Coq Require Import ZArith Reals List.
From Verified Require Import Forms Claim.
Import ListNotations.
Open Scope R_scope.

Definition matrix := list (list num).
Definition image (M : list (list R)) (z : list R) : list R := map (fun row => dot row z) M.
Definition plus (a b : list R) : list R := zip Rplus a b.
Definition minus (a b : list R) : list R := zip Rminus a b.
(* x'Px *)
Definition V (P : matrix) (x : list R) : R := dot x (image (map (map val) P) x).

(* [Linear a]: y = x_1 + d, x_i+ = a_i y + x_(i+1) + r_i.
   [Affine p n scale range terms]: 0 = (sum of w^e C over the terms (e, C)) [v; x] + r, x+ = the
   first n entries of [v; x], y_j = scale_j v_j + d_j; v has p entries, x n, and w is in its range.
   [Monotone e1 e2 e3 a shift]: 0 = e1 v + e2 v^2 + e3 v^3 + a'x + r_0, x+ = [v; shift x + r],
   y = v + d.
   [Cells maps into next out]: v_j = maps_j(into_j [v; x] + w_j), x+ = next [v; x] + r,
   y = out [v; x] + d; a map is linear between its points (knot, value), or a cubic spline on equal
   intervals from its lowest knot on, and goes on beyond them as it ends.
   What depends on the inputs alone, d and r (and w of Cells), may be anything, another at each
   time: it is the same for two solutions. *)
Inductive mapping :=
| Broken (points : list (num * num))
| Spline (low spacing : num) (coefficients : list num).
Inductive model :=
| Linear (a : list num)
| Affine (p n : nat) (scale : list num) (range : list (num * num))
    (terms : list (list nat * matrix))
| Monotone (e1 e2 e3 : num) (a : list num) (shift : matrix)
| Cells (maps : list mapping) (into next out : matrix).

Fixpoint through (a : num * num) (rest : list (num * num)) (s : R) : R :=
  match rest with
  | [] => val (snd a)
  | b :: rest' =>
      let line := val (snd a)
        + (val (snd b) - val (snd a)) / (val (fst b) - val (fst a)) * (s - val (fst a)) in
      match rest' with
      | [] => line
      | _ => if Rle_dec s (val (fst b)) then line else through b rest' s
      end
  end.
(* On one interval: c_0 (1 - s)^3/6 + ... + c_3 s^3/6 where 0 <= s <= 1, straight on beyond. *)
Definition cubic (a b c d s : R) : R :=
  (a * (1 - s) ^ 3 + b * (3 * s ^ 3 - 6 * s ^ 2 + 4) + c * (- 3 * s ^ 3 + 3 * s ^ 2 + 3 * s + 1)
    + d * s ^ 3) / 6.
Definition cubic' (a b c d s : R) : R :=
  ((b - a) * (1 - s) ^ 2 + (c - b) * (- 2 * s ^ 2 + 2 * s + 1) + (d - c) * s ^ 2) / 2.
Definition piece (a b c d p : R) : R :=
  let s := Rmax 0 (Rmin 1 p) in cubic a b c d s + (p - s) * cubic' a b c d s.
Fixpoint spline (cs : list R) (p : R) : R :=
  match cs with
  | a :: ((b :: c :: d :: rest) as cs') =>
      match rest with
      | [] => piece a b c d p
      | _ => if Rle_dec p 1 then piece a b c d p else spline cs' (p - 1)
      end
  | _ => 0
  end.
Definition mapped (f : mapping) (s : R) : R :=
  match f with
  | Broken [] => 0
  | Broken (a :: rest) => through a rest s
  | Spline low spacing cs => spline (map val cs) ((s - val low) / val spacing)
  end.

Fixpoint weighted (terms : list (list nat * matrix)) (w z : list R) (row : nat) : R :=
  match terms with
  | [] => 0
  | (e, C) :: rest => power e w * dot (map val (nth row C [])) z + weighted rest w z row
  end.

(* From the state x under the inputs w the model may give v, x' and y. *)
Definition step (m : model) (d r x w v x' y : list R) : Prop :=
  match m with
  | Linear a =>
      v = [] /\ length x = length a /\ length r = length a /\
      y = [hd 0 x + hd 0 d] /\
      x' = plus (plus (map (fun c => val c * hd 0 y) a) (tl x ++ [0])) r
  | Affine p n scale range terms =>
      length v = p /\ length x = n /\ length d = p /\ in_box w range /\
      (forall i, (i < p)%nat -> weighted terms w (v ++ x) i + nth i r 0 = 0) /\
      x' = firstn n (v ++ x) /\ y = plus (zip Rmult (map val scale) v) d
  | Monotone e1 e2 e3 a shift =>
      length v = 1%nat /\ length x = length a /\ length (tl r) = length shift /\
      (let u := hd 0 v in
       val e1 * u + val e2 * u ^ 2 + val e3 * u ^ 3 + dot (map val a) x + hd 0 r = 0) /\
      x' = v ++ plus (image (map (map val) shift) x) (tl r) /\ y = [hd 0 v + hd 0 d]
  | Cells maps into next out =>
      length v = length maps /\ length x = length next /\ length r = length next /\
      length d = length out /\ length w = length maps /\
      v = zip mapped maps (plus (image (map (map val) into) (v ++ x)) w) /\
      x' = plus (image (map (map val) next) (v ++ x)) r /\
      y = plus (image (map (map val) out) (v ++ x)) d
  end.

(* The simulation x, and the observer z beside it, under the same inputs w: after the model's own
   step, the innovation e_k = measured_k - (the observer's output) is injected. Where there was no
   measurement, e_k = 0 and measured_k is that output. *)
Record run (m : model) (L : matrix) := Run {
  d : nat -> list R; r : nat -> list R; w : nat -> list R;
  x : nat -> list R; v : nat -> list R; y : nat -> list R;
  z : nat -> list R; vz : nat -> list R; e : nat -> list R;
  measured : nat -> list R;
  simulation : forall k, step m (d k) (r k) (x k) (w k) (v k) (x (S k)) (y k);
  observer : forall k, exists z' yz, step m (d k) (r k) (z k) (w k) (vz k) z' yz /\
    z (S k) = plus z' (image (map (map val) L) (e k)) /\
    measured k = plus yz (e k) /\ length (e k) = length yz }.
Arguments w {m L}. Arguments x {m L}. Arguments y {m L}. Arguments z {m L}. Arguments e {m L}.
Arguments measured {m L}.

Record tube := Tube {
  fading : num; gain : matrix; storage : matrix; weight : matrix; tau : list num;
  widths : list num; top : num; inlet : num }.

(* E_0 = 0, E_(k+1) = rho E_k + e_k'R e_k *)
Fixpoint energy (t : tube) (e : nat -> list R) (k : nat) : R :=
  match k with O => 0 | S j => val (fading t) * energy t e j + V (weight t) (e j) end.

(* While E <= level g, g by the commands or 1, every output is within its width sqrt g. *)
Definition stays_near (m : model) (t : tube) : Prop :=
  forall (s : run m (gain t)) (g : nat -> R),
  (forall k, 0 <= g k) -> (val (inlet t) = 0 \/ forall k, g k = 1) ->
  V (storage t) (minus (z s O) (x s O)) <= val (inlet t) ->
  forall k, energy t (e s) (S k) <= val (top t) * g k ->
  forall j, (j < length (widths t))%nat ->
  Rabs (nth j (measured s k) 0 - nth j (y s k) 0) <= val (nth j (widths t) (0%Z, xH)) * sqrt (g k).

(* Two solutions under the same inputs. *)
Definition forgets (m : model) (P : matrix) (rate : num) : Prop :=
  forall d r w x v y z u q : nat -> list R,
  (forall k, step m (d k) (r k) (x k) (w k) (v k) (x (S k)) (y k)) ->
  (forall k, step m (d k) (r k) (z k) (w k) (u k) (z (S k)) (q k)) ->
  forall k, V P (minus (z k) (x k)) <= (val rate ^ 2) ^ k * V P (minus (z O) (x O)).

(* A plan is the simulation under its inputs u_k. Where the policy acts, the observed motion has the
   input u_k - kappa K (z - x), with its own kappa in [0, 1] at each sample: 0 is the plan's input
   played, 1 the policy engaged. *)
Definition stays_near_plan (a b : list num) (b0 c : num) (feedback : list num) (t : tube) : Prop :=
  forall (u kappa : nat -> R) (x y z e measured : nat -> list R),
  (forall k, 0 <= kappa k <= 1) ->
  (forall k, step (Linear a) [val b0 * u k + val c] (map (fun v => val v * u k) b)
    (x k) [] [] (x (S k)) (y k)) ->
  (forall k, let applied := u k - kappa k * dot (map val feedback) (minus (z k) (x k)) in
    exists z' yz, step (Linear a) [val b0 * applied + val c] (map (fun v => val v * applied) b)
      (z k) [] [] z' yz /\
    z (S k) = plus z' (image (map (map val) (gain t)) (e k)) /\
    measured k = plus yz (e k) /\ length (e k) = length yz) ->
  V (storage t) (minus (z O) (x O)) <= val (inlet t) ->
  forall k, energy t e (S k) <= val (top t) ->
  Rabs (hd 0 (measured k) - hd 0 (y k)) <= val (hd (0%Z, xH) (widths t)).
