(* Lists of reals as vectors; a symmetric matrix is the list of the rows of its upper triangle. *)
From Coq Require Import Reals List Lra Lia.
Import ListNotations.
Open Scope R_scope.

Fixpoint zip {A B C : Type} (f : A -> B -> C) (a : list A) (b : list B) : list C :=
  match a, b with x :: a', y :: b' => f x y :: zip f a' b' | _, _ => [] end.

Fixpoint dot (a b : list R) : R :=
  match a, b with x :: a', y :: b' => x * y + dot a' b' | _, _ => 0 end.

(* y'M z *)
Fixpoint form (M : list (list R)) (y z : list R) : R :=
  match M, y, z with
  | (a :: b) :: M', y0 :: y', z0 :: z' =>
      y0 * (a * z0 + dot b z') + z0 * dot b y' + form M' y' z'
  | _, _, _ => 0
  end.

(* Rows of lengths k, k - 1, ..., 1. *)
Fixpoint triangular {A : Type} (k : nat) (M : list (list A)) : Prop :=
  match k, M with
  | O, [] => True
  | S j, row :: M' => length row = k /\ triangular j M'
  | _, _ => False
  end.

Lemma zip_length {A B C} (f : A -> B -> C) a : forall b, length a = length b ->
  length (zip f a b) = length a.
Proof. induction a; intros [|y b]; cbn; intros; try discriminate; auto. Qed.

Lemma dot_nil_r a : dot a [] = 0.
Proof. now destruct a. Qed.

Lemma form_symmetric M : forall y z, form M y z = form M z y.
Proof.
  induction M as [|[|a b] M IH]; intros [|y0 y] [|z0 z]; cbn; auto. rewrite (IH y z). ring.
Qed.

Fixpoint update {A : Type} (i : nat) (f : A -> A) (l : list A) : list A :=
  match l, i with
  | [], _ => []
  | a :: l', O => f a :: l'
  | a :: l', S j => a :: update j f l'
  end.
Lemma update_length {A} (f : A -> A) l : forall i, length (update i f l) = length l.
Proof. induction l as [|a l IH]; intros [|i]; cbn; auto. Qed.

Lemma dot_plus b : forall y d, length y = length d ->
  dot b (zip Rplus y d) = dot b y + dot b d.
Proof.
  induction b as [|b0 b IH]; intros [|y0 y] [|d0 d] H; try discriminate; cbn; try ring.
  rewrite IH by (now injection H). ring.
Qed.
Lemma form_plus M : forall y d w, length y = length d ->
  form M (zip Rplus y d) w = form M y w + form M d w.
Proof.
  induction M as [|[|a b] M IH]; intros [|y0 y] [|d0 d] [|w0 w] H; try discriminate; cbn; try ring.
  rewrite IH, dot_plus by (now injection H). ring.
Qed.
Lemma dot_scaled_r c a : forall b, dot a (map (fun v => v * c) b) = dot a b * c.
Proof. induction a as [|y a IH]; intros [|z b]; cbn; try ring. rewrite IH. ring. Qed.
Lemma form_scaled_r c M : forall y z, form M y (map (fun v => v * c) z) = form M y z * c.
Proof.
  induction M as [|[|a b] M IH]; intros [|y0 y] [|z0 z]; cbn; try ring.
  rewrite IH, !dot_scaled_r. ring.
Qed.
