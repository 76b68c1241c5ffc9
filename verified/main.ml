(* second WORDS: "accepted" (status 0) or "refused" (status 1). Reads what generate.py writes (printed.words):
   whole numbers in a row; a list begins with its length, an option with 0 or 1. *)
open Checker

let input = Scanf.Scanning.open_in Sys.argv.(1)
let word () = Scanf.bscanf input " %s" (fun s -> if s = "" then failwith "too short" else s)
let whole () = Big_int_Z.big_int_of_string (word ())
let count () = int_of_string (word ())
let listed read =
  let rec go n acc = if n = 0 then List.rev acc else go (n - 1) (read () :: acc) in
  go (count ()) []
let pair first second () = let a = first () in let b = second () in (a, b)
let entry () : i = Obj.magic (whole ())

let num () =
  let p, q = pair whole whole () in
  if Big_int_Z.sign_big_int q <= 0 then failwith "a denominator"; (p, q)
let nums () = listed num
let matrix () = listed nums
let equation () = listed (pair (fun () -> listed count) num)
let maybe read () = if count () = 0 then None else Some (read ())
let ends () = pair num num ()
let field () =
  let states = count () in let inputs = count () in let uncertain = listed ends in
  let breaks = nums () in let valid = listed (pair (pair count ends) (maybe count)) in
  { states; inputs; uncertain; breaks; valid; spans = listed (fun () -> listed equation) }
let policy () =
  let feeds = listed matrix in let feedback = listed (fun () -> listed matrix) in
  { feeds; feedback; clips = listed (pair count ends) }
let funnel () =
  let knots = nums () in let nominals = listed matrix in let shapes = listed matrix in
  { knots; nominals; shapes; levels = nums () }
let squares () =
  let unit0 = whole () in let scale = entry () in
  { unit0; scale; factors = listed (fun () -> listed (pair entry (fun () -> listed entry))) }
let wholes () = listed whole
let piece () =
  let depth = whole () in let index = whole () in
  let vertex = count () in let mode = count () in
  let kappa = nums () in let mu = listed (pair whole (pair entry entry)) in
  let columns = wholes () in let gram_factors = squares () in
  { depth; index; vertex; mode; kappa; mu; columns; gram_factors; tau = listed (pair wholes squares) }
let rate_piece () =
  let whose = count () in let upward = count () = 1 in { whose; upward; part = piece () }
let witness () =
  let margin = num () in
  let basis = listed wholes in let multiplier = listed wholes in let sides = listed wholes in
  let pieces = listed (fun () -> listed piece) in
  let pushed = count () = 1 in
  { margin; basis; multiplier; sides; pieces; pushed; goal_multiplier = num () }

let mapping () = match count () with
  | 0 -> Broken (listed (pair num num))
  | 1 -> let low = num () in let spacing = num () in Spline (low, spacing, nums ())
  | _ -> failwith "a map"
let model () = match count () with
  | 0 -> Linear (nums ())
  | 1 ->
    let p = count () in let n = count () in let scale = nums () in
    let range = listed (pair num num) in
    Affine (p, n, scale, range, listed (pair (fun () -> listed count) matrix))
  | 2 ->
    let e1 = num () in let e2 = num () in let e3 = num () in let a = nums () in
    Monotone (e1, e2, e3, a, matrix ())
  | 3 ->
    let maps = listed mapping in
    let into = matrix () in let next = matrix () in Cells (maps, into, next, matrix ())
  | _ -> failwith "a model"
let tube () =
  let fading = num () in let gain = matrix () in let storage = matrix () in
  let weight = matrix () in let tau0 = nums () in let widths = nums () in
  let top = num () in { fading; gain; storage; weight; tau0; widths; top; inlet = num () }
let stated_ends () =
  let low_end = num () in let high_end = num () in let low_weights = nums () in
  { low_end; high_end; low_weights; high_weights = nums () }
let rec tree () = match count () with
  | 0 -> let stated = maybe stated_ends () in Leaf (stated, listed matrix)
  | 1 -> let i = count () in let lower = tree () in Split (i, lower, tree ())
  | _ -> failwith "a tree"

let stage () =
  let dynamics = field () in let control = policy () in let tunnel = funnel () in
  { dynamics; control; tunnel; aim = maybe (pair nums matrix) () }
let map () =
  let powers0 = listed (fun () -> listed count) in let coefficients = matrix () in
  let x_range = listed ends in { powers0; coefficients; x_range; u_range = listed ends }
let track () =
  let inputs0 = matrix () in let states1 = matrix () in
  { inputs0; states1; feedback0 = listed matrix }
let assumption () = match count () with
  | 0 -> Response | 1 -> Peak | 2 -> Energy | 3 -> Fading | _ -> failwith "an assumption"
let sampled () =
  let assumed_form = assumption () in let bound = num () in
  let forgets_by = num () in let weighs = num () in
  let tube_radii = nums () in let inlet_radii = nums () in let half_widths = matrix () in
  let scales = listed matrix in
  { assumed_form; bound; forgets_by; weighs; tube_radii; inlet_radii; half_widths; scales;
    responses = listed matrix }
let chain () =
  let reach = num () in let shifts = wholes () in let rest = squares () in
  let ball_shifts = wholes () in { reach; shifts; rest; ball_shifts; ball = squares () }
let link () =
  let frame = matrix () in let kappa0 = num () in let curvature = nums () in
  let of_tube = chain () in { frame; kappa0; curvature; of_tube; of_inlet = chain () }
let links () =
  let basis0 = listed wholes in let ball_basis = listed wholes in
  { basis0; ball_basis; linked0 = listed link }

let () =
  let accepted = match word () with
    | "funnel" ->
      let f = field () in let p = policy () in let u = funnel () in
      let g = maybe (pair nums matrix) () in decide_funnel f p u g (witness ())
    | "held" ->
      let f = field () in let p = policy () in let u = funnel () in
      let g = maybe (pair nums matrix) () in
      let period = num () in let errors = nums () in
      let w = witness () in let rates = matrix () in
      decide_held f p u g period errors w rates (listed (fun () -> listed rate_piece))
    | "tube" -> let m = model () in let ts = listed tube in decide_tubes m ts (listed tree)
    | "plan" ->
      let m = model () in let ts = listed tube in let proofs = listed tree in
      let a = nums () in let b = nums () in let b0 = num () in
      let feedback = nums () in
      decide_tubes m ts proofs && decide_plans a b b0 feedback ts
    | "stability" ->
      let m = model () in let storage = matrix () in let rate = num () in
      decide_stability m storage rate (tree ())
    | "composed" ->
      let gs = listed stage in let ws = listed witness in decide_composed gs ws (nums ())
    | "sampled" ->
      let m = map () in let p = track () in let s = sampled () in decide_sampled m p s (links ())
    | _ -> failwith "a kind" in
  if accepted then print_endline "accepted" else (print_endline "refused"; exit 1)
