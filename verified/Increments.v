(* How two solutions of a model differ, and quadratic forms of that: what is decided, and why. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Claim Definite Goal Funnel Tubes.
Import ListNotations.
Open Scope R_scope.

(* Linear forms of z by their coefficients; a sum of products of two of them as a matrix. *)
Fixpoint vadd (a b : list num) : list num :=
  match a, b with [], _ => b | _, [] => a | x :: a', y :: b' => nadd x y :: vadd a' b' end.
Definition vscale (c : num) (a : list num) : list num := map (nmul c) a.
Fixpoint combination (a : list num) (rows : list (list num)) : list num :=
  match a, rows with
  | c :: a', row :: rest => vadd (vscale c row) (combination a' rest)
  | _, _ => []
  end.
Fixpoint outer (a b : list num) : list (list num) :=
  match a, b with
  | x :: a', y :: b' =>
      (nmul (2%Z, xH) (nmul x y) :: vadd (vscale x b') (vscale y a')) :: outer a' b'
  | _, _ => []
  end.
Fixpoint madd (A B : matrix) : matrix :=
  match A, B with [], _ => B | _, [] => A | a :: A', b :: B' => vadd a b :: madd A' B' end.
Definition pairs := list (list num * list num).
Definition triangle (ps : pairs) : matrix :=
  fold_right (fun p acc => madd (outer (fst p) (snd p)) acc) [] ps.
Fixpoint total (ps : pairs) (z : list R) : R :=
  match ps with
  | [] => 0
  | (a, b) :: rest => dot (map val a) z * dot (map val b) z + total rest z
  end.

Lemma dot_vadd a : forall b z, dot (map val (vadd a b)) z = dot (map val a) z + dot (map val b) z.
Proof.
  induction a as [|x a IH]; intros [|y b] [|w z]; cbn [vadd map dot]; try ring.
  rewrite val_add, IH. ring.
Qed.
Lemma dot_vscale c a : forall z, dot (map val (vscale c a)) z = val c * dot (map val a) z.
Proof.
  induction a as [|x a IH]; intros [|w z]; cbn [vscale map dot]; try ring.
  unfold vscale in IH. rewrite val_mul, IH. ring.
Qed.
Definition at_ (rows : matrix) (z : list R) : list R := image (vals rows) z.
Lemma dot_combination a : forall rows z,
  dot (map val (combination a rows)) z = dot (map val a) (at_ rows z).
Proof.
  induction a as [|c a IH]; intros [|row rows] z; cbn [combination map dot at_ vals image]; auto.
  rewrite dot_vadd, dot_vscale, IH. reflexivity.
Qed.
Lemma form_outer a : forall b z,
  form (vals (outer a b)) z z = 2 * (dot (map val a) z * dot (map val b) z).
Proof.
  induction a as [|x a IH]; intros [|y b] [|w z]; cbn [outer vals map form dot]; try ring.
  fold (vals (outer a b)). rewrite IH, dot_vadd, !dot_vscale, !val_mul.
  replace (val (2%Z, 1%positive)) with 2 by (unfold val; cbn; field). ring.
Qed.
Definition filled (M : matrix) : Prop := Forall (fun row => row <> []) M.
Lemma filled_outer a : forall b, filled (outer a b).
Proof. induction a as [|x a IH]; intros [|y b]; cbn; constructor; [discriminate|apply IH]. Qed.
Lemma filled_madd A : forall B, filled A -> filled B -> filled (madd A B).
Proof.
  induction A as [|a A IH]; intros [|b B] HA HB; cbn; auto.
  inversion HA; inversion HB; subst. constructor; [|now apply IH].
  destruct a; [easy|]. destruct b; discriminate.
Qed.
Lemma form_madd A : forall B z, filled A -> filled B ->
  form (vals (madd A B)) z z = form (vals A) z z + form (vals B) z z.
Proof.
  induction A as [|a A IH]; intros [|b B] [|w z] HA HB; cbn [madd vals map form]; try ring;
    inversion HA; inversion HB; subst; destruct a as [|a0 a]; try easy;
    destruct b as [|b0 b]; try easy; cbn [vadd map form]; try ring.
  fold (vals (madd A B)). rewrite IH, val_add, dot_vadd by auto. unfold vals. ring.
