(* Exact polynomials in s and x over one denominator. A coefficient is a polynomial in s, in scaled
   Bernstein form: [a_0; ...; a_d] stands for the sum of a_k s^k (1 - s)^(d - k). So products are
   convolutions, and what has no negative entry is nonnegative for s in [0, 1]. A monomial of x is
   the list of its variables, with repetitions. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers.
Import ListNotations.
Open Scope R_scope.

Notation mono := (list positive).
Notation bern := (list I).

Fixpoint mmul (a : mono) : mono -> mono :=
  fix go (b : mono) : mono :=
    match a, b with
    | [], _ => b
    | _, [] => a
    | i :: a', j :: b' => if Pos.leb i j then i :: mmul a' b else j :: go b'
    end.

(* By total degree, and within a degree lexicographically: an order that products keep. *)
Fixpoint mcompare_after (d : comparison) (a b : mono) : comparison :=
  match a, b with
  | [], [] => d
  | [], _ => Lt
  | _, [] => Gt
  | i :: a', j :: b' =>
      mcompare_after (match d with Eq => Pos.compare i j | _ => d end) a' b'
  end.
Definition mcompare := mcompare_after Eq.

Lemma mcompare_after_eq a : forall d b, mcompare_after d a b = Eq -> d = Eq /\ a = b.
Proof.
  induction a as [|i a IH]; intros d [|j b]; cbn; try discriminate; auto.
  intros H. apply IH in H as [H ->]. destruct d; try discriminate.
  apply Pos.compare_eq in H as ->. auto.
Qed.
Lemma mcompare_eq a b : mcompare a b = Eq -> a = b.
Proof. intros H. now apply mcompare_after_eq in H. Qed.

(* Sorted lists of monomials with something each, merged. *)
Section Merge.
Context {A : Type} (both : A -> A -> A).
Fixpoint merge (p : list (mono * A)) : list (mono * A) -> list (mono * A) :=
  fix go (q : list (mono * A)) : list (mono * A) :=
    match p, q with
    | [], _ => q
    | _, [] => p
    | (m, a) :: p', (k, b) :: q' =>
        match mcompare m k with
        | Eq => (m, both a b) :: merge p' q'
        | Lt => (m, a) :: merge p' q
        | Gt => (k, b) :: go q'
        end
    end.
Fixpoint push (p : list (mono * A)) (stack : list (option (list (mono * A)))) :=
  match stack with
  | [] => [Some p]
  | None :: rest => Some p :: rest
  | Some q :: rest => None :: push (merge q p) rest
  end.
Definition flatten (stack : list (option (list (mono * A)))) :=
  fold_right (fun e older => match e with Some p => merge older p | None => older end) [] stack.
Definition sorted (l : list (mono * A)) :=
  flatten (fold_left (fun stack term => push [term] stack) l []).

Variable P : mono * A -> Prop.
Hypothesis P_both : forall m a b, P (m, a) -> P (m, b) -> P (m, both a b).
Lemma merge_all p : forall q, Forall P p -> Forall P q -> Forall P (merge p q).
Proof.
  induction p as [|[m a] p IH]; intros q Hp Hq.
  - destruct q; auto.
  - induction q as [|[k b] q IHq]; cbn; auto.
    inversion Hp; inversion Hq; subst.
    destruct (mcompare m k) eqn:E.
    + apply mcompare_eq in E as ->. constructor; auto.
    + constructor; auto.
    + constructor; auto.
Qed.
Definition fine e := match e with Some p => Forall P p | None => True end.
Lemma push_all st : forall p, Forall P p -> Forall fine st -> Forall fine (push p st).
Proof.
  induction st as [|[q|] st IH]; cbn; intros p Hp Hs; inversion Hs; subst; auto.
  constructor; cbn; auto. apply IH; auto. now apply merge_all.
Qed.
Lemma sorted_all l : Forall P l -> Forall P (sorted l).
Proof.
  intros H. unfold sorted.
  assert (G : forall st, Forall fine st ->
    Forall fine (fold_left (fun stack term => push [term] stack) l st)).
  { induction H; cbn; auto. intros st Hs. apply IHForall. apply push_all; auto. }
  specialize (G [] (Forall_nil _)). induction G as [|[p|] st]; cbn; auto.
  now apply merge_all.
Qed.

Variable value : mono -> A -> R.
Hypothesis value_both : forall m a b, value m (both a b) = value m a + value m b.
Fixpoint sum_of (p : list (mono * A)) : R :=
  match p with [] => 0 | (m, a) :: p' => value m a + sum_of p' end.
Lemma merge_sum p : forall q, sum_of (merge p q) = sum_of p + sum_of q.
Proof.
  induction p as [|[m a] p IH]; intros q. { destruct q; cbn; ring. }
  induction q as [|[k b] q IHq]. { cbn; ring. }
  cbn [merge]. destruct (mcompare m k) eqn:E.
  - apply mcompare_eq in E as ->. cbn. rewrite IH, value_both. ring.
  - cbn [sum_of]. rewrite IH. cbn. ring.
  - change (value k b + sum_of (merge ((m, a) :: p) q)
      = sum_of ((m, a) :: p) + sum_of ((k, b) :: q)).
    rewrite IHq. cbn. ring.
Qed.
Lemma sorted_sum l : sum_of (sorted l) = sum_of l.
Proof.
  unfold sorted. pose (sv := fix sv st := match st with
    | [] => 0 | Some p :: st' => sum_of p + sv st' | None :: st' => sv st' end).
  assert (Hpush : forall st p, sv (push p st) = sum_of p + sv st).
  { induction st as [|[q|] st IH]; intros p; cbn; try ring.
    rewrite IH, merge_sum. ring. }
  assert (Hfold : forall l st,
    sv (fold_left (fun stack term => push [term] stack) l st) = sum_of l + sv st).
  { clear l. induction l as [|[m a] l IH]; intros st; cbn [fold_left]. { cbn; ring. }
    rewrite IH, Hpush. cbn. ring. }
  assert (Hflat : forall st, sum_of (flatten st) = sv st).
  { induction st as [|[q|] st IH]; [reflexivity| |exact IH].
    change (sum_of (merge (flatten st) q) = sum_of q + sv st). rewrite merge_sum, IH. ring. }
  rewrite Hflat, Hfold. cbn. ring.
Qed.
End Merge.

Section Polynomials.
Context {K : Ints}.

(* Scaled Bernstein form. *)
Fixpoint add_low (a b : bern) : bern :=
  match a, b with
  | [], _ => b
  | _, [] => a
  | x :: a', y :: b' => iadd x y :: add_low a' b'
  end.
Definition raised (a : bern) : bern := add_low a (izero :: a).
Fixpoint raise (n : nat) (a : bern) : bern := match n with O => a | S k => raise k (raised a) end.
Definition badd (a b : bern) : bern :=
  let la := length a in
  let lb := length b in
  add_low (raise (lb - la) a) (raise (la - lb) b).
Definition bscale (c : I) (a : bern) : bern := map (imul c) a.
Fixpoint bmul_to (a b : bern) : bern :=
  match a with
  | [] => []
  | [x] => bscale x b
  | x :: a' => add_low (bscale x b) (izero :: bmul_to a' b)
  end.
