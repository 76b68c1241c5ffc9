(* The obligation [positive] of proof files: c(s, x) > 0 for every s in [0, 1] and every x, by sums of
   squares in Bernstein form and a remainder that is diagonally dominant. *)
From Coq Require Import ZArith Reals List Lra Lia.
From Verified Require Import Integers Forms Polynomials.
Import ListNotations.
Open Scope R_scope.

Section Positive.
Context {K : Ints}.

(* A factor R_j: its rows with their weights; a row belongs to the last monomials. *)
Definition factor := list (I * list I).
Record squares := Squares { unit : Z; scale : I; factors : list factor }.

Fixpoint addrow (c : I) (row g : list I) : list I :=
  match row, g with a :: row', b :: g' => iadd (imul c a) b :: addrow c row' g' | _, _ => g end.
Fixpoint outer (skip : nat) (w : I) (row : list I) (G : list (list I)) : list (list I) :=
  match G with
  | [] => []
  | g :: G' =>
      match skip, row with
      | S k, _ => g :: outer k w row G'
      | O, [] => G
      | O, a :: row' => addrow (imul w a) row g :: outer O w row' G'
      end
  end.
Fixpoint zeros (k : nat) : list (list I) :=
  match k with O => [] | S j => repeat izero k :: zeros j end.
Definition gram (k : nat) (f : factor) : list (list I) :=
  fold_right (fun e G => outer (k - length (snd e)) (fst e) (snd e) G) (zeros k) f.
Fixpoint stack (grams : list (list (list I))) : list (list bern) :=
  match grams with
  | [] => []
  | [G] => map (map (fun a => [a])) G
  | G :: rest => zip (zip cons) G (stack rest)
  end.
Fixpoint row_terms (v : mono) (c : I) (basis : list mono) (p : list I) (row : list bern) : poly :=
  match basis, p, row with
  | k :: basis', e :: p', a :: row' =>
      (mmul v k, bscale (imul c e) a) :: row_terms v c basis' p' row'
  | _, _, _ => []
  end.
Fixpoint gram_terms (basis : list mono) (p : list I) (M : list (list bern)) : poly :=
  match basis, p, M with
  | v :: basis', c :: p', (d :: row) :: M' =>
      (mmul v v, bscale (imul c c) d) ::
        row_terms v (imul itwo c) basis' p' row ++ gram_terms basis' p' M'
  | _, _, _ => []
  end.

Definition well_formed (k : nat) (f : factor) : bool :=
  forallb (fun e => andb (inonneg (fst e)) (Nat.leb (length (snd e)) k)) f.
Definition weighted (b : I) (f : factor) : factor := map (fun e => (imul b (fst e), snd e)) f.

(* The sum of squares as a polynomial. *)
Definition expanded (basis : list mono) (columns : list Z) (sq : squares) : option F :=
  let k := length basis in
  let J := pred (length (factors sq)) in
  let weights := raise J [ione] in
  let lowest := fold_right Z.min 400%Z columns in
  let p := map (fun c => itwo_to (c - lowest)) columns in
  let used := zip weighted weights (factors sq) in
  let shift := (2 * (unit sq - lowest))%Z in
  let terms := sorted badd (gram_terms basis p (stack (map (gram k) used))) in
  if andb (andb (Nat.eqb (length columns) k) (forallb (well_formed k) used)) (ipos (scale sq))
  then
    if (0 <=? shift)%Z
    then
      let d := imul (scale sq) (itwo_to shift) in
      if ipos d then Some (Frac terms d J) else None
    else Some (Frac (pscale (itwo_to (- shift)) terms) (scale sq) J)
  else None.

(* Which products of two monomials of the basis each monomial is, by their places. *)
Definition choices := list (mono * list (nat * nat)).
Fixpoint pairs (l : list (nat * mono)) : choices :=
  match l with
  | [] => []
  | (i, v) :: l' => map (fun e => (mmul v (snd e), [(i, fst e)])) l ++ pairs l'
  end.
Definition products (basis : list mono) : choices :=
  sorted (@app (nat * nat)) (pairs (combine (seq 0 (length basis)) basis)).

Fixpoint best (columns : list Z) (sofar : nat * nat) (l : list (nat * nat)) : nat * nat :=
  match l with
  | [] => sofar
  | e :: l' =>
      let size e := (nth (fst e) columns 0 + nth (snd e) columns 0)%Z in
      if Nat.eqb (fst sofar) (snd sofar) then sofar
      else if Nat.eqb (fst e) (snd e) then e
      else best columns (if (size sofar <? size e)%Z then e else sofar) l'
  end.
