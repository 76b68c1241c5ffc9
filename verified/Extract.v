(* The checker as a program: whole numbers become zarith's. Trusts extraction and zarith. *)
From Coq Require Import ZArith List Extraction ExtrOcamlBasic ExtrOcamlNatInt ExtrOcamlZBigInt.
From Verified Require Import Integers Positive Claim Funnel Goal.

Extract Constant Z.gcd => "Big_int_Z.gcd_big_int".
Extract Constant Z.leb => "Big_int_Z.le_big_int".
Extract Constant Z.ltb => "Big_int_Z.lt_big_int".
Extract Constant Pos.leb => "Big_int_Z.le_big_int".
Extract Constant Pos.eqb => "Big_int_Z.eq_big_int".

Definition decide (d : problem) (w : @witness plain) : bool := @funnel_ok plain d w.
Extraction "checker.ml" decide.