Qed.
Lemma form_triangle ps z : form (vals (triangle ps)) z z = 2 * total ps z.
Proof.
  assert (G : filled (triangle ps) /\ form (vals (triangle ps)) z z = 2 * total ps z).
  { induction ps as [|[a b] ps [F IH]]; cbn [triangle fold_right total]; [split; [constructor|cbn; ring]|].
    fold (triangle ps). cbn [fst snd]. split.
    - apply filled_madd; auto. apply filled_outer.
    - rewrite form_madd, form_outer, IH; auto; [ring|apply filled_outer]. }
  apply G.
Qed.
Lemma total_app a b z : total (a ++ b) z = total a z + total b z.
Proof. induction a as [|[p q] a IH]; cbn; [ring|]. rewrite IH. ring. Qed.
Lemma total_zip {A B} (f : A -> list num) (g : B -> list num) z : forall a b,
  total (zip (fun x y => (f x, g y)) a b) z =
    dot (map (fun x => dot (map val (f x)) z) a) (map (fun y => dot (map val (g y)) z) b).
Proof. induction a as [|x a IH]; intros [|y b]; cbn; auto. now rewrite IH. Qed.

(* Unit rows. *)
Fixpoint units (k : nat) : matrix :=
  match k with O => [] | S j => (none :: repeat nzero j) :: map (cons nzero) (units j) end.
Definition pad (k : nat) (row : list num) : list num := repeat nzero k ++ row.
Lemma dot_zeros k : forall z, dot (map val (repeat nzero k)) z = 0.
Proof. induction k; intros [|w z]; cbn; auto. rewrite IHk, val_nzero. ring. Qed.
Lemma at_cons M : forall w z, at_ (map (cons nzero) M) (w :: z) = at_ M z.
Proof.
  intros w z. unfold at_, image, vals. rewrite !map_map. apply map_ext. intros row. cbn.
  rewrite val_nzero. ring.
Qed.
Lemma at_units z : forall k, length z = k -> at_ (units k) z = z.
Proof.
  induction z as [|w z IH]; intros k <-; [reflexivity|]. cbn [length units].
  change (at_ ((none :: repeat nzero (length z)) :: map (cons nzero) (units (length z))) (w :: z))
    with (dot (map val (none :: repeat nzero (length z))) (w :: z)
            :: at_ (map (cons nzero) (units (length z))) (w :: z)).
  rewrite at_cons, IH by auto. f_equal. cbn [map dot]. rewrite dot_zeros, val_none. ring.
Qed.
Lemma dot_pad pre row z : dot (map val (pad (length pre) row)) (pre ++ z) = dot (map val row) z.
Proof.
  unfold pad. rewrite map_app. rewrite dot_app by now rewrite map_length, repeat_length.
  rewrite dot_zeros. ring.
Qed.
Lemma dot_short a : forall z post, length a = length z -> dot a (z ++ post) = dot a z.
Proof.
  induction a as [|x a IH]; intros [|w z] post H; try discriminate; cbn; auto.
  rewrite IH; auto.
Qed.
Definition shaped (r c : nat) (M : matrix) : bool :=
  andb (Nat.eqb (length M) r) (forallb (fun row => Nat.eqb (length row) c) M).
Lemma shaped_is r c M : shaped r c M = true ->
  length M = r /\ forall row, In row M -> length row = c.
Proof.
  unfold shaped. intros H. apply andb_prop in H as [A B]. apply Nat.eqb_eq in A. split; auto.
  intros row Hr. rewrite forallb_forall in B. now apply Nat.eqb_eq, B.
Qed.
Lemma at_short r c M z post : shaped r c M = true -> length z = c -> at_ M (z ++ post) = at_ M z.
Proof.
  intros H Hz. apply shaped_is in H as [_ H]. unfold at_, image, vals. rewrite !map_map.
  apply map_ext_in. intros row Hr. apply dot_short. rewrite map_length, Hz. now apply H.
Qed.
Lemma at_length M z : length (at_ M z) = length M.
Proof. unfold at_, image, vals. now rewrite !map_length. Qed.

