(* A sampled funnel: what is decided of its steps, and why every motion stays in it. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Positive Claim Condition Definite Funnel
  Goal Valid Tubes
  Increments Near Samples Words Curvature.
Import ListNotations.
Open Scope R_scope.

Section Steps.
Context {K : Ints}.
Notation means z := (Polynomials.means 0 (env z)).

(* The witnesses of one chain of radii at a step, those of a step, those of all. *)
Record chain := Chain {
  reach : num; shifts : list Z; rest : squares; ball_shifts : list Z; ball : squares }.
Record link := Link {
  frame : matrix; kappa : num; curvature : list num; of_tube : chain; of_inlet : chain }.
Record links := Links { basis : list mono; ball_basis : list mono; linked : list link }.

Fixpoint echelon (i : nat) (M : matrix) : bool :=
  match M with
  | [] => true
  | row :: M' =>
      andb (andb (forallb (fun a => Z.eqb (fst a) 0) (firstn i row))
        (negb (Z.eqb (fst (nth i row nzero)) 0))) (echelon (S i) M')
  end.
Definition nonneg (a : num) : bool := (0 <=? fst a)%Z.
Definition positive (a : num) : bool := (0 <? fst a)%Z.
Definition nproducts (A B : matrix) : matrix := map (fun row => combination row B) A.

Definition flinear (M : matrix) (z : list F) : list F := map (fun row => fdot (map fnum row) z) M.
Definition fmoved (m : map_file) (p : track_file) (k : nat) (xi : list F) : list F :=
  let x := zip fadd (map fnum (nth k (states p) [])) xi in
  let u := zip fsub (map fnum (nth k (inputs p) [])) (flinear (nth k (feedback p) []) xi) in
  let es := equations_of m in
  let values := ftable (x ++ u) (highest es) in
  zip fsub (map (fun e => frate e values) es) (map fnum (nth (S k) (states p) [])).

Fixpoint npow (a : num) (k : nat) : num := match k with O => none | S j => nmul a (npow a j) end.
Fixpoint nspread (m : nat) (t q : num) : num :=
  match m with O => nzero | S k => nadd (npow t k) (nmul q (nspread k t q)) end.
Fixpoint nstretch (m : nat) (gammas : list num) (far near : num) : num :=
  match gammas with
  | [] => nzero
  | g :: gs => nadd (nmul g (nspread m far near)) (nstretch (S m) gs far near)
  end.

Section Decided.
Variables (m : map_file) (p : track_file) (s : sampled_file).
Definition order : nat := length (x_range m).
Definition scale_at (k : nat) : matrix := nth k (scales s) [].
Definition radius_at (radii : list num) (k : nat) : num := nth k radii nzero.
Definition adds : num := match assumed_form s with Peak => nzero | _ => bound s end.

(* |z| <= kappa |S T z| *)
Definition kappa_ok (ST : matrix) (kap : num) : bool :=
  andb (nonneg kap) (semidefinite false (triangle
    (map (fun row => (vscale (nmul kap kap) row, row)) ST
      ++ map (fun u => (vscale (nopp none) u, u)) (units order)))).
(* What deviations within the bound are stretched by, from a radius on. *)
Definition stretched (l : link) (radius : num) : num :=
  let near := nmul (kappa l) radius in
  nmul (kappa l) (nstretch 1 (curvature l) (nadd near (nmul (kappa l) (bound s))) near).
(* What the disturbance adds to the reach. *)
Definition added (l : link) (radius : num) : option num :=
  match assumed_form s with
  | Peak => Some (bound s)
  | Response => Some (nmul (stretched l radius) (bound s))
  | _ =>
      let mu := stretched l radius in
      if num_leb (nmul (weighs s) (nmul mu mu)) (nmul (nsub (weighs s) none) (forgets_by s))
      then Some nzero else None
  end.
Definition chain_ok (base ball_base : list mono) (products_of : choices) (k : nat) (l : link)
  (gg size2 : F) (radii : list num) (c : chain) : bool :=
  let now := radius_at radii k in
  match expanded ball_base (ball_shifts c) (ball c), added l now with
  | Some sigma, Some more =>
      andb (andb (nonneg (reach c)) (num_leb (nadd (reach c) more) (radius_at radii (S k))))
        (is_nonneg base products_of (shifts c) (rest c)
          (fsub (fsub (fnum (nmul (reach c) (reach c))) gg)
            (fmul sigma (fsub (fnum (nmul now now)) size2))))
  | _, _ => false
  end.
Definition link_ok (base ball_base : list mono) (products_of : choices) (k : nat) (l : link) : bool :=
  let T := frame l in
  let z := fstate order in
  let xi := flinear T z in
  let g := flinear (scale_at (S k)) (fmoved m p k xi) in
  let y := flinear (scale_at k) xi in
  let q := match assumed_form s with
    | Response => zip fsub g (flinear (scale_at (S k)) (flinear (nth k (responses s) []) xi))
    | _ => g end in
  let gg := fdot g g in
  let size2 := fdot y y in
  andb (andb (andb (shaped order order T) (echelon 0 T)) (kappa_ok (nproducts (scale_at k) T) (kappa l)))
    (andb (curvature_ok order q (curvature l))
      (andb (chain_ok base ball_base products_of k l gg size2 (tube_radii s) (of_tube l))
        (chain_ok base ball_base products_of k l gg size2 (inlet_radii s) (of_inlet l)))).

(* |g'z| <= room where |S z| <= size *)
Definition fits_in (S : matrix) (size room : num) (g : list num) : bool :=
  andb (nonneg room) (semidefinite false (triangle
    ((vscale (nopp (nmul size size)) g, g) :: map (fun row => (vscale (nmul room room) row, row)) S))).
Definition room (c : num) (ends : num * num) : num := nmin (nsub (snd ends) c) (nsub c (fst ends)).
Definition sample_ok (k : nat) : bool :=
  let S := scale_at k in
  let t := nadd (radius_at (tube_radii s) k) adds in
  let i := nadd (radius_at (inlet_radii s) k) adds in
  let most := if num_ltb t i then i else t in
  let all rows centres ends :=
    forallb (fun e => fits_in S most (room (snd (fst e)) (snd e)) (fst (fst e)))
      (combine (combine rows centres) ends) in
  andb (andb (andb (shaped order order S) (echelon 0 S))
      (andb (positive (radius_at (tube_radii s) k)) (positive (radius_at (inlet_radii s) k))))
    (andb (forallb (fun e => fits_in S t (snd e) (fst e))
        (combine (units order) (nth k (half_widths s) [])))
      (andb (all (units order) (nth k (states p) []) (x_range m))
        (if Nat.ltb k (steps p) then all (nth k (feedback p) []) (nth k (inputs p) []) (u_range m)
         else true))).

Definition sized {A : Type} (n : nat) (l : list A) : bool := Nat.eqb (length l) n.
Definition sizes_ok (w : links) : bool :=
  let n := order in
  let q := length (u_range m) in
  let N := steps p in
  andb (andb (andb (Nat.ltb 0 n) (forallb (sized (n + q)) (powers m)))
      (shaped (length (powers m)) n (coefficients m)))
    (andb (andb (andb (shaped N q (inputs p)) (shaped (S N) n (states p)))
        (andb (sized N (feedback p)) (forallb (shaped q n) (feedback p))))
      (andb (andb (andb (sized (S N) (tube_radii s)) (sized (S N) (inlet_radii s)))
          (andb (shaped (S N) n (half_widths s)) (sized (S N) (scales s))))
        (andb (andb (sized N (responses s)) (forallb (shaped n n) (responses s)))
          (sized N (linked w))))).
Definition form_ok : bool :=
  andb (nonneg (bound s))
    match assumed_form s with
    | Energy | Fading => andb (num_leb none (weighs s)) (nonneg (forgets_by s))
    | _ => true
    end.
Definition sampled_ok (w : links) : bool :=
  let products_of := products (basis w) in
  andb (andb (sizes_ok w) form_ok)
    (andb (forallb sample_ok (seq 0 (S (steps p))))
      (forallb (fun e => link_ok (basis w) (ball_basis w) products_of (fst e) (snd e))
        (combine (seq 0 (steps p)) (linked w)))).
End Decided.
End Steps.
