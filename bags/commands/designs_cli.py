"""From a model, or equations, to what is proved of it: `nlsid funnel`, `push`, `compose`, `check`,
`report` and `tolerances`.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bags.commands.fleet_cli import SchedulerOption, WorkersOption
from bags.commands.options import BagsArgument, OutOption, out
from bags.commands.progress import progress_bar
from nlsid_core import deciding
from nlsid_core import second as second_kernel
from nlsid_core.errors import CertificateRejected

if TYPE_CHECKING:
    from bags.fleet.workers import Workers


def funnel(
    out_dir: OutOption,
    model: Annotated[
        Path | None, typer.Option(help="The model.json that `nlsid identify` wrote.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="The robot's YAML configuration.")] = None,
    problem: Annotated[
        Path | None,
        typer.Option(help="Dynamics, nominal and goal in a file; instead of model and config."),
    ] = None,
    require: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Status 1 if a half-width is more than this part of its output's range."
        ),
    ] = None,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
) -> None:
    """Design a proved funnel: funnel.json, funnel.proof.json, and policy.json if it has a policy.

    Around the simulation of an identified model of any class, and a plan of a linear one (--model,
    --config with a profile), or a trajectory of given dynamics (--problem). Of an identified model
    it says what it catches: faults put into the test trials, through the monitor. --workers and
    --scheduler share the L-steps of a --problem of shape P.
    """
    from bags.chain.config import load_config
    from bags.chain.steps import (
        design_funnel_files,
        what_a_funnel_catches,
        what_a_monitor_would_not_judge,
    )
    from bags.commands import show
    from bags.designs import documents
    from bags.fleet.workers import Workers
    from bags.pictures.report import write_catching

    if problem is not None:
        if not (model is None and config is None and require is None):
            raise typer.BadParameter(
                "--problem stands alone; it takes no --model, no --config and no --require"
            )
        _funnel_around_trajectory(problem, out_dir, Workers(workers, scheduler))
        return
    if workers or scheduler:
        raise typer.BadParameter("--workers and --scheduler share the search of a --problem")
    if model is None or config is None:
        raise typer.BadParameter("give --model and --config, or --problem")
    settings = load_config(config)
    with progress_bar("designing") as progress:
        progress("policy, observer and tube", 0.1)
        design = design_funnel_files(model, settings, out_dir)
        progress("sabotaging the test trials", 0.7)
        catching = what_a_funnel_catches(model, settings, design)
        progress("done", 1.0)
    out.print(show.funnel_table(design))
    if catching is None:
        out.print(f"what it catches is not known: no test trials in {documents.HELD_BACK}")
        if require is not None:
            raise typer.Exit(2)
    else:
        show.say_catching(out, catching, require)
    for line in what_a_monitor_would_not_judge(model, settings, design):
        show.warn(out, line)
    for path in (
        *(out_dir / name for name in design.documents()),
        *([] if catching is None else write_catching(out_dir, catching)),
    ):
        out.print(f"wrote {path}", soft_wrap=True)
    if catching is not None and require is not None and not catching.widest.share <= require:
        raise typer.Exit(1)


def _funnel_around_trajectory(problem: Path, out_dir: Path, workers: Workers) -> None:
    from bags.chain.problems import FunnelProblem
    from bags.designs import documents
    from bags.pictures.report import report_available
    from nlsid_core import files

    given = FunnelProblem.load(problem)
    with progress_bar("designing") as progress, workers.sharing() as executor:
        design = given.design(progress, executor=executor)
    for path in design.save(out_dir):
        out.print(f"wrote {path}", soft_wrap=True)
    if report_available():
        from bags.pictures.funnel_plots import write_funnel_picture

        picture = out_dir / documents.FUNNEL_PLOT
        write_funnel_picture(picture, design)
        out.print(f"wrote {picture}", soft_wrap=True)
    out.print(str(design), soft_wrap=True)
    if given.push is not None:
        path = out_dir / documents.PUSH
        files.write_document(path, given.push.document())
        out.print(f"wrote {path}", soft_wrap=True)
        out.print(f"measured, not proved: {given.push}", soft_wrap=True, markup=False)


def push(
    bags: BagsArgument,
    problem: Annotated[Path, typer.Option(help="The problem whose equations are compared.")],
    out_file: Annotated[Path, typer.Option("--out", help="The problem to write, with its push.")],
    response: Annotated[list[str], typer.Option("--response", "-y", help="A state; repeat.")],
    command: Annotated[list[str], typer.Option("--command", "-u", help="An input; repeat.")],
    period: Annotated[
        float, typer.Option(help="Seconds between samples; default: as they come.")
    ] = 0.0,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Over which a push is averaged; default one sample.")
    ] = 0.0,
    safety_factor: Annotated[
        float, typer.Option(min=1.0, help="Of the box over the largest push that was measured.")
    ] = 1.5,
    resample: Annotated[
        str, typer.Option(help="none, last or linear: see grid.resample.")
    ] = "none",
) -> None:
    """Measure on bags how far a problem's equations are off; `nlsid funnel` proves with that.

    States and inputs in the equations' order and units. The problem that is written has a member
    `push`: the largest of each trial with its digest.
    """
    from bags.chain.problems import measured
    from bags.commands import show
    from bags.recordings.folders import expand_bags
    from nlsid_core import files

    given, broken = measured(
        problem, expand_bags(bags), responses=response, excitations=command, period=period or None,
        seconds=seconds or None, safety_factor=safety_factor, resample=resample,
    )  # fmt: skip
    files.write_document(out_file, given.document())
    assert given.push is not None  # `measured` has just measured it
    out.print(str(given.push), soft_wrap=True, markup=False)
    out.print(show.breaking_table(broken))
    out.print(f"wrote {out_file}", soft_wrap=True)


def compose(
    proofs: Annotated[
        list[Path],
        typer.Argument(help="funnel.proof.json files, in the order of time."),
    ],
    out_dir: OutOption,
) -> None:
    """Bind proofs of funnels that follow each other into one claim, for `check`."""
    from nlsid_core.design import compose_funnels

    path = compose_funnels(proofs, out_dir)
    out.print(f"wrote {path} and {4 * len(proofs)} files of its stages", soft_wrap=True)


def check(
    proofs: Annotated[list[Path], typer.Argument(help="Proof files (FILE.proof.json).")],
    second: Annotated[
        bool, typer.Option("--second", help="Also ask the checker that Coq proves right.")
    ] = False,
    seconds: Annotated[
        int, typer.Option(min=1, help="Processor time that a proof may take.")
    ] = deciding.SECONDS,
    memory: Annotated[int, typer.Option(min=1, help="MB that a proof may take.")] = deciding.MEMORY,
) -> None:
    """Decide proofs without a solver: PROVED (status 0), or REJECTED (status 1).

    Below the verdict stands what its assumptions were measured on, which is not proved: status 1 if
    that contradicts itself. Status 2 if a proof cannot be read, so that nothing was decided about
    it, or if the second kernel was asked and has no opinion of it.
    """
    from bags.designs.provenance import of_proof

    status = 0
    for path in proofs:
        name = str(path) if str(path).isprintable() else ascii(str(path))
        try:
            at_work = deciding.Deciding(path, seconds=seconds, memory=memory, remembered=False)
            said = str(at_work.wait())
            word, _, rest = said.partition(" ")
            typer.echo(said if len(proofs) == 1 else f"{word} {name}: {rest}")
            provenance = of_proof(path)
            for line in provenance.said:
                typer.echo(f"  measured, not proved: {line}")
            for line in provenance.wrong:
                typer.echo(f"  CONTRADICTED {line}")
                status = max(status, 1)
            if second:
                opinion = second_kernel.opinion(path)
                typer.echo(f"  {opinion}")
                status = max(status, {"accepted": 0, "refused": 1}.get(opinion.verdict, 2))
        except CertificateRejected as refusal:
            status = max(status, 1)
            typer.echo(f"REJECTED {name}: {refusal}")
        except OSError as error:
            status = 2
            typer.echo(f"NOT READ {name}: {error.strerror}")
    raise typer.Exit(status)


def report(
    folder: Annotated[Path, typer.Argument(help="A design folder, of any kind.")],
    bags: Annotated[
        list[Path] | None,
        typer.Argument(help="Their losses are listed; those that made no part of it are judged."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="Takes `split.validation` (bags that are not judged) and `monitor`."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option("--out", help="The page; default DIR/design.html.")
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Also as PDF beside the page; needs Chromium or Chrome.")
    ] = False,
) -> None:
    """Make one page of a design folder: proofs, model, what it catches, pictures, recordings.

    The proofs are decided again. Of the bags, those are held against the funnel that it was not
    made with. The page needs nothing else, and prints.
    """
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.designs import documents
    from bags.monitoring.replay import replay_bag, to_judge
    from bags.monitoring.watch import Watch
    from bags.pictures.folder_report import print_page, write_folder_report
    from bags.pictures.report import report_available
    from bags.recordings.folders import expand_bags
    from bags.tools.info import bag_info

    settings = load_config(config) if config is not None else None
    target = page or folder / documents.DESIGN_REPORT
    recordings, replays, drawn = [], [], ""
    used: list[str] = []
    if bags:
        proved = documents.load_proved(documents.funnel_of(folder))
        folders = expand_bags(bags)
        topics = Watch(proved.design, centre=show.centre_of(settings)).pairing.topics
        with progress_bar("reading") as progress:
            for done, bag in enumerate(folders):
                progress(bag.name, done / len(folders))
                recordings.append(bag_info(bag, topics=topics))
        validation = settings.split.validation if settings is not None else ()
        chosen = to_judge(proved.design, folders, validation=validation)
        with progress_bar("replaying") as progress:
            for done, bag in enumerate(chosen.judged):
                progress(bag.name, done / len(chosen.judged))
                replays.append(replay_bag(proved, bag, centre=show.centre_of(settings)))
        used = chosen.said
        out.print(show.replay_table(replays))
        for line in used:
            out.print(line, soft_wrap=True, markup=False, highlight=False)
        if report_available() and all(entry.half_width for entry in replays):
            from bags.pictures import plots

            drawn = plots.svg(plots.margins(replays))
    write_folder_report(
        folder, target, recordings=recordings, replays=replays, used=used, drawn=drawn
    )
    out.print(f"wrote {target}", soft_wrap=True)
    if pdf:
        print_page(target, target.with_suffix(".pdf"))
        out.print(f"wrote {target.with_suffix('.pdf')}", soft_wrap=True)


def tolerances(
    folder: Annotated[Path, typer.Argument(help="Folder of a design: funnel.json, its proof, ...")],
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files; default the design's.")
    ] = None,
) -> None:
    """Write proved tolerances: joint_trajectory_controller.yaml, validator.yaml, tolerances.txt.

    Path and goal tolerances of ros2_control's joint_trajectory_controller for positions, thresholds
    of Autoware's validators for speeds and distances, and a table of all signals.
    """
    from bags.designs import tolerances as proved

    found = proved.tolerances(folder)
    target = folder if out_dir is None else out_dir
    target.mkdir(parents=True, exist_ok=True)
    out.print(str(found), soft_wrap=True, markup=False, highlight=False)
    written = found.write(target)
    for path in written:
        out.print(f"wrote {path}", soft_wrap=True)
    for name, units in ((proved.CONTROLLER, proved.POSITIONS), (proved.VALIDATOR, ("m/s", "m"))):
        if target / name not in written:
            out.print(f"no {name}: no signal is in {' or '.join(units)}", soft_wrap=True)
