(* Whole numbers to compute with. The checkers are written once for any such type: BigZ inside Coq
   (machine words, vm_compute), Z for extraction (zarith). [quot] and [gcd] only propose: what they
   give is used after it was checked. *)
From Coq Require Import ZArith Reals.
From Bignums Require Import BigZ.

Class Ints := {
  I : Type;
  toZ : I -> Z;
  ofZ : Z -> I;
  iadd : I -> I -> I;
  imul : I -> I -> I;
  iopp : I -> I;
  iquot : I -> I -> I;
  igcd : I -> I -> I;
  ileb : I -> I -> bool;
  ieqb : I -> I -> bool;
  toZ_ofZ : forall z, toZ (ofZ z) = z;
  toZ_add : forall a b, toZ (iadd a b) = (toZ a + toZ b)%Z;
  toZ_mul : forall a b, toZ (imul a b) = (toZ a * toZ b)%Z;
  toZ_opp : forall a, toZ (iopp a) = (- toZ a)%Z;
  toZ_leb : forall a b, ileb a b = (toZ a <=? toZ b)%Z;
  toZ_eqb : forall a b, ieqb a b = (toZ a =? toZ b)%Z }.

Definition big : Ints := {|
  toZ := BigZ.to_Z; ofZ := BigZ.of_Z; iadd := BigZ.add; imul := BigZ.mul; iopp := BigZ.opp;
  iquot := BigZ.div; igcd := BigZ.gcd; ileb := BigZ.leb; ieqb := BigZ.eqb;
  toZ_ofZ := BigZ.spec_of_Z; toZ_add := BigZ.spec_add; toZ_mul := BigZ.spec_mul;
  toZ_opp := BigZ.spec_opp; toZ_leb := BigZ.spec_leb; toZ_eqb := BigZ.spec_eqb |}.

Definition plain : Ints := {|
  toZ := fun z => z; ofZ := fun z => z; iadd := Z.add; imul := Z.mul; iopp := Z.opp;
  iquot := Z.div; igcd := Z.gcd; ileb := Z.leb; ieqb := Z.eqb;
  toZ_ofZ := fun _ => eq_refl; toZ_add := fun _ _ => eq_refl; toZ_mul := fun _ _ => eq_refl;
  toZ_opp := fun _ => eq_refl; toZ_leb := fun _ _ => eq_refl; toZ_eqb := fun _ _ => eq_refl |}.

Open Scope R_scope.

Section Meaning.
Context {K : Ints}.

Definition izero := ofZ 0.
Definition ione := ofZ 1.
Definition itwo := ofZ 2.
Definition isub a b := iadd a (iopp b).
Definition ipos a := negb (ileb a izero).
Definition inonneg a := ileb izero a.
Definition iabs a := if inonneg a then a else iopp a.
Definition itwo_to (n : Z) := ofZ (2 ^ n).

Definition r (a : I) : R := IZR (toZ a).

Lemma r_ofZ z : r (ofZ z) = IZR z.
Proof. unfold r. now rewrite toZ_ofZ. Qed.
Lemma r_zero : r izero = 0.
Proof. apply r_ofZ. Qed.
Lemma r_one : r ione = 1.
Proof. apply r_ofZ. Qed.
Lemma r_two : r itwo = 2.
Proof. apply r_ofZ. Qed.
Lemma r_add a b : r (iadd a b) = r a + r b.
Proof. unfold r. now rewrite toZ_add, plus_IZR. Qed.
Lemma r_mul a b : r (imul a b) = r a * r b.
Proof. unfold r. now rewrite toZ_mul, mult_IZR. Qed.
Lemma r_opp a : r (iopp a) = - r a.
Proof. unfold r. now rewrite toZ_opp, opp_IZR. Qed.
Lemma r_sub a b : r (isub a b) = r a - r b.
Proof. unfold isub. rewrite r_add, r_opp. ring. Qed.
Lemma r_nonneg a : inonneg a = true -> 0 <= r a.
Proof.
  unfold inonneg, r. rewrite toZ_leb. unfold izero. rewrite toZ_ofZ.
  intros H. apply Z.leb_le in H. now apply IZR_le.
Qed.
Lemma r_negative a : inonneg a = false -> r a <= 0.
Proof.
  unfold inonneg, r. rewrite toZ_leb. unfold izero. rewrite toZ_ofZ.
  intros H. apply Z.leb_gt in H. apply Z.lt_le_incl in H. now apply (IZR_le _ 0).
Qed.
Lemma r_pos a : ipos a = true -> 0 < r a.
Proof.
  unfold ipos, r. rewrite toZ_leb. unfold izero. rewrite toZ_ofZ.
  intros H. apply Bool.negb_true_iff, Z.leb_gt in H. now apply (IZR_lt 0).
Qed.
Lemma r_eqb a b : ieqb a b = true -> r a = r b.
Proof. rewrite toZ_eqb. intros H. apply Z.eqb_eq in H. unfold r. now rewrite H. Qed.
Lemma r_abs a : Rabs (r a) <= r (iabs a).
Proof.
  unfold iabs. destruct (inonneg a) eqn:H.
  - rewrite Rabs_right; auto with real. apply Rle_ge. now apply r_nonneg.
  - rewrite r_opp, Rabs_left1; auto with real. now apply r_negative.
Qed.
End Meaning.
