(* The obligation [semidefinite]: elimination on whole numbers, every division checked. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Positive Claim.
Import ListNotations.
Open Scope R_scope.

(* Fractions of files, computed with. *)
Definition nadd (a b : num) : num :=
  let (p, q) := a in
  let (p', q') := b in
  let u := (Zpos q' / Zpos q)%Z in
  let v := (Zpos q / Zpos q')%Z in
  if (u * Zpos q =? Zpos q')%Z then ((p * u + p')%Z, q')
  else if (v * Zpos q' =? Zpos q)%Z then ((p + p' * v)%Z, q)
  else ((p * Zpos q' + p' * Zpos q)%Z, (q * q')%positive).
Definition nmul (a b : num) : num := ((fst a * fst b)%Z, (snd a * snd b)%positive).
Definition nopp (a : num) : num := ((- fst a)%Z, snd a).
Definition nsub (a b : num) : num := nadd a (nopp b).
Definition nzero : num := (0%Z, xH).
Definition none : num := (1%Z, xH).
Fixpoint ndot (a b : list num) : num :=
  match a, b with x :: a', y :: b' => nadd (nmul x y) (ndot a' b') | _, _ => nzero end.

Lemma val_add a b : val (nadd a b) = val a + val b.
Proof.
  destruct a as [p q], b as [p' q']. unfold nadd, val.
  assert (0 < IZR (Zpos q)) by now apply IZR_lt. assert (0 < IZR (Zpos q')) by now apply IZR_lt.
  destruct (Z.eqb_spec (Zpos q' / Zpos q * Zpos q) (Zpos q')) as [E|E].
  { cbn [fst snd]. set (u := (Zpos q' / Zpos q)%Z) in *. rewrite plus_IZR, mult_IZR.
    apply (f_equal IZR) in E. rewrite mult_IZR in E. rewrite <- E. field.
    split; [lra|]. intros C. rewrite C in E. lra. }
  destruct (Z.eqb_spec (Zpos q / Zpos q' * Zpos q') (Zpos q)) as [E'|E'].
  { cbn [fst snd]. set (u := (Zpos q / Zpos q')%Z) in *. rewrite plus_IZR, mult_IZR.
    apply (f_equal IZR) in E'. rewrite mult_IZR in E'. rewrite <- E'. field.
    split; [lra|]. intros C. rewrite C in E'. lra. }
  cbn [fst snd]. rewrite plus_IZR, !mult_IZR, Pos2Z.inj_mul, mult_IZR. field. lra.
Qed.
Lemma val_mul a b : val (nmul a b) = val a * val b.
Proof.
  unfold nmul, val; cbn [fst snd]. rewrite Pos2Z.inj_mul, !mult_IZR. field.
  split; now apply Rgt_not_eq, IZR_lt.
Qed.
Lemma val_opp a : val (nopp a) = - val a.
Proof. unfold nopp, val; cbn [fst snd]. rewrite opp_IZR. field. now apply Rgt_not_eq, IZR_lt. Qed.
Lemma val_sub a b : val (nsub a b) = val a - val b.
Proof. unfold nsub. rewrite val_add, val_opp. ring. Qed.
Lemma val_nzero : val nzero = 0.
Proof. unfold val, nzero; cbn. field. Qed.
Lemma val_none : val none = 1.
Proof. unfold val, none; cbn. field. Qed.
Lemma val_dot a : forall b, val (ndot a b) = dot (map val a) (map val b).
Proof.
  induction a as [|x a IH]; intros [|y b]; cbn [ndot map dot]; try apply val_nzero.
  rewrite val_add, val_mul, IH. reflexivity.
Qed.
Definition ndiv (a b : num) : num :=
  ((fst a * Zpos (snd b))%Z, (snd a * Z.to_pos (fst b))%positive).
Lemma val_div a b : (0 < fst b)%Z -> val (ndiv a b) = val a / val b.
Proof.
  destruct a as [p q], b as [p' q']. unfold ndiv, val; cbn [fst snd]. intros H.
  rewrite mult_IZR, Pos2Z.inj_mul, Z2Pos.id, mult_IZR by auto. apply IZR_lt in H.
  field. repeat split; apply Rgt_not_eq; auto; now apply IZR_lt.
Qed.
Definition vals := map (map val).

Section Definite.
Context {K : Ints}.

(* (a c - bi b) / d, entry by entry *)
Fixpoint reduce_row (a bi d : I) (row b : list I) : option (list I) :=
  match row, b with
  | [], [] => Some []
  | c :: row', e :: b' =>
      let v := isub (imul a c) (imul bi e) in
      let q := iquot v d in
      if ieqb (imul q d) v then
        match reduce_row a bi d row' b' with Some l => Some (q :: l) | None => None end
      else None
  | _, _ => None
  end.
Fixpoint reduce (a d : I) (M : list (list I)) (b : list I) : option (list (list I)) :=
  match M, b with
  | [], [] => Some []
  | row :: M', e :: b' =>
      match reduce_row a e d row b, reduce a d M' b' with
      | Some l, Some N => Some (l :: N)
      | _, _ => None
      end
  | _, _ => None
  end.
Fixpoint eliminated (strict : bool) (fuel : nat) (d : I) (M : list (list I)) : bool :=
  match fuel, M with
  | _, [] => true
  | S k, (a :: b) :: M' =>
      if ipos a then
        match reduce a d M' b with Some N => eliminated strict k a N | None => false end
      else andb (andb (negb strict) (forallb (ieqb izero) (a :: b))) (eliminated strict k d M')
  | _, _ => false
  end.

Fixpoint whole_row (L : Z) (row : list num) : option (list I) :=
  match row with
  | [] => Some []
  | a :: row' =>
      let u := (L / Zpos (snd a))%Z in
      if (u * Zpos (snd a) =? L)%Z then
        match whole_row L row' with Some l => Some (ofZ (fst a * u) :: l) | None => None end
      else None
  end.
Fixpoint whole (L : Z) (M : list (list num)) : option (list (list I)) :=
  match M with
  | [] => Some []
  | row :: M' =>
      match whole_row L row, whole L M' with Some l, Some N => Some (l :: N) | _, _ => None end
  end.
Definition common (M : list (list num)) : Z :=
  fold_right (fun row acc => fold_right (fun a acc => Z.lcm (Zpos (snd a)) acc) acc row) 1%Z M.
(* [strict]: definite *)
Definition semidefinite (strict : bool) (M : list (list num)) : bool :=
  let L := common M in
  andb (0 <? L)%Z
    match whole L M with Some N => eliminated strict (length N) ione N | None => false end.

Lemma reduce_row_val a bi d row : forall b l y, reduce_row a bi d row b = Some l ->
  dot (map r l) y * r d = r a * dot (map r row) y - r bi * dot (map r b) y.
Proof.
  induction row as [|c row IH]; intros [|e b] l y; cbn; try discriminate.
  { intros [= <-]. cbn. ring. }
  destruct (ieqb _ _) eqn:E; [|discriminate]. apply r_eqb in E.
  rewrite r_mul, r_sub, !r_mul in E.
  destruct (reduce_row a bi d row b) as [l'|] eqn:El; [|discriminate]. intros [= <-].
  destruct y as [|y0 y]; cbn; [ring|]. rewrite Rmult_plus_distr_r, (IH b l' y El).
  replace (_ * y0 * r d) with (r (iquot (isub (imul a c) (imul bi e)) d) * r d * y0) by ring.
  rewrite E. ring.
Qed.
Lemma reduce_val a d M : forall b N y, reduce a d M b = Some N ->
  form (reals N) y y * r d = r a * form (reals M) y y - dot (map r b) y * dot (map r b) y.
Proof.
  induction M as [|row M IH]; intros [|e b] N y; cbn [reduce]; try discriminate.
  { intros [= <-]. cbn. ring. }
  destruct (reduce_row a e d row (e :: b)) as [l|] eqn:El; [|discriminate].
  destruct (reduce a d M b) as [N'|] eqn:EN; [|discriminate]. intros [= <-].
  destruct row as [|c row]; [discriminate|].
  destruct l as [|q l].
  { cbn in El. destruct (ieqb _ _); [|discriminate]. destruct (reduce_row a e d row b); discriminate. }
  destruct y as [|y0 y]; [cbn; ring|].
  cbn [reals map form dot].
  pose proof (reduce_row_val a e d (c :: row) (e :: b) (q :: l) (1 :: map (fun _ => 0) y) El) as A.
  pose proof (reduce_row_val a e d (c :: row) (e :: b) (q :: l) (0 :: y) El) as B.
  cbn [map dot] in A, B.
  assert (Z0 : forall l, dot l (map (fun _ => 0) y) = 0).
  { clear. induction y as [|y0 y IH]; intros [|v l]; cbn; auto. rewrite IH. ring. }
  rewrite !Z0 in A. pose proof (IH b N' y EN) as C.
  replace ((y0 * (r q * y0 + dot (map r l) y) + y0 * dot (map r l) y + form (reals N') y y) * r d)
    with (y0 * y0 * ((r q * 1 + 0) * r d) + 2 * y0 * ((r q * 0 + dot (map r l) y) * r d)
      + form (reals N') y y * r d) by ring.
  rewrite A, B, C. ring.
Qed.
Lemma eliminated_val strict fuel : forall d M y, 0 < r d -> eliminated strict fuel d M = true ->
  0 <= form (reals M) y y.
Proof.
  induction fuel as [|k IH]; intros d [|[|a b] M] y Hd; cbn [eliminated]; try discriminate;
    try (intros _; cbn; lra).
  destruct (ipos a) eqn:Ha.
  - apply r_pos in Ha. destruct (reduce a d M b) as [N|] eqn:EN; [|discriminate]. intros H.
    destruct y as [|y0 y]; [cbn; lra|].
    pose proof (reduce_val a d M b N y EN) as R0. pose proof (IH a N y Ha H) as Q.
    cbn [reals map form]. unfold reals in *.
    set (B := dot (map r b) y) in *. set (G := form (map (map r) M) y y) in *.
    apply (Rmult_le_reg_l (r a)); auto. rewrite Rmult_0_r.
    replace (r a * _) with ((r a * y0 + B) * (r a * y0 + B) + (r a * G - B * B)) by ring.
    rewrite <- R0. pose proof (Rle_0_sqr (r a * y0 + B)) as S. unfold Rsqr in S.
    pose proof (Rmult_le_pos _ _ Q (Rlt_le _ _ Hd)). lra.
  - intros H. apply andb_prop in H as [H1 H2]. apply andb_prop in H1 as [_ H1].
    destruct y as [|y0 y]; [cbn; lra|]. cbn [reals map form].
    cbn in H1. apply andb_prop in H1 as [E1 E2]. apply r_eqb in E1. rewrite r_zero in E1.
    assert (Z0 : forall z, dot (map r b) z = 0).
    { clear - E2. induction b as [|c b IH]; intros [|z0 z]; cbn in *; auto.
      apply andb_prop in E2 as [E E2]. apply r_eqb in E. rewrite r_zero in E.
      rewrite IH, <- E; auto. ring. }
    pose proof (IH d M y Hd H2) as Q. rewrite !Z0, <- E1. lra.
Qed.
Lemma whole_row_val L row : forall l y, whole_row L row = Some l ->
  dot (map r l) y = IZR L * dot (map val row) y.
Proof.
  induction row as [|[p q] row IH]; intros l y; cbn.
  { intros [= <-]. cbn. ring. }
  destruct (Z.eqb_spec (L / Zpos q * Zpos q) L) as [E|]; [|discriminate].
  destruct (whole_row L row) as [l'|]; [|discriminate]. intros [= <-].
  destruct y as [|y0 y]; cbn; [ring|]. rewrite (IH l' y eq_refl), r_ofZ, mult_IZR.
  apply (f_equal IZR) in E. rewrite mult_IZR in E. set (u := IZR (L / Zpos q)) in *.
  unfold val; cbn [fst snd]. rewrite <- E. field. now apply Rgt_not_eq, IZR_lt.
Qed.
Lemma whole_val L M : forall N y, whole L M = Some N ->
  form (reals N) y y = IZR L * form (vals M) y y.
Proof.
  induction M as [|row M IH]; intros N y; cbn.
  { intros [= <-]. cbn. ring. }
  destruct (whole_row L row) as [l|] eqn:El; [|discriminate].
  destruct (whole L M) as [N'|]; [|discriminate]. intros [= <-].
  destruct row as [|c row].
  { injection El as <-. cbn. ring. }
  destruct l as [|q l].
  { cbn in El. destruct (_ =? _)%Z; [|discriminate]. destruct (whole_row L row); discriminate. }
  destruct y as [|y0 y]; cbn [reals vals map form]; [ring|].
  pose proof (whole_row_val L (c :: row) (q :: l) (1 :: map (fun _ => 0) y) El) as A.
  pose proof (whole_row_val L (c :: row) (q :: l) (0 :: y) El) as B.
  assert (Z0 : forall l, dot l (map (fun _ => 0) y) = 0).
  { clear. induction y as [|y1 y IH]; intros [|v l]; cbn; auto. rewrite IH. ring. }
  cbn [map dot] in A, B. rewrite !Z0 in A. pose proof (IH N' y eq_refl) as C.
  rewrite C. replace (dot (map r l) y) with (r q * 0 + dot (map r l) y) by ring. rewrite B.
  replace (r q) with (r q * 1 + 0) by ring. rewrite A. unfold vals. ring.
Qed.
Theorem semidefinite_sound strict M y : semidefinite strict M = true -> 0 <= form (vals M) y y.
Proof.
  unfold semidefinite. intros H. apply andb_prop in H as [H1 H2]. apply Z.ltb_lt, IZR_lt in H1.
  destruct (whole (common M) M) as [N|] eqn:E; [|discriminate].
  pose proof (whole_val _ M N y E) as W.
  assert (0 <= form (reals N) y y).
  { eapply eliminated_val; [|exact H2]. rewrite r_one. lra. }
  apply (Rmult_le_reg_l (IZR (common M))); auto. lra.
Qed.
End Definite.
