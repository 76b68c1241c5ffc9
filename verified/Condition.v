(* The polynomial that has to be positive on a piece of time, built from the numbers of the files,
   and what it means in the reals. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials Claim Calculus.
Import ListNotations.
Open Scope R_scope.

(* Where a clipped input is. *)
Inductive side := Low | Free | High.
Fixpoint modes (limits : list (option (num * num))) : list (list side) :=
  match limits with
  | [] => [[]]
  | None :: l => map (cons Free) (modes l)
  | Some _ :: l => map (cons Low) (modes l) ++ map (cons Free) (modes l) ++ map (cons High) (modes l)
  end.
Fixpoint vertices (box : list (num * num)) : list (list num) :=
  match box with
  | [] => [[]]
  | (a, b) :: l => map (cons a) (vertices l) ++ map (cons b) (vertices l)
  end.

(* The input in a mode, and what is nonnegative where the mode holds. *)
Fixpoint applied (limits : list (option (num * num))) (mode : list side) (us : list R) : list R :=
  match limits, mode, us with
  | None :: l, _ :: m, u :: us' => u :: applied l m us'
  | Some (low, high) :: l, e :: m, u :: us' =>
      match e with Low => val low | Free => u | High => val high end :: applied l m us'
  | _, _, _ => []
  end.
Fixpoint held (limits : list (option (num * num))) (mode : list side) (us : list R) : list R :=
  match limits, mode, us with
  | None :: l, _ :: m, _ :: us' => held l m us'
  | Some (low, high) :: l, e :: m, u :: us' =>
      match e with
      | Low => val low - u
      | Free => (val high - u) * (u - val low)
      | High => u - val high
      end :: held l m us'
  | _, _, _ => []
  end.

(* What is off by delta; by nothing, if delta is empty. *)
Definition moved (delta us : list R) : list R :=
  match delta with [] => us | _ => zip Rplus us delta end.

(* h (dx/dt - dx0/dt), the slope of P, and dW/ds - drho/ds along the segment *)
Definition relative (g : segment) (s : R) (x u w : list R) : list R :=
  zip (fun f d => duration g * f - d) (field g (line s (time (start g)) (time (stop g))) x u w)
    (map (fun c => curve' (map val c) s) (nominal g)).
Definition P' (g : segment) : list (list R) :=
  zip (zip (fun a b => val b - val a)) (shape (start g)) (shape (stop g)).
Definition rho' (g : segment) : R := val (level (stop g)) - val (level (start g)).
Definition growth (g : segment) (s : R) (x u w : list R) : R :=
  let z := deviation g s x in
  form (P' g) z z + 2 * form (P g s) z (relative g s x u w) - rho' g.
(* [most]: what growth is at most *)
Definition condition (margin : num) (limits : list (option (num * num))) (mode : list side)
  (g : segment) (s : R) (x : list R) (most mu : R) (taus : list R) : R :=
  let z := deviation g s x in
  -1 * most - val margin * (duration g * rho g s)
    + mu * (rho g s - form (P g s) z z)
    - dot taus (held limits mode (wanted g s z)).
Section Condition.
Context {K : Ints}.

Definition fnum (a : num) : F := fconst (fst a) (snd a).
(* s and 1 - s on the part [index, index + 1] / 2^level *)
Definition fplace (depth index : Z) : F :=
  Frac [([], [ofZ index; ofZ (index + 1)])] (itwo_to depth) 1.
Definition fremaining (depth index : Z) : F :=
  Frac [([], [ofZ (2 ^ depth - index); ofZ (2 ^ depth - index - 1)])] (itwo_to depth) 1.
Definition fbernstein (s q : F) : list (list F) :=
  [ [fone];
    [q; s];
    [fmul q q; fscale 2 (fmul s q); fmul s s];
    [fmul q (fmul q q); fscale 3 (fmul s (fmul q q)); fscale 3 (fmul (fmul s s) q);
     fmul (fmul s s) s] ].
Definition fcurve (B : list (list F)) (p : list F) : F := fdot (nth (pred (length p)) B []) p.
Definition fdifferences (p : list F) : list F := zip (fun b a => fsub b a) (tl p) p.
Definition fcurve' (B : list (list F)) (p : list F) : F :=
  fscale (Z.of_nat (pred (length p))) (fcurve B (fdifferences p)).
Fixpoint fform (M : list (list F)) (y z : list F) : F :=
  match M, y, z with
  | (a :: b) :: M', y0 :: y', z0 :: z' =>
      fadd (fadd (fmul y0 (fadd (fmul a z0) (fdot b z'))) (fmul z0 (fdot b y'))) (fform M' y' z')
  | _, _, _ => fconst 0 1
  end.

Fixpoint fpows (v acc : F) (k : nat) : list F :=
  match k with O => [acc] | S j => acc :: fpows v (fmul v acc) j end.
Fixpoint fpow (v : F) (k : nat) : F := match k with O => fone | S j => fmul v (fpow v j) end.
Fixpoint fpower (e : list nat) (table : list (F * list F)) : F :=
  match e, table with
  | O :: e', _ :: rest => fpower e' rest
  | k :: e', (v, row) :: rest =>
      fmul (match nth_error row k with Some p => p | None => fpow v k end) (fpower e' rest)
  | _, _ => fone
  end.
Fixpoint frate (e : equation) (table : list (F * list F)) : F :=
  match e with
  | [] => fconst 0 1
  | (k, c) :: e' => fadd (fmul (fnum c) (fpower k table)) (frate e' table)
  end.
Fixpoint zip_max (a b : list nat) : list nat :=
  match a, b with [], _ => b | _, [] => a | x :: a', y :: b' => Nat.max x y :: zip_max a' b' end.
Definition highest (es : list equation) : list nat :=
  fold_right (fun e acc => fold_right (fun t acc => zip_max (fst t) acc) acc e) [] es.
Fixpoint ftable (vs : list F) (ks : list nat) : list (F * list F) :=
  match vs with
  | [] => []
  | v :: vs' => (v, fpows v fone (hd O ks)) :: ftable vs' (tl ks)
  end.

Definition fstate (n : nat) : list F := map (fun i => fvar (Pos.of_succ_nat i)) (seq 0 n).
Definition fdeviation (g : segment) : list F := fstate (length (nominal g)).
Definition fshape (B : list (list F)) (g : segment) : list (list F) :=
  zip (zip (fun a b => fcurve B [fnum a; fnum b])) (shape (start g)) (shape (stop g)).
Definition flevel (B : list (list F)) (g : segment) : F :=
  fcurve B [fnum (level (start g)); fnum (level (stop g))].
Definition fwanted (B : list (list F)) (g : segment) : list F :=
  zip (fun u row => fsub (fcurve B (map fnum u))
         (fdot (map (fun c => fcurve B (map fnum c)) row) (fdeviation g)))
    (feed g) (gains g).
Fixpoint fapplied (limits : list (option (num * num))) (mode : list side) (us : list F) : list F :=
  match limits, mode, us with
  | None :: l, _ :: m, u :: us' => u :: fapplied l m us'
  | Some (low, high) :: l, e :: m, u :: us' =>
      match e with Low => fnum low | Free => u | High => fnum high end :: fapplied l m us'
  | _, _, _ => []
  end.
Fixpoint fheld (limits : list (option (num * num))) (mode : list side) (us : list F) : list F :=
  match limits, mode, us with
  | None :: l, _ :: m, _ :: us' => fheld l m us'
  | Some (low, high) :: l, e :: m, u :: us' =>
      match e with
      | Low => fsub (fnum low) u
      | Free => fmul (fsub (fnum high) u) (fsub u (fnum low))
      | High => fsub u (fnum high)
      end :: fheld l m us'
  | _, _, _ => []
  end.

Definition fmoved (delta : list num) (us : list F) : list F :=
  match delta with [] => us | _ => zip fadd us (map fnum delta) end.

(* h (dx/dt - dx0/dt) *)
Definition frelative (limits : list (option (num * num))) (mode : list side)
  (delta vertex : list num) (g : segment) (depth index : Z) : list F :=
  let B := fbernstein (fplace depth index) (fremaining depth index) in
  let z := fdeviation g in
  let h := fsub (fnum (time (stop g))) (fnum (time (start g))) in
  let x := zip fadd (map (fun c => fcurve B (map fnum c)) (nominal g)) z in
  let us := fwanted B g in
  let t := fcurve B [fnum (time (start g)); fnum (time (stop g))] in
  let values := t :: x ++ fmoved delta (fapplied limits mode us) ++ map fnum vertex in
  let table := ftable values (highest (equations g)) in
  let f := map (fun e => frate e table) (equations g) in
  let dx0 := map (fun c => fcurve' B (map fnum c)) (nominal g) in
  zip (fun f d => fsub (fmul h f) d) f dx0.
Definition fduration (g : segment) : F := fsub (fnum (time (stop g))) (fnum (time (start g))).
Definition flevel' (g : segment) : F := fsub (fnum (level (stop g))) (fnum (level (start g))).
Definition fgrowth (limits : list (option (num * num))) (mode : list side)
  (delta vertex : list num) (g : segment) (depth index : Z) : F :=
  let B := fbernstein (fplace depth index) (fremaining depth index) in
  let z := fdeviation g in
  let P' := zip (zip (fun a b => fsub (fnum b) (fnum a))) (shape (start g)) (shape (stop g)) in
  let v := frelative limits mode delta vertex g depth index in
  fsub (fadd (fform P' z z) (fscale 2 (fform (fshape B g) z v))) (flevel' g).
Definition fcondition (margin : num) (limits : list (option (num * num))) (mode : list side)
  (g : segment) (depth index : Z) (most mu : F) (taus : list F) : F :=
  let B := fbernstein (fplace depth index) (fremaining depth index) in
  let z := fdeviation g in
  let rho := flevel B g in
  fsub
    (fadd
      (fsub (fscale (-1) most) (fmul (fnum margin) (fmul (fduration g) rho)))
      (fmul mu (fsub rho (fform (fshape B g) z z))))
    (fdot taus (fheld limits mode (fwanted B g))).
Section At.
Variables (s r : R) (z : list R) (depth index : Z).
Hypothesis Hdepth : (0 <= depth)%Z.
Hypothesis Hs : s * IZR (2 ^ depth) = IZR index + r.
Definition env (z : list R) (i : positive) : R := nth (pred (Pos.to_nat i)) z 0.
Notation means := (means r (env z)).
Notation B := (fbernstein (fplace depth index) (fremaining depth index)).

Lemma Forall2_zip {A A' B B' C C' : Type} (Q : A -> A' -> Prop) (S : B -> B' -> Prop)
  (T : C -> C' -> Prop) (f : A -> B -> C) (f' : A' -> B' -> C') l l' m m' :
  (forall a a' b b', Q a a' -> S b b' -> T (f a b) (f' a' b')) ->
  Forall2 Q l l' -> Forall2 S m m' -> Forall2 T (zip f l m) (zip f' l' m').
Proof.
  intros H Hl. revert m m'. induction Hl; intros m m' Hm; cbn; auto.
  destruct Hm; constructor; auto.
Qed.
Lemma Forall2_length {A A' : Type} (Q : A -> A' -> Prop) l l' : Forall2 Q l l' ->
  length l = length l'.
Proof. induction 1; cbn; auto. Qed.
Lemma Forall2_same {A : Type} (l : list A) : Forall2 eq l l.
Proof. induction l; constructor; auto. Qed.
Lemma Forall2_map2 {A A' B : Type} (Q : A -> A' -> Prop) (f : B -> A) (f' : B -> A') l :
  (forall b, Q (f b) (f' b)) -> Forall2 Q (map f l) (map f' l).
Proof. induction l; cbn; constructor; auto. Qed.

Lemma means_fplace : means (fplace depth index) s.
Proof.
  unfold Polynomials.means, fplace, itwo_to; cbn -[Z.pow]. rewrite !r_ofZ. split.
  - apply IZR_lt. now apply Z.pow_pos_nonneg.
  - rewrite Hs, plus_IZR. ring.
Qed.
Lemma means_fremaining : means (fremaining depth index) (1 - s).
Proof.
  unfold Polynomials.means, fremaining, itwo_to; cbn -[Z.pow]. rewrite !r_ofZ. split.
  - apply IZR_lt. now apply Z.pow_pos_nonneg.
  - replace ((1 - s) * IZR (2 ^ depth)) with (IZR (2 ^ depth) - s * IZR (2 ^ depth)) by ring.
    rewrite Hs, !minus_IZR. ring.
Qed.
Lemma means_fnum a : means (fnum a) (val a).
Proof. apply means_const. Qed.
Lemma means_zero : means (fconst 0 1) 0.
Proof. apply means_whole. Qed.
Lemma means_fdot a : forall b v w, Forall2 means a v -> Forall2 means b w ->
  means (fdot a b) (dot v w).
Proof.
  induction a as [|p a IH]; intros b v w Ha Hb; inversion Ha; subst; cbn; [apply means_zero|].
  inversion Hb; subst; [apply means_zero|]. apply means_add; auto. now apply means_mul.
Qed.
Lemma means_fform M : forall N y z v w, Forall2 (Forall2 means) M N ->
  Forall2 means y v -> Forall2 means z w -> means (fform M y z) (form N v w).
Proof.
  induction M as [|row M IH]; intros N y z' v w HM Hy Hz;
    inversion HM as [|? row' ? N' Hrow HM']; subst; cbn; [apply means_zero|].
  inversion Hrow as [|a a' b b' Ha Hb]; subst; [apply means_zero|].
  inversion Hy as [|y0 v0 y' v' Hy0 Hy']; subst; [apply means_zero|].
  inversion Hz as [|z0 w0 z1 w' Hz0 Hz']; subst; [apply means_zero|].
  apply means_add; auto. apply means_add; apply means_mul; auto.
  - apply means_add; [now apply means_mul|]. now apply means_fdot.
  - now apply means_fdot.
Qed.
Lemma means_bernstein_of S Q : means S s -> means Q (1 - s) -> forall d,
  Forall2 means (nth d (fbernstein S Q) []) (bernstein d s).
Proof.
  intros HS HQ d.
  pose proof (means_mul _ _ _ _ _ _ HS HQ) as SQ. pose proof (means_mul _ _ _ _ _ _ HS HS) as SS.
  pose proof (means_mul _ _ _ _ _ _ HQ HQ) as QQ.
  destruct d as [|[|[|[|d]]]]; cbn [nth fbernstein bernstein];
    repeat first [apply Forall2_nil | apply Forall2_cons].
  - apply means_one.
  - exact HQ.
  - exact HS.
  - exact QQ.
  - exact (means_scale _ _ 2 _ _ SQ).
  - exact SS.
  - exact (means_mul _ _ _ _ _ _ HQ QQ).
  - exact (means_scale _ _ 3 _ _ (means_mul _ _ _ _ _ _ HS QQ)).
  - exact (means_scale _ _ 3 _ _ (means_mul _ _ _ _ _ _ SS HQ)).
  - exact (means_mul _ _ _ _ _ _ SS HS).
  - destruct d; apply Forall2_nil.
Qed.
Lemma means_bernstein d : Forall2 means (nth d B []) (bernstein d s).
Proof. apply means_bernstein_of; [apply means_fplace|apply means_fremaining]. Qed.
Lemma means_curve p v : Forall2 means p v -> means (fcurve B p) (curve v s).
Proof.
  intros H. unfold fcurve, curve. rewrite (Forall2_length _ _ _ H).
  apply means_fdot; auto. apply means_bernstein.
Qed.
Lemma means_curve' p v : Forall2 means p v -> means (fcurve' B p) (curve' v s).
Proof.
  intros H. unfold fcurve', curve'. rewrite (Forall2_length _ _ _ H), INR_IZR_INZ.
  apply means_scale, means_curve. unfold fdifferences, differences.
  apply (Forall2_zip means means); auto.
  - intros. now apply means_sub.
  - destruct H; cbn; auto.
Qed.
Lemma means_along c : means (fcurve B (map fnum c)) (along s c).
Proof. apply means_curve, Forall2_map2, means_fnum. Qed.
Lemma means_line a b : means (fcurve B [fnum a; fnum b]) (line s a b).
Proof.
  eapply means_equal. { apply means_curve. repeat first [apply Forall2_nil | apply Forall2_cons]; apply means_fnum. }
  unfold curve, line. cbn. ring.
Qed.

Lemma means_fpow v a k : means v a -> means (fpow v k) (a ^ k).
Proof. intros H. induction k; cbn; [apply means_one|now apply means_mul]. Qed.
Lemma means_fpows v a : means v a -> forall k acc b i p, means acc b ->
  nth_error (fpows v acc k) i = Some p -> means p (a ^ i * b).
Proof.
  intros H. induction k as [|k IH]; intros acc b [|i] p Hb; cbn.
  - intros [= <-]. eapply means_equal; [exact Hb|ring].
  - destruct i; discriminate.
  - intros [= <-]. eapply means_equal; [exact Hb|ring].
  - intros E. eapply means_equal; [exact (IH (fmul v acc) (a * b) i p (means_mul _ _ _ _ _ _ H Hb) E)|].
    ring.
Qed.
Definition tabled (e : F * list F) (a : R) : Prop :=
  means (fst e) a /\ forall i p, nth_error (snd e) i = Some p -> means p (a ^ i).
Lemma means_ftable vs as_ : Forall2 means vs as_ -> forall ks, Forall2 tabled (ftable vs ks) as_.
Proof.
  induction 1 as [|v a vs as_ Hv H IH]; intros ks; cbn; constructor; auto.
  split; cbn; auto. intros i p Hp. eapply means_equal.
  { exact (means_fpows v a Hv _ _ _ _ _ (means_one _ _) Hp). } ring.
Qed.
Lemma means_fpower table vs : Forall2 tabled table vs -> forall e,
  means (fpower e table) (power e vs).
Proof.
  induction 1 as [|[v row] a table vs [Hv Hrow] H IH]; intros e.
  { destruct e as [|[|k] e]; apply means_one. }
  destruct e as [|[|k] e]; cbn [fpower power].
  - apply means_one.
  - eapply means_equal; [apply IH|cbn; ring].
  - apply means_mul; auto. cbn [snd fst] in *.
    destruct (nth_error row (S k)) eqn:E; [now apply Hrow|now apply means_fpow].
Qed.
Lemma means_frate table vs e : Forall2 tabled table vs -> means (frate e table) (rate e vs).
Proof.
  intros H. induction e as [|[k c] e IH]; cbn; [apply means_zero|].
  apply means_add; auto. apply means_mul; [apply means_fnum|now apply means_fpower].
Qed.

Lemma means_fstate : Forall2 means (fstate (length z)) z.
Proof.
  unfold fstate. assert (G : forall l (f : nat -> R), (forall i, (i < length l)%nat ->
    f i = nth i l 0) -> Forall2 (fun i v => f i = v) (seq 0 (length l)) l).
  { clear. induction l as [|a l IH]; intros f H; cbn; constructor.
    - apply (H O). cbn; lia.
    - rewrite <- seq_shift. assert (E := IH (fun i => f (S i))).
      assert (G : Forall2 (fun i v => f (S i) = v) (seq 0 (length l)) l).
      { apply E. intros i Hi. apply (H (S i)). cbn; lia. }
      clear - G. induction G; cbn; constructor; auto. }
  specialize (G z (fun i => nth i z 0) (fun i _ => eq_refl)).
  set (k := seq 0 (length z)) in *. clearbody k. revert G. generalize z at 1 3. intros l G.
  induction G as [|i v l' k' E]; cbn; constructor; auto.
  eapply means_equal; [apply means_var|]. unfold env. rewrite SuccNat2Pos.id_succ. exact E.
Qed.

Section Segment.
Variables (limits : list (option (num * num))) (mode : list side)
  (delta vertex : list num) (g : segment) (x : list R).
Hypothesis Hz : z = deviation g s x.
Hypothesis Hx : length x = length (nominal g).

Lemma z_length : length z = length (nominal g).
Proof. rewrite Hz. unfold deviation. rewrite zip_length; auto. now rewrite map_length. Qed.
Lemma means_deviation : Forall2 means (fdeviation g) z.
Proof. unfold fdeviation. rewrite <- z_length. apply means_fstate. Qed.
Lemma means_shape : Forall2 (Forall2 means) (fshape B g) (P g s).
Proof.
  eapply Forall2_zip; [|apply Forall2_same|apply Forall2_same].
  intros a ? b ? <- <-. eapply Forall2_zip; [|apply Forall2_same|apply Forall2_same].
  intros u ? v ? <- <-. apply means_line.
Qed.
Lemma means_level : means (flevel B g) (rho g s).
Proof. apply means_line. Qed.
Lemma means_wanted : Forall2 means (fwanted B g) (wanted g s z).
Proof.
  eapply Forall2_zip; [|apply Forall2_same|apply Forall2_same].
  intros u ? row ? <- <-. apply means_sub; [apply means_along|].
  apply means_fdot; [|apply means_deviation]. apply Forall2_map2. apply means_along.
Qed.
Lemma means_applied l : forall m us vs, Forall2 means us vs ->
  Forall2 means (fapplied l m us) (applied l m vs).
Proof.
  clear Hz Hx. induction l as [|[[a b]|] l IH]; intros [|e m] us vs H; inversion H; subst; cbn;
    constructor; auto.
  destruct e; auto; apply means_fnum.
Qed.
Lemma means_held l : forall m us vs, Forall2 means us vs ->
  Forall2 means (fheld l m us) (held l m vs).
Proof.
  clear Hz Hx. induction l as [|[[a b]|] l IH]; intros [|e m] us vs H; inversion H; subst; cbn; auto.
  constructor; auto.
  destruct e; repeat first [assumption | apply means_fnum | apply means_sub | apply means_mul].
Qed.
Lemma means_x : Forall2 means
  (zip fadd (map (fun c => fcurve B (map fnum c)) (nominal g)) (fdeviation g)) x.
Proof.
  replace x with (zip Rplus (map (along s) (nominal g)) z).
  - eapply Forall2_zip; [|apply Forall2_map2, means_along|apply means_deviation].
    intros; now apply means_add.
  - rewrite Hz. unfold deviation. clear Hz. revert Hx. generalize (nominal g).
    induction x as [|a l IH]; intros [|c cs]; cbn; try discriminate; auto.
    intros [= H]. rewrite IH by auto. f_equal. ring.
Qed.

Lemma means_moved us vs : Forall2 means us vs -> Forall2 means (fmoved delta us) (moved (map val delta) vs).
Proof.
  intros H. destruct delta as [|e l]; auto. cbn [fmoved moved map].
  eapply Forall2_zip; [|exact H|apply (Forall2_map2 means fnum val (e :: l)), means_fnum].
  intros. now apply means_add.
Qed.

Lemma means_duration : means (fsub (fnum (time (stop g))) (fnum (time (start g)))) (duration g).
Proof. apply means_sub; apply means_fnum. Qed.
Lemma means_relative : Forall2 means (frelative limits mode delta vertex g depth index)
  (relative g s x (moved (map val delta) (applied limits mode (wanted g s z))) (map val vertex)).
Proof.
  unfold frelative, relative. eapply Forall2_zip.
  2:{ unfold field. apply Forall2_map2. intros e. apply means_frate, means_ftable.
      constructor; [apply means_line|]. apply Forall2_app; [apply means_x|].
      apply Forall2_app; [apply means_moved, means_applied, means_wanted|]. apply Forall2_map2, means_fnum. }
  2:{ apply Forall2_map2. intros c. apply means_curve'. apply Forall2_map2, means_fnum. }
  intros a a' b b' Ha Hb. apply means_sub; auto. apply means_mul; auto. apply means_duration.
Qed.
Lemma means_growth : means (fgrowth limits mode delta vertex g depth index)
  (growth g s x (moved (map val delta) (applied limits mode (wanted g s z))) (map val vertex)).
Proof.
  pose proof means_deviation as Hd. unfold fgrowth, growth. rewrite <- Hz.
  apply means_sub; [apply means_add|].
  - apply means_fform; auto.
    eapply Forall2_zip; [|apply Forall2_same|apply Forall2_same].
    intros a ? b ? <- <-. eapply Forall2_zip; [|apply Forall2_same|apply Forall2_same].
    intros u ? v ? <- <-. apply means_sub; apply means_fnum.
  - apply (means_scale _ _ 2). apply means_fform; auto; [apply means_shape|].
    apply means_relative.
  - apply means_sub; apply means_fnum.
Qed.
Lemma means_W : means (fform (fshape B g) (fdeviation g) (fdeviation g)) (form (P g s) z z).
Proof. apply means_fform; try apply means_deviation. apply means_shape. Qed.
Lemma means_condition margin most a mu m taus ts : means most a -> means mu m ->
  Forall2 means taus ts ->
  means (fcondition margin limits mode g depth index most mu taus)
    (condition margin limits mode g s x a m ts).
Proof.
  intros Ha Hmu Htau. pose proof means_W. unfold fcondition, condition. rewrite <- Hz.
  apply means_sub; [apply means_add; [apply means_sub|]|].
  - now apply (means_scale _ _ (-1)).
  - apply means_mul; [apply means_fnum|]. apply means_mul; [apply means_duration|apply means_level].
  - apply means_mul; auto. apply means_sub; auto. apply means_level.
  - apply means_fdot; auto. apply means_held, means_wanted.
Qed.
End Segment.
End At.
End Condition.
