(* The checker as a program: whole numbers become zarith's. Trusts extraction and zarith. *)
From Coq Require Import ZArith List Extraction ExtrOcamlBasic ExtrOcamlNatInt ExtrOcamlZBigInt.
From Verified Require Import Integers Positive Claim Funnel Goal Files Turning Held Composed Tubes Boxes Near Driven
  Samples Steps.

Extract Constant Z.gcd => "Big_int_Z.gcd_big_int".
Extract Constant Z.leb => "Big_int_Z.le_big_int".
Extract Constant Z.ltb => "Big_int_Z.lt_big_int".
Extract Constant Pos.leb => "Big_int_Z.le_big_int".
Extract Constant Pos.eqb => "Big_int_Z.eq_big_int".

Definition decide_funnel := @files_ok plain.
Definition decide_held := @held_files_ok plain.
Definition decide_tubes := @tubes_ok plain.
Definition decide_plans a b b0 feedback ts := forallb (@plan_ok plain a b b0 feedback) ts.
Definition decide_stability := @stability_ok plain.
Definition decide_sampled := @sampled_ok plain.
Definition decide_composed := @composed_ok plain.
Extraction "checker.ml" decide_funnel decide_tubes decide_plans decide_stability decide_sampled
  decide_composed decide_held.
