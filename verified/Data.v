(* How generated files write witnesses. Nothing is proved of these: a witness may be anything. *)
From Coq Require Import ZArith List Uint63.
From Bignums Require Import BigN BigZ.
From Verified Require Import Integers Polynomials Positive Funnel.
Import ListNotations.

#[export] Existing Instance big.

(* A machine word: twice the size of a whole number, plus one if it is negative. *)
Definition of_word (i : int) : @I big :=
  let n := BigN.N0 (i >> 1)%uint63 in
  if Uint63.is_even i then BigZ.Pos n else BigZ.Neg n.
Definition word_squares (unit scale : Z) (fs : list (list (Z * list int))) : @squares big :=
  Squares unit (ofZ scale)
    (map (map (fun e => (ofZ (fst e), map of_word (snd e)))) fs).
Definition big_mu (l : list (Z * (Z * Z))) : list (Z * (@I big * @I big)) :=
  map (fun e => (fst e, (ofZ (fst (snd e)), ofZ (snd (snd e))))) l.