Definition bmul (a b : bern) : bern := match b with [] => [] | _ => bmul_to a b end.
Definition babs (a : bern) : bern := map iabs a.
Definition bopp (a : bern) : bern := map iopp a.

Definition poly := list (mono * bern).
Definition padd : poly -> poly -> poly := merge badd.
Definition pterm (m : mono) (a : bern) (q : poly) : poly :=
  map (fun t => (mmul m (fst t), bmul a (snd t))) q.
Fixpoint pmul (p q : poly) : poly :=
  match p with [] => [] | (m, a) :: p' => padd (pterm m a q) (pmul p' q) end.
Definition pscale (c : I) (p : poly) : poly := map (fun t => (fst t, bscale c (snd t))) p.

(* Over one denominator; [order] bounds the degree in s. *)
Record F := Frac { num : poly; den : I; order : nat }.
Definition scale_by (c : I) (p : poly) : poly := if ieqb c ione then p else pscale c p.
Definition fadd (p q : F) : F :=
  let a := den p in
  let b := den q in
  let o := Nat.max (order p) (order q) in
  if ieqb a b then Frac (padd (num p) (num q)) a o else
  let g := igcd a b in
  let a' := iquot a g in
  let b' := iquot b g in
  let common := imul a b' in
  if andb (ieqb common (imul b a')) (ipos common)
  then Frac (padd (scale_by b' (num p)) (scale_by a' (num q))) common o
  else Frac (padd (pscale b (num p)) (pscale a (num q))) (imul a b) o.
(* the shorter one first: it is gone through term by term *)
Definition pmul_best (p q : poly) : poly :=
  if Nat.leb (length p) (length q) then pmul p q else pmul q p.
Definition fmul (p q : F) : F :=
  Frac (pmul_best (num p) (num q)) (imul (den p) (den q)) (order p + order q).
Definition fconst (z : Z) (d : positive) : F :=
  Frac (if Z.eqb z 0 then [] else [([], [ofZ z])]) (ofZ (Zpos d)) 0.
Definition fone := fconst 1 1.
Definition fvar (i : positive) : F := Frac [([i], [ione])] ione 0.
Definition fscale (z : Z) (p : F) : F := Frac (pscale (ofZ z) (num p)) (den p) (order p).
Definition fsub (p q : F) : F := fadd p (fscale (-1) q).
Definition fsum (l : list F) : F := fold_right fadd (fconst 0 1) l.
Fixpoint fdot (a b : list F) : F :=
  match a, b with
  | x :: a', y :: b' => fadd (fmul x y) (fdot a' b')
  | _, _ => fconst 0 1
  end.

(* Meaning, at one s and one x. *)
Section At.
Variables (s : R) (x : positive -> R).

Fixpoint bval (l : bern) : R :=
  match l with [] => 0 | a :: l' => r a * (1 - s) ^ length l' + s * bval l' end.
Fixpoint mval (m : mono) : R := match m with [] => 1 | i :: m' => x i * mval m' end.
Fixpoint pval (p : poly) : R :=
  match p with [] => 0 | (m, a) :: p' => bval a * mval m + pval p' end.
Definition means (p : F) (v : R) : Prop := 0 < r (den p) /\ pval (num p) = v * r (den p).

Lemma add_low_val a : forall b, (length a <= length b)%nat ->
  length (add_low a b) = length b /\
  bval (add_low a b) = bval a * (1 - s) ^ (length b - length a) + bval b.
Proof.
  induction a as [|y a IH]; intros [|z b] H; cbn in *; try lia; try (split; [reflexivity|ring]).
  apply le_S_n in H. destruct (IH b H) as [L V].
  split. now rewrite L. rewrite L, V, r_add.
  replace (length b) with (length b - length a + length a)%nat at 1 by lia.
  replace ((1 - s) ^ length b) with ((1 - s) ^ (length b - length a) * (1 - s) ^ length a)
    by (rewrite <- pow_add; f_equal; lia).
  rewrite pow_add. ring.
Qed.
Lemma raised_val a : length (raised a) = S (length a) /\ bval (raised a) = bval a.
Proof.
  unfold raised. destruct (add_low_val a (izero :: a)) as [L V]. cbn; lia.
  split. exact L. rewrite V. cbn [length bval]. rewrite r_zero.
  replace (S (length a) - length a)%nat with 1%nat by lia. ring.
Qed.
Lemma raise_val n : forall a,
  length (raise n a) = (n + length a)%nat /\ bval (raise n a) = bval a.
Proof.
  induction n as [|n IH]; intros a; cbn; auto.
  destruct (raised_val a) as [L V]. destruct (IH (raised a)) as [L' V'].
  rewrite L', V', L, V. split; auto; lia.
Qed.
Lemma badd_val a b : bval (badd a b) = bval a + bval b.
Proof.
  unfold badd.
  destruct (raise_val (length b - length a) a) as [La Va].
  destruct (raise_val (length a - length b) b) as [Lb Vb].
  edestruct add_low_val as [_ ->]. { rewrite La, Lb. lia. }
  rewrite Va, Vb, La, Lb.
  replace (_ - _)%nat with 0%nat by lia. cbn. ring.
Qed.
Lemma bscale_val c a : bval (bscale c a) = r c * bval a.
Proof.
  induction a as [|y a IH]; cbn. ring.
  fold (bscale c a). rewrite IH, r_mul. unfold bscale. rewrite map_length. ring.
Qed.
Lemma bmul_to_val a b : b <> [] ->
  (a <> [] -> length (bmul_to a b) = pred (length a + length b)) /\
  bval (bmul_to a b) = bval a * bval b.
Proof.
  intros Hb. assert (0 < length b)%nat by (destruct b; cbn; [congruence|lia]).
  induction a as [|y a [L V]]; cbn [bmul_to].
  { cbn. split; [congruence|ring]. }
  destruct a as [|z a].
  { rewrite bscale_val. unfold bscale. rewrite map_length. cbn. split; intros; [lia|ring]. }
  specialize (L ltac:(discriminate)).
  assert (LL : length (bscale y b) = length b) by apply map_length.
  edestruct (add_low_val (bscale y b) (izero :: bmul_to (z :: a) b)) as [L' V'].
  { rewrite LL. cbn [length] in *. rewrite L. cbn. lia. }
  split. { intros _. rewrite L'. cbn [length] in *. rewrite L. cbn. lia. }
  rewrite V', bscale_val, LL.
  replace (length (izero :: bmul_to (z :: a) b) - length b)%nat with (length (z :: a))
    by (cbn [length] in *; lia).
  change (bval (izero :: bmul_to (z :: a) b))
    with (r izero * (1 - s) ^ length (bmul_to (z :: a) b) + s * bval (bmul_to (z :: a) b)).
  rewrite V, r_zero. change (bval (y :: z :: a))
    with (r y * (1 - s) ^ length (z :: a) + s * bval (z :: a)). ring.
Qed.
Lemma bmul_val a b : bval (bmul a b) = bval a * bval b.
Proof. destruct b; [cbn; ring|]. now apply bmul_to_val. Qed.
Lemma mmul_val a : forall b, mval (mmul a b) = mval a * mval b.
Proof.
  induction a as [|i a IH]; intros b. { destruct b; cbn; ring. }
  induction b as [|j b IHb]. { cbn; ring. }
  cbn [mmul]. destruct (Pos.leb i j).
  - change (x i * mval (mmul a (j :: b)) = mval (i :: a) * mval (j :: b)).
    rewrite IH. cbn. ring.
  - change (x j * mval (mmul (i :: a) b) = mval (i :: a) * mval (j :: b)).
    rewrite IHb. cbn. ring.
Qed.
Lemma pval_sum p : pval p = sum_of (fun m a => bval a * mval m) p.
Proof. induction p as [|[m a] p IH]; cbn; [|rewrite IH]; reflexivity. Qed.
Lemma both_val m a b : bval (badd a b) * mval m = bval a * mval m + bval b * mval m.
Proof. rewrite badd_val. ring. Qed.
Lemma padd_val p q : pval (padd p q) = pval p + pval q.
Proof. rewrite !pval_sum. apply merge_sum, both_val. Qed.
Lemma sorted_val l : pval (sorted badd l) = pval l.
Proof. rewrite !pval_sum. apply sorted_sum, both_val. Qed.
Lemma pterm_val m a q : pval (pterm m a q) = bval a * mval m * pval q.
Proof.
  induction q as [|[k b] q IH]. { cbn; ring. }
  change (bval (bmul a b) * mval (mmul m k) + pval (pterm m a q)
    = bval a * mval m * pval ((k, b) :: q)).
  rewrite IH, bmul_val, mmul_val. cbn. ring.
Qed.
Lemma pmul_val p q : pval (pmul p q) = pval p * pval q.
Proof.
  induction p as [|[m a] p IH]; cbn. ring. rewrite padd_val, pterm_val, IH. ring.
Qed.
Lemma pmul_best_val p q : pval (pmul_best p q) = pval p * pval q.
Proof. unfold pmul_best. destruct (Nat.leb _ _); rewrite pmul_val; ring. Qed.
Lemma pscale_val c p : pval (pscale c p) = r c * pval p.
Proof.
  induction p as [|[m a] p IH]. { cbn; ring. }
  change (bval (bscale c a) * mval m + pval (pscale c p) = r c * pval ((m, a) :: p)).
  rewrite IH, bscale_val. cbn. ring.
Qed.
Lemma scale_by_val c p : pval (scale_by c p) = r c * pval p.
Proof.
  unfold scale_by. destruct (ieqb c ione) eqn:E.
  - apply r_eqb in E. rewrite E, r_one. ring.
  - apply pscale_val.
Qed.

Lemma means_add p q v w : means p v -> means q w -> means (fadd p q) (v + w).
Proof.
  unfold means, fadd. intros [Dp Vp] [Dq Vq].
  destruct (ieqb (den p) (den q)) eqn:E.
  { cbn. apply r_eqb in E. rewrite padd_val, Vp, Vq, <- E. split; auto; ring. }
  set (a' := iquot (den p) _). set (b' := iquot (den q) _).
  destruct (andb _ _) eqn:G; cbn.
  - apply andb_prop in G as [G1 G2]. apply r_eqb in G1. apply r_pos in G2. split; auto.
    rewrite padd_val, !scale_by_val, Vp, Vq. rewrite r_mul in G1, G2. rewrite !r_mul in *.
    replace (r a' * (w * r (den q))) with (w * (r (den q) * r a')) by ring.
    rewrite <- G1. ring.
  - rewrite r_mul. split. now apply Rmult_lt_0_compat.
    rewrite padd_val, !pscale_val, Vp, Vq. ring.
Qed.
Lemma means_mul p q v w : means p v -> means q w -> means (fmul p q) (v * w).
Proof.
  unfold means, fmul. intros [Dp Vp] [Dq Vq]; cbn. rewrite r_mul. split.
  now apply Rmult_lt_0_compat. rewrite pmul_best_val, Vp, Vq. ring.
Qed.
Lemma means_const z d : means (fconst z d) (IZR z / IZR (Zpos d)).
Proof.
  assert (0 < IZR (Zpos d)) by now apply IZR_lt.
  unfold means, fconst; cbn. rewrite r_ofZ. split; auto.
  destruct (Z.eqb_spec z 0) as [->|]; cbn. unfold Rdiv; ring. rewrite r_ofZ. field. lra.
Qed.
Lemma means_whole z : means (fconst z 1) (IZR z).
Proof. replace (IZR z) with (IZR z / 1) by field. apply means_const. Qed.
Lemma means_one : means fone 1.
Proof. apply means_whole. Qed.
Lemma means_var i : means (fvar i) (x i).
Proof. unfold means; cbn. rewrite r_one. split; [lra|ring]. Qed.
Lemma means_scale z p v : means p v -> means (fscale z p) (IZR z * v).
Proof.
  unfold means; cbn. intros [D V]. split; auto. rewrite pscale_val, r_ofZ, V. ring.
Qed.
Lemma means_sub p q v w : means p v -> means q w -> means (fsub p q) (v - w).
Proof.
  intros Hp Hq. replace (v - w) with (v + -1 * w) by ring. apply means_add; auto.
  now apply means_scale.
Qed.
Lemma means_equal p v w : means p v -> v = w -> means p w.
Proof. now intros H <-. Qed.
End At.
End Polynomials.