Definition charge (p : list I) (e : nat * nat) (a : bern) (room : list bern) : list bern :=
  let (i, j) := e in
  let c := imul (nth i p izero) (nth j p izero) in
  if Nat.eqb i j then update i (badd (bscale (imul itwo c) a)) room
  else
    let b := bscale (iopp c) (babs a) in
    update i (badd b) (update j (badd b) room).
Fixpoint from (m : mono) (l : choices) : choices :=
  match l with
  | [] => []
  | (k, _) :: l' => match mcompare k m with Lt => from m l' | _ => l end
  end.
Fixpoint dominated (columns : list Z) (p : list I) (l : choices) (terms : poly) (room : list bern)
  : option (list bern) :=
  match terms with
  | [] => Some room
  | (m, a) :: rest =>
      match from m l with
      | (k, e :: es) :: l' =>
          match mcompare k m with
          | Eq => dominated columns p ((k, e :: es) :: l') rest
                    (charge p (best columns e es) a room)
          | _ => None
          end
      | _ => None
      end
  end.

Definition is_one (v : mono) : bool := match v with [] => true | _ => false end.
Definition nonzero (t : mono * bern) : bool := negb (forallb (ieqb izero) (snd t)).

(* What is left of [c] on the diagonal, nowhere negative. [l] is [products basis], computed once. *)
Definition remainder (basis : list mono) (l : choices) (columns : list Z) (sq : squares) (c : F)
  : option (list bern) :=
  match expanded basis columns sq with
  | None => None
  | Some squared =>
      let rest := fsub c squared in
      let D := order rest in
      let terms := filter nonzero
        (map (fun t => (fst t, raise (S D - length (snd t)) (snd t))) (num rest)) in
      let highest := fold_right Z.max (-400)%Z columns in
      let p := map (fun c => itwo_to (highest - c)) columns in
      if andb (Nat.eqb (length columns) (length basis)) (forallb ipos p)
      then
        match dominated columns p l terms (repeat [] (length basis)) with
        | Some room => if forallb (forallb inonneg) room then Some room else None
        | None => None
        end
      else None
  end.
Definition some_left (basis : list mono) (room : list bern) : bool :=
  existsb (fun e => andb (is_one (fst e))
    (andb (Nat.ltb 0 (length (snd e))) (forallb ipos (snd e)))) (combine basis room).
Definition is_positive (basis : list mono) (l : choices) (columns : list Z) (sq : squares) (c : F)
  : bool :=
  match remainder basis l columns sq c with Some room => some_left basis room | None => false end.
Definition is_nonneg (basis : list mono) (l : choices) (columns : list Z) (sq : squares) (c : F)
  : bool :=
  match remainder basis l columns sq c with Some _ => true | None => false end.

(* Why. *)
Section At.
Variables (s : R) (x : positive -> R).
Notation bval := (bval s).
Notation pval := (pval s x).
Notation mval := (mval x).
Notation means := (means s x).
Definition reals := map (map r).
Definition values := map (map bval).

Lemma addrow_val c row : forall g z, length row = length g ->
  length (addrow c row g) = length g /\
  dot (map r (addrow c row g)) z = r c * dot (map r row) z + dot (map r g) z.
Proof.
  induction row as [|a row IH]; intros [|b g] z H; cbn in *; try discriminate.
  { split; auto; ring. }
  injection H as H. destruct z as [|z0 z].
  { destruct (IH g [] H) as [L _]. split; [now rewrite L|]. ring. }
  destruct (IH g z H) as [L V]. rewrite L, V, r_add, r_mul. split; auto; ring.
Qed.

Lemma outer_val k : forall skip w row G y, triangular k G -> length y = k ->
  (skip + length row = k)%nat ->
  triangular k (outer skip w row G) /\
  form (reals (outer skip w row G)) y y =
    form (reals G) y y + r w * dot (map r row) (skipn skip y) ^ 2.
Proof.
  induction k as [|k IH]; intros skip w row [|g G] y T Hy Hs; cbn [triangular] in T; try tauto.
  { destruct y; [|discriminate]. cbn. rewrite skipn_nil, dot_nil_r. split; auto; ring. }
  destruct T as [Lg T]. destruct y as [|y0 y]; [discriminate|]. injection Hy as Hy.
  destruct skip as [|skip]; cbn [outer].
  - destruct row as [|a row]; [discriminate|]. cbn in Hs. injection Hs as Hs.
    destruct (IH O w row G y T Hy Hs) as [T' V'].
    destruct g as [|b g]; [discriminate|]. cbn in Lg. injection Lg as Lg.
    destruct (addrow_val (imul w a) row g y) as [L V]. congruence.
    cbn [addrow]. split.
    + cbn [triangular]. split; auto. cbn. now rewrite L, Lg.
    + cbn [reals map form skipn dot]. rewrite V, V', r_add, !r_mul.
      cbn [skipn]. ring.
  - cbn in Hs. injection Hs as Hs. destruct (IH skip w row G y T Hy Hs) as [T' V'].
    split. { cbn [triangular]. auto. }
    destruct g as [|b g]; [discriminate|].
    cbn [reals map form skipn]. rewrite V'. ring.
Qed.
Lemma zeros_val k : forall y, triangular k (zeros k) /\ form (reals (zeros k)) y y = 0.
Proof.
  induction k as [|k IH]; intros y. { cbn; auto. }
  destruct y as [|y0 y].
  - destruct (IH []) as [T _]. cbn. rewrite repeat_length. auto.
  - destruct (IH y) as [T V]. cbn [zeros triangular]. rewrite repeat_length. split; auto.
    cbn [repeat reals map form]. rewrite V.
    assert (E : forall z, dot (map r (repeat izero k)) z = 0).
    { clear. induction k as [|k IH]; intros [|z0 z]; cbn; auto. rewrite IH, r_zero. ring. }
    rewrite !E, r_zero. ring.
Qed.
Lemma gram_val k f y : well_formed k f = true -> length y = k ->
  triangular k (gram k f) /\ 0 <= form (reals (gram k f)) y y.
Proof.
  intros H Hy. induction f as [|[w row] f IH]; cbn.
  { destruct (zeros_val k y) as [T ->]. split; auto; lra. }
  cbn in H. apply andb_prop in H as [H H']. apply andb_prop in H as [Hw Hl].
  apply r_nonneg in Hw. apply Nat.leb_le in Hl. destruct (IH H') as [T V].
  destruct (outer_val k (k - length row) w row (gram k f) y T Hy) as [T' V']. lia.
  split; auto. unfold gram in V'. cbn in V'. rewrite V'. unfold gram in V.
  pose proof (Rmult_le_pos _ _ Hw (pow2_ge_0 (dot (map r row) (skipn (k - length row) y)))).
  lra.
Qed.

Definition long (n : nat) (M : list (list bern)) := Forall (Forall (fun a => length a = n)) M.
Lemma zip_cons_row n g : forall t z, length g = length t -> Forall (fun a => length a = n) t ->
  dot (map bval (zip cons g t)) z = (1 - s) ^ n * dot (map r g) z + s * dot (map bval t) z.
Proof.
  induction g as [|a g IH]; intros [|b t] [|z0 z] L H; cbn in *; try discriminate; try ring.
  inversion H; subst. rewrite IH; auto. ring.
Qed.
Lemma zip_long n g : forall t, Forall (fun a => length a = n) t ->
  Forall (fun a => length a = S n) (zip cons g t : list bern).
Proof. induction g; intros [|b t] H; cbn; constructor; inversion H; subst; cbn; auto. Qed.
Lemma zip_stack n k : forall G T y, triangular k G -> triangular k T -> long n T ->
  triangular k (zip (zip cons) G T) /\ long (S n) (zip (zip cons) G T) /\
  form (values (zip (zip cons) G T)) y y =
    (1 - s) ^ n * form (reals G) y y + s * form (values T) y y.
Proof.
  induction k as [|k IH]; intros [|g G] [|t T] y HG HT HL; cbn [triangular] in *; try tauto.
  { cbn. repeat split; auto; [constructor|ring]. }
  destruct HG as [Lg HG], HT as [Lt HT]. inversion HL as [|? ? Ht HL']; subst.
  assert (Lz : length (zip cons g t : list bern) = S k) by (exact (eq_trans (zip_length cons g t (eq_trans Lg (eq_sym Lt))) Lg)).
  cbn [zip].
  destruct y as [|y0 y].
  { destruct (IH G T [] HG HT HL') as [A [B _]].
    split; [split; auto|]. split; [constructor; auto; now apply zip_long|].
    destruct g, t; cbn; ring. }
  destruct (IH G T y HG HT HL') as [A [B C]].
  split; [split; auto|]. split; [constructor; auto; now apply zip_long|].
  destruct g as [|a g], t as [|b t]; try discriminate. injection Lg as Lg. injection Lt as Lt.
  inversion Ht; subst.
  cbn [zip values reals map form]. rewrite C.
  rewrite (zip_cons_row (length b) g t y); auto; try congruence. cbn [Polynomials.bval]. ring.
Qed.
Lemma stack_val k y grams : 0 <= s <= 1 -> grams <> [] ->
  Forall (fun G => triangular k G /\ 0 <= form (reals G) y y) grams ->
  triangular k (stack grams) /\ long (length grams) (stack grams) /\
  0 <= form (values (stack grams)) y y.
Proof.
  intros Hs. induction grams as [|G grams IH]; intros N H; [congruence|].
  inversion H as [|? ? [T V] H']; subst.
  destruct grams as [|G' grams].
  - cbn [stack length]. clear - T V.
    assert (E : forall k G y, triangular k G ->
      triangular k (map (map (fun a => [a])) G) /\ long 1 (map (map (fun a => [a])) G) /\
      form (values (map (map (fun a => [a])) G)) y y = form (reals G) y y).
    { clear. assert (E : forall g z, dot (map bval (map (fun a => [a]) g)) z = dot (map r g) z).
      { induction g as [|a g IH]; intros [|z0 z]; cbn; auto. rewrite IH. ring. }
      induction k as [|k IH]; intros [|g G] y T; cbn [triangular] in T; try tauto.
      { cbn. repeat split. constructor. }
      destruct T as [L T]. destruct (IH G (tl y) T) as [A [B C]]. cbn [map triangular].
      rewrite map_length. repeat split; auto.
      { constructor; auto. clear. induction g; cbn; constructor; auto. }
      destruct y as [|y0 y], g as [|a g]; try discriminate; auto.
      cbn [tl] in C. cbn [values reals map form].
      rewrite C, !E. cbn. ring. }
    destruct (E k G y T) as [A [B ->]]. auto.
  - destruct (IH ltac:(discriminate) H') as [A [B C]].
    destruct (zip_stack _ k G (stack (G' :: grams)) y T A B) as [A' [B' C']].
    change (stack (G :: G' :: grams)) with (zip (zip cons) G (stack (G' :: grams))).
    split; auto. split; auto. rewrite C'.
    apply Rplus_le_le_0_compat; apply Rmult_le_pos; auto; try lra. apply pow_le; lra.
Qed.

Definition scaled (basis : list mono) (p : list I) := zip (fun v c => r c * mval v) basis p.
Lemma pval_app p q : pval (p ++ q) = pval p + pval q.
Proof. induction p as [|[m a] p IH]; cbn. ring. rewrite IH. ring. Qed.
Lemma row_terms_val v c basis : forall p row,
  pval (row_terms v c basis p row) = r c * mval v * dot (map bval row) (scaled basis p).
Proof.
  induction basis as [|k basis IH]; intros [|e p] [|a row]; cbn; try ring.
  rewrite IH. fold (bscale (imul c e) a). rewrite bscale_val, mmul_val, r_mul.
  unfold scaled. ring.
Qed.
Lemma gram_terms_val basis : forall p M,
  pval (gram_terms basis p M) = form (values M) (scaled basis p) (scaled basis p).
Proof.
  induction basis as [|v basis IH]; intros [|c p] [|[|d row] M]; cbn; try ring.
  rewrite pval_app, IH, row_terms_val. fold (bscale (imul c c) d).
  rewrite bscale_val, mmul_val, !r_mul, r_two. unfold scaled, values. ring.
Qed.

Lemma expanded_val basis columns sq q : 0 <= s <= 1 ->
  expanded basis columns sq = Some q -> exists v, means q v /\ 0 <= v.
Proof.
  intros Hs. unfold expanded.
  set (p := map _ columns). set (used := zip weighted _ _). set (terms := sorted _ _).
  destruct (andb _ _) eqn:E; [|discriminate].
  apply andb_prop in E as [E Hscale]. apply andb_prop in E as [Hcol Hwell].
  apply Nat.eqb_eq in Hcol. apply r_pos in Hscale.
  assert (V : 0 <= pval terms).
  { unfold terms. rewrite sorted_val, gram_terms_val.
    clearbody used. destruct used as [|f fs].
    { cbn. lra. }
    edestruct stack_val as [_ [_ G]]; try exact G; auto; try discriminate.
    apply Forall_map, Forall_forall. rewrite forallb_forall in Hwell.
    intros g Hg. apply gram_val; auto.
    unfold scaled, p. rewrite zip_length; auto. rewrite map_length; auto. }
  set (d := imul (scale sq) _).
  destruct (0 <=? _)%Z.
  - destruct (ipos d) eqn:Hd; [|discriminate]. intros [= <-]. apply r_pos in Hd.
    exists (pval terms / r d). split.
    + split; cbn [num den]; [exact Hd|]. field. now apply Rgt_not_eq.
    + apply Rmult_le_pos; auto. left. now apply Rinv_0_lt_compat.
  - intros [= <-]. set (m := itwo_to _). exists (r m * pval terms / r (scale sq)). split.
    + split; cbn [num den]; [exact Hscale|]. rewrite pscale_val. field. now apply Rgt_not_eq.
    + apply Rmult_le_pos; [|left; now apply Rinv_0_lt_compat]. apply Rmult_le_pos; auto.
      unfold m, itwo_to. rewrite r_ofZ. apply IZR_le. apply Z.pow_nonneg. lia.
Qed.

(* What a choice says, and what it is charged. *)
Definition good (basis : list mono) (e : mono * list (nat * nat)) : Prop :=
  Forall (fun ij => (fst ij < length basis)%nat /\ (snd ij < length basis)%nat /\
    mval (fst e) = mval (nth (fst ij) basis []) * mval (nth (snd ij) basis [])) (snd e).
Lemma pairs_good basis l :
  Forall (fun e => (fst e < length basis)%nat /\ nth (fst e) basis [] = snd e) l ->
  Forall (good basis) (pairs l).
Proof.
  induction l as [|[i v] l IH]; intros H; cbn [pairs]; auto.
  apply Forall_app. split.
  - apply Forall_map, Forall_forall. intros [j w] Hj. unfold good. cbn [fst snd].
    constructor; [|constructor]. cbn [fst snd].
    rewrite Forall_forall in H. destruct (H _ Hj) as [A B]. cbn [fst snd] in A, B.
    destruct (H (i, v)) as [C D]; [now left|]. cbn [fst snd] in C, D.
    rewrite B, D, mmul_val. auto.
  - apply IH. now inversion H.
Qed.
Lemma products_good basis : Forall (good basis) (products basis).
Proof.
  apply sorted_all.
  - intros m a b Ha Hb. unfold good in *; cbn in *. now apply Forall_app.
  - apply pairs_good. apply Forall_forall. intros [i v] H.
    assert (G : forall l d i v, In (i, v) (combine (seq d (length l)) l) ->
      (d <= i < d + length l)%nat /\ nth (i - d) l ([] : mono) = v).
    { clear. induction l as [|a l IH]; intros d i v H; cbn in H; [tauto|].
      destruct H as [[= <- <-]|H].
      - cbn. rewrite Nat.sub_diag. split; auto; lia.
      - apply IH in H as [H1 H2]. cbn [length]. split; [lia|].
        replace (i - d)%nat with (S (i - S d)) by lia. exact H2. }
    apply G in H as [H1 H2]. rewrite Nat.sub_0_r in H2. cbn. split; auto; lia.
Qed.
Lemma best_in columns l : forall e, In (best columns e l) (e :: l).
Proof.
  induction l as [|e' l IH]; intros e; cbn [best]; [now left|].
  destruct (Nat.eqb (fst e) _); [now left|].
  destruct (Nat.eqb (fst e') _); [right; now left|].
  destruct (_ <? _)%Z; destruct (IH (if true then e' else e)) as [H|H]; cbn in *;
    try (right; now left); try (right; right; assumption).
  - destruct (IH e) as [H'|H']; [left; exact H'|right; right; exact H'].
  - destruct (IH e) as [H'|H']; [left; exact H'|right; right; exact H'].
Qed.
Lemma from_in m l e : In e (from m l) -> In e l.
Proof.
  induction l as [|[k a] l IH]; cbn; auto. destruct (mcompare k m); auto.
Qed.

Lemma dot_update zz c : forall room i, length room = length zz -> (i < length room)%nat ->
  dot (map bval (update i (badd c) room)) zz = dot (map bval room) zz + bval c * nth i zz 0.
Proof.
  induction zz as [|z zz IH]; intros [|a room] [|i] H Hi; cbn in *; try lia.
  - rewrite badd_val. ring.
  - injection H as H. rewrite IH; auto; [ring|lia].
Qed.
Lemma babs_val a : 0 <= s <= 1 -> Rabs (bval a) <= bval (babs a).
Proof.
  intros Hs. induction a as [|y a IH]; cbn. { rewrite Rabs_R0; lra. }
  unfold babs. rewrite map_length. fold (babs a).
  eapply Rle_trans; [apply Rabs_triang|]. rewrite !Rabs_mult.
  rewrite (Rabs_right s), (Rabs_right ((1 - s) ^ _)) by (try apply Rle_ge, pow_le; lra).
  apply Rplus_le_compat; [apply Rmult_le_compat_r; [apply pow_le; lra|apply r_abs]|].
  apply Rmult_le_compat_l; lra.
Qed.

Section Charges.
Variables (basis : list mono) (p : list I).
Hypothesis Hs : 0 <= s <= 1.
Hypothesis Hp : length p = length basis.
Hypothesis Hpos : Forall (fun a => 0 < r a) p.
Definition z (i : nat) : R := mval (nth i basis []) / r (nth i p izero).
Definition zz : list R := map (fun i => z i * z i) (seq 0 (length basis)).

Lemma zz_length : length zz = length basis.
Proof. unfold zz. now rewrite map_length, seq_length. Qed.
Lemma zz_nth i : (i < length basis)%nat -> nth i zz 0 = z i * z i.
Proof.
  intros H. unfold zz. rewrite nth_indep with (d' := z 0 * z 0) by
    (rewrite map_length, seq_length; auto).
  change (z 0 * z 0) with ((fun i => z i * z i) O).
  rewrite map_nth, seq_nth; auto.
Qed.
Lemma p_nth i : (i < length basis)%nat -> 0 < r (nth i p izero).
Proof. intros H. rewrite Forall_forall in Hpos. apply Hpos, nth_In. now rewrite Hp. Qed.
Lemma v_is i : (i < length basis)%nat -> mval (nth i basis []) = r (nth i p izero) * z i.
Proof. intros H. unfold z. field. pose proof (p_nth i H). lra. Qed.

Lemma charge_length e a room : length (charge p e a room) = length room.
Proof.
  destruct e as [i j]; cbn. destruct (Nat.eqb i j); rewrite !update_length; auto.
Qed.
Lemma charge_val i j a room m :
  (i < length basis)%nat -> (j < length basis)%nat -> length room = length basis ->
  m = mval (nth i basis []) * mval (nth j basis []) ->
  dot (map bval (charge p (i, j) a room)) zz <= dot (map bval room) zz + 2 * (bval a * m).
Proof.
  intros Hi Hj HL ->. rewrite (v_is i Hi), (v_is j Hj). cbn [charge].
  pose proof zz_length as Lz.
  destruct (Nat.eqb_spec i j) as [<-|N].
  - rewrite dot_update by (try lia; congruence). rewrite zz_nth by auto.
    rewrite bscale_val, !r_mul, r_two. apply Req_le. ring.
  - rewrite dot_update by (rewrite ?update_length; try lia; congruence).
    rewrite dot_update by (try lia; congruence). rewrite !zz_nth by auto.
    rewrite bscale_val, r_opp, r_mul.
    pose proof (p_nth i Hi) as A. pose proof (p_nth j Hj) as B.
    set (u := r (nth i p izero)) in *. set (v := r (nth j p izero)) in *.
    pose proof (babs_val a Hs) as C.
    assert (D : - (bval (babs a)) * (z i * z i + z j * z j) <= 2 * (bval a * (z i * z j))).
    { assert (E : Rabs (z i * z j) <= (z i * z i + z j * z j) / 2).
      { pose proof (pow2_ge_0 (z i - z j)). pose proof (pow2_ge_0 (z i + z j)).
        apply Rabs_le. nra. }
      pose proof (Rabs_pos (bval a)). pose proof (Rabs_pos (z i * z j)).
      assert (F : Rabs (bval a * (z i * z j)) <= bval (babs a) * ((z i * z i + z j * z j) / 2)).
      { rewrite Rabs_mult. apply Rmult_le_compat; auto. }
      pose proof (Rle_abs (- (bval a * (z i * z j)))) as G. rewrite Rabs_Ropp in G. nra. }
    assert (0 < u * v) by now apply Rmult_lt_0_compat.
    pose proof (Rmult_le_compat_l (u * v) _ _ ltac:(lra) D). nra.
Qed.

Lemma dominated_val columns l terms : Forall (good basis) l -> forall room room',
  length room = length basis ->
  dominated columns p l terms room = Some room' ->
  length room' = length basis /\
  dot (map bval room') zz <= dot (map bval room) zz + 2 * pval terms.
Proof.
  revert l. induction terms as [|[m a] terms IH]; intros l HG room room' HL; cbn [dominated].
  { intros [= <-]. split; auto. cbn. lra. }
  destruct (from m l) as [|[k [|e es]] l'] eqn:E; try discriminate.
  destruct (mcompare k m) eqn:Em; try discriminate. apply mcompare_eq in Em as ->.
  assert (HG' : Forall (good basis) ((m, e :: es) :: l')).
  { rewrite <- E. apply Forall_forall. intros c Hc. apply from_in in Hc.
    rewrite Forall_forall in HG. auto. }
  intros H. apply IH in H; auto; [|rewrite charge_length; auto].
  destruct H as [HL' V]. split; auto. eapply Rle_trans; [exact V|].
  inversion HG' as [|? ? Hm _]; subst. unfold good in Hm.
  rewrite Forall_forall in Hm. specialize (Hm _ (best_in columns es e)).
  destruct (best columns e es) as [i j]. cbn [fst snd] in Hm. destruct Hm as [Hi [Hj Hm]].
  pose proof (charge_val i j a room (mval m) Hi Hj HL Hm). cbn [Polynomials.pval]. lra.
Qed.
End Charges.

Lemma bval_nonneg a : 0 <= s <= 1 -> forallb inonneg a = true -> 0 <= bval a.
Proof.
  intros Hs. induction a as [|y a IH]; cbn; [lra|]. intros H. apply andb_prop in H as [H1 H2].
  apply r_nonneg in H1. specialize (IH H2).
  apply Rplus_le_le_0_compat; apply Rmult_le_pos; try lra. apply pow_le; lra.
Qed.
Lemma bval_pos a : 0 <= s <= 1 -> (0 < length a)%nat -> forallb ipos a = true -> 0 < bval a.
Proof.
  intros Hs. induction a as [|y a IH]; cbn; [lia|]. intros _ H. apply andb_prop in H as [H1 H2].
  apply r_pos in H1. destruct a as [|y' a]. { cbn. lra. }
  specialize (IH ltac:(cbn; lia) H2).
  destruct (Req_dec s 0) as [->|N].
  - rewrite Rminus_0_r, pow1. lra.
  - apply Rplus_le_lt_0_compat; [apply Rmult_le_pos; try lra; apply pow_le; lra|].
    apply Rmult_lt_0_compat; lra.
Qed.

Lemma raised_terms_val n ts :
  pval (filter nonzero (map (fun t => (fst t, raise (n - length (snd t)) (snd t))) ts)) = pval ts.
Proof.
  induction ts as [|[m a] ts IH]; cbn [map filter fst snd]; auto.
  destruct (raise_val s (n - length a) a) as [_ V].
  destruct (nonzero _) eqn:E; cbn [Polynomials.pval]; rewrite IH; [now rewrite V|].
  enough (Z : bval a = 0) by (rewrite Z; ring). rewrite <- V.
  unfold nonzero in E. cbn [snd] in E. apply Bool.negb_false_iff in E.
  clear - E. induction (raise _ a) as [|y b IH]; cbn in *; auto.
  apply andb_prop in E as [E1 E2]. apply r_eqb in E1. rewrite r_zero in E1.
  rewrite IH, <- E1; auto. ring.
Qed.

Theorem remainder_sound basis columns sq c v room : 0 <= s <= 1 ->
  remainder basis (products basis) columns sq c = Some room -> means c v ->
  0 <= v /\ (some_left basis room = true -> 0 < v).
Proof.
  intros Hs H Hc. unfold remainder in H.
  destruct (expanded basis columns sq) as [q|] eqn:Eq; [|discriminate].
  destruct (expanded_val _ _ _ _ Hs Eq) as [w [Hq Hw]].
  pose proof (means_sub _ _ _ _ _ _ Hc Hq) as [Dr Vr].
  set (rest := fsub c q) in *. set (terms := filter _ _) in *.
  set (p := map _ columns) in *.
  destruct (andb _ _) eqn:E; [|discriminate]. apply andb_prop in E as [E1 E2].
  apply Nat.eqb_eq in E1.
  destruct (dominated _ _ _ _ _) as [room'|] eqn:Ed; [|discriminate].
  destruct (forallb _ room') eqn:H1; [|discriminate]. injection H as ->.
  assert (Hp : length p = length basis) by (unfold p; now rewrite map_length).
  assert (Hpos : Forall (fun a => 0 < r a) p).
  { apply Forall_forall. intros a Ha. rewrite forallb_forall in E2. apply r_pos; auto. }
  destruct (dominated_val basis p Hs Hp Hpos _ _ _ (products_good basis) _ _
    (repeat_length _ _) Ed) as [HL V].
  unfold terms in V. rewrite raised_terms_val, Vr in V.
  assert (Z0 : dot (map bval (repeat [] (length basis))) (zz basis p) = 0).
  { generalize (zz basis p). generalize (length basis). clear. intros n. induction n as [|n IH]; intros [|z0 l]; cbn; auto.
    rewrite IH. ring. }
  rewrite Z0 in V.
  enough (P : 0 <= dot (map bval room) (zz basis p) /\
    (some_left basis room = true -> 0 < dot (map bval room) (zz basis p))).
  { destruct P as [P1 P2]. split.
    - assert (0 <= v - w) by (apply Rmult_le_reg_r with (r (den rest)); lra). lra.
    - intros L. specialize (P2 L). assert (0 < v - w) by (apply Rmult_lt_reg_r with (r (den rest)); lra). lra. }
  (* every entry is nonnegative, and that of the monomial 1 positive *)
  assert (G : forall basis room zs, length room = length basis ->
    Forall2 (fun v z => 0 <= z /\ (v = [] -> 0 < z)) basis zs ->
    forallb (forallb inonneg) room = true ->
    0 <= dot (map bval room) zs /\
    (some_left basis room = true -> 0 < dot (map bval room) zs)).
  { clear - Hs. induction basis as [|v basis IH]; intros [|a room] zs HL HZ HN;
      try discriminate; inversion HZ as [|? z ? zs' [Hz Hz1] HZ']; subst.
    { cbn. split; [lra|discriminate]. }
    cbn in HN. apply andb_prop in HN as [N1 N2]. cbn in HL. injection HL as HL.
    destruct (IH room zs' HL HZ' N2) as [A B]. pose proof (bval_nonneg a Hs N1) as C.
    pose proof (Rmult_le_pos _ _ C Hz) as D.
    split; [cbn; lra|]. unfold some_left in *. cbn [combine existsb fst snd map dot]. intros O.
    apply Bool.orb_prop in O as [O|O]; [|specialize (B O); lra].
    apply andb_prop in O as [O1 O2]. apply andb_prop in O2 as [O2 O3].
    apply Nat.ltb_lt in O2. destruct v; [|discriminate].
    pose proof (Rmult_lt_0_compat _ _ (bval_pos a Hs O2 O3) (Hz1 eq_refl)). lra. }
  apply (G basis room (zz basis p)); auto.
  assert (F2 : forall n l (f : nat -> R), length l = n ->
    (forall i, (i < n)%nat -> 0 <= f i /\ (nth i l [] = [] -> 0 < f i)) ->
    Forall2 (fun (v : mono) z => 0 <= z /\ (v = [] -> 0 < z)) l (map f (seq 0 n))).
  { clear. induction n as [|n IH]; intros [|v l] f L H; try discriminate; cbn; constructor.
    - exact (H O ltac:(lia)).
    - rewrite <- seq_shift, map_map. apply IH; [now injection L|].
      intros i Hi. exact (H (S i) ltac:(lia)). }
  apply F2; auto. intros i Hi. pose proof (p_nth basis p Hp Hpos i Hi) as A.
  split; [nra|]. intros Hv. unfold z. rewrite Hv. cbn.
  assert (0 < 1 / r (nth i p izero)) by (apply Rdiv_lt_0_compat; lra).
  now apply Rmult_lt_0_compat.
Qed.
Theorem is_positive_sound basis columns sq c v : 0 <= s <= 1 ->
  is_positive basis (products basis) columns sq c = true -> means c v -> 0 < v.
Proof.
  intros Hs H Hc. unfold is_positive in H. destruct (remainder _ _ _ _ _) as [room|] eqn:E; [|discriminate].
  now apply (remainder_sound _ _ _ _ _ _ Hs E Hc).
Qed.
Theorem is_nonneg_sound basis columns sq c v : 0 <= s <= 1 ->
  is_nonneg basis (products basis) columns sq c = true -> means c v -> 0 <= v.
Proof.
  intros Hs H Hc. unfold is_nonneg in H. destruct (remainder _ _ _ _ _) as [room|] eqn:E; [|discriminate].
  now apply (remainder_sound _ _ _ _ _ _ Hs E Hc).
Qed.
End At.
End Positive.