(* x'Mx of a block x of z = pre ++ x ++ post *)
Definition block (k : nat) (scale : num) (M : matrix) : pairs :=
  zip (fun u row => (pad k u, pad k (vscale scale row))) (units (length M)) M.
Lemma total_block pre x post c M : shaped (length x) (length x) M = true ->
  total (block (length pre) c M) (pre ++ x ++ post) = val c * V M x.
Proof.
  intros H. destruct (shaped_is _ _ _ H) as [Hl _]. unfold block.
  rewrite (total_zip (pad (length pre)) (fun row => pad (length pre) (vscale c row))).
  transitivity (dot (at_ (units (length M)) (x ++ post)) (map (fun y => val c * y) (at_ M (x ++ post)))).
  { unfold at_, image, vals. rewrite !map_map. f_equal; apply map_ext; intros row.
    - apply dot_pad. - now rewrite dot_pad, dot_vscale. }
  assert (U : at_ (units (length M)) (x ++ post) = at_ (units (length M)) x).
  { rewrite Hl. clear. unfold at_, image, vals. rewrite !map_map. apply map_ext_in.
    intros row Hr. apply dot_short. rewrite map_length.
    assert (G : forall k row, In row (units k) -> length row = k).
    { clear. induction k as [|k IH]; intros row H; [destruct H|].
      destruct H as [<-|H]; cbn; [now rewrite repeat_length|].
      apply in_map_iff in H as [row' [<- H]]. cbn. now rewrite (IH row' H). }
    now apply G. }
  rewrite U, at_units, (at_short _ _ _ _ _ H) by auto. unfold V. fold (at_ M x). fold (vals M).
  fold (at_ M x). generalize (at_ M x). clear. induction x as [|a x IH]; intros [|b l]; cbn; try ring.
  rewrite IH. ring.
Qed.

(* What two solutions give: zeta = (nu, xbar), E zeta = 0 for an E in the hull of the vertices, or
   beyond it along a ray. *)
Definition settled (ray : bool) (vertices : list matrix) (zeta : list R) : Prop :=
  forall c q, (ray = true -> exists s, 0 <= s /\ q = [s * hd 0 zeta]) ->
  (forall E, In E vertices -> 0 <= c + dot q (at_ E zeta)) -> 0 <= c.

Section Decided.
Context {K : Ints}.

Definition multiplied (N E : matrix) : pairs :=
  zip (fun n row => (vscale (2%Z, xH) n, row)) N E.
Lemma total_multiplied N E z : total (multiplied N E) z =
  dot (map (fun n => 2 * dot (map val n) z) N) (at_ E z).
Proof.
  unfold multiplied. rewrite (total_zip (vscale (2%Z, xH)) (fun row => row)).
  unfold at_, image, vals. rewrite map_map. f_equal. apply map_ext. intros n.
  rewrite dot_vscale. f_equal. unfold val; cbn; field.
Qed.
(* N: columns. *)
Definition ray_ok (N : matrix) : bool :=
  match N with
  | [t :: rest] => andb (0 <=? fst t)%Z (forallb (fun a => Z.eqb (fst a) 0) rest)
  | _ => false
  end.
Definition positive_at (ray : bool) (k : nat) (base : pairs) (vertices : list matrix) (N : matrix)
  : bool :=
  andb (if ray then ray_ok N else true)
    (forallb (fun E => andb (shaped (length E) k E)
      (semidefinite true (triangle (base ++ multiplied N E)))) vertices).

Lemma val_nonneg a : (0 <= fst a)%Z -> 0 <= val a.
Proof.
  intros H. unfold val. apply Rmult_le_pos; [now apply IZR_le|].
  left. now apply Rinv_0_lt_compat, IZR_lt.
Qed.
Lemma positive_total ray k base vertices N zeta post : positive_at ray k base vertices N = true ->
  length zeta = k -> (ray = true -> zeta <> []) -> settled ray vertices zeta ->
  0 <= total base (zeta ++ post).
Proof.
  unfold positive_at. intros H Hk Hne Hs. apply andb_prop in H as [Hr H]. rewrite forallb_forall in H.
  apply (Hs _ (map (fun n => 2 * dot (map val n) (zeta ++ post)) N)).
  - intros ->. specialize (Hne eq_refl). destruct N as [|[|t rest] [|]]; try discriminate.
    cbn in Hr. apply andb_prop in Hr as [Ht Hz]. apply Z.leb_le, val_nonneg in Ht.
    destruct zeta as [|u zeta]; [easy|]. exists (2 * val t). split; [lra|]. cbn. f_equal.
    assert (Z0 : forall z, dot (map val rest) z = 0).
    { clear - Hz. induction rest as [|a rest IH]; intros [|b z]; cbn; auto. cbn in Hz.
      apply andb_prop in Hz as [A B]. apply Z.eqb_eq in A. rewrite IH by auto.
      unfold val. rewrite A. field. now apply Rgt_not_eq, IZR_lt. }
    rewrite Z0. ring.
  - intros E HE. specialize (H E HE). apply andb_prop in H as [Hsh H].
    pose proof (semidefinite_sound _ _ (zeta ++ post) H) as Q.
    rewrite form_triangle, total_app, total_multiplied, (at_short _ _ _ _ _ Hsh Hk) in Q. lra.
Qed.

(* The two inequalities. *)
Definition supply (m n : nat) (rho : num) (P W : matrix) : pairs :=
  block m rho P ++ block (m + n) none W.
Definition flow (F L P : matrix) : pairs :=
  let G := zip (@app num) F L in
  zip (fun g row => (g, vscale (nopp none) (combination row G))) G P.
Definition output (row unit : list num) (tau : num) : pairs :=
  [(row ++ unit, vscale (nopp tau) (row ++ unit))].

Lemma total_supply nu x e rho P W : shaped (length x) (length x) P = true ->
  shaped (length e) (length e) W = true ->
  total (supply (length nu) (length x) rho P W) ((nu ++ x) ++ e) = val rho * V P x + V W e.
Proof.
  intros HP HW. unfold supply. rewrite total_app. f_equal.
  - rewrite <- app_assoc. now apply total_block.
  - pose proof (total_block (nu ++ x) e [] none W HW) as B. rewrite app_nil_r, app_length in B.
    rewrite B, val_none. ring.
Qed.
Lemma at_beside F : forall L k zeta e, (forall row, In row F -> length row = k) -> length zeta = k ->
  length F = length L ->
  at_ (zip (@app num) F L) (zeta ++ e) = plus (at_ F zeta) (at_ L e).
Proof.
  induction F as [|f F IH]; intros [|l L] k zeta e HF Hz HL; try discriminate; [reflexivity|].
  change (dot (map val (f ++ l)) (zeta ++ e) :: at_ (zip (@app num) F L) (zeta ++ e)
    = dot (map val f) zeta + dot (map val l) e :: plus (at_ F zeta) (at_ L e)).
  rewrite (IH L k); auto; [|intros; apply HF; now right]. f_equal.
  rewrite map_app, dot_app; auto. rewrite map_length, Hz. apply HF. now left.
Qed.
Lemma total_flow F L P zeta e k n : shaped n k F = true -> length zeta = k -> length L = n ->
  total (flow F L P) (zeta ++ e) = - V P (plus (at_ F zeta) (at_ L e)).
Proof.
  intros HF Hz HL. apply shaped_is in HF as [HF1 HF2]. unfold flow.
  set (G := zip (@app num) F L).
  rewrite (total_zip (fun g => g) (fun row => vscale (nopp none) (combination row G))).
  assert (A : map (fun x => dot (map val x) (zeta ++ e)) G = at_ G (zeta ++ e)).
  { unfold at_, image, vals. now rewrite map_map. }
  rewrite A. unfold G at 1. rewrite (at_beside F L k) by (auto; congruence).
  set (a := plus _ _). unfold V. fold (vals P). fold (at_ P a).
  assert (B : map (fun y => dot (map val (vscale (nopp none) (combination y G))) (zeta ++ e)) P
    = map (fun y => - y) (at_ P a)).
  { unfold at_ at 1, image, vals. rewrite !map_map. apply map_ext. intros row.
    rewrite dot_vscale, dot_combination, val_opp, val_none. unfold G.
    rewrite (at_beside F L k) by (auto; congruence). fold a. ring. }
  rewrite B. generalize (at_ P a). clear. induction a as [|x a IH]; intros [|y l]; cbn; try ring.
  rewrite IH. ring.
Qed.
Lemma total_output row unit tau zeta e : length row = length zeta ->
  total (output row unit tau) (zeta ++ e) =
    - (val tau * (dot (map val row) zeta + dot (map val unit) e)
               * (dot (map val row) zeta + dot (map val unit) e)).
Proof.
  intros H. cbn [output total]. rewrite dot_vscale, val_opp, map_app, dot_app;
    [ring|now rewrite map_length].
Qed.
End Decided.
