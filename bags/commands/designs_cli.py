"""From a model, or equations, to what is proved of it: `nlsid funnel`, `check`, `report`, `export`;
and `nlsid learn`, all steps in one.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bags.commands import models_cli
from bags.commands.options import (
    CONFIG,
    BagsArgument,
    ConfigOption,
    DefinitionsOption,
    DesignArgument,
    Signals,
    SomeBagsArgument,
    VerboseOption,
    Wired,
    config_of,
    out,
    progress_bar,
    settings_if_any,
)
from nlsid_core import deciding
from nlsid_core import second as second_kernel
from nlsid_core.errors import CertificateRejected, DataError, DocumentError, SolverError

MODELS = 3  # that may be tried before there is one with a tube

if TYPE_CHECKING:
    from bags.chain.config import Config
    from nlsid_core.design import OutputTubeDesign


@dataclass(frozen=True)
class Given:
    """What a funnel is designed for in the place of a model, and how often it may be wrong."""

    problem: Annotated[
        Path | None,
        typer.Option(help="Take dynamics, motion and goal from this file instead of a model."),
    ] = None
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Average a push over this long; default one sample.")
    ] = 0.0
    safety_factor: Annotated[
        float,
        typer.Option(min=1.0, help="How much wider the box is than the largest push."),
    ] = 1.5
    false_alarms: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="In which part of further trials a healthy robot may raise an alarm; takes the "
            "place of funnel.safety_factor.",
        ),
    ] = None
    compose: Annotated[
        list[Path] | None,
        typer.Option(help="Join the funnels of these folders, in the order of time; repeat."),
    ] = None
    verbose: VerboseOption = False


def funnel(
    folder: DesignArgument,
    given: Given,
    wired: Wired,
    bags: SomeBagsArgument = None,
    config: ConfigOption = None,
) -> None:
    """Design a proved funnel in DIR: funnel.json, funnel.proof.json, policy.json if it has one.

    Without options it is around the simulation of the model in DIR, and of a linear one's plan
    too; it then says what faults it catches. If the configuration has a motion, it is around that
    motion, and BAG... measure the disturbance. With --problem it is around a trajectory of given
    equations, and BAG... with -y and -u measure how far these are off. --compose joins funnels
    that follow each other.
    """
    from bags.chain.config import load_config
    from bags.chain.tracking_config import is_tracking, load_tracking_config
    from bags.recordings.folders import expand_bags

    if given.compose:
        from bags.designs.documents import FUNNEL_PROOF
        from nlsid_core.design import compose_funnels

        proofs = [p / FUNNEL_PROOF if p.is_dir() else p for p in given.compose]
        path = compose_funnels(proofs, folder)
        out.print(f"wrote {path} and {4 * len(given.compose)} files of its stages", soft_wrap=True)
        return
    if given.problem is not None:
        if config is not None:
            raise typer.BadParameter("--problem takes no --config")
        _around_trajectory(folder, given, wired, expand_bags(bags) if bags else [])
        return

    path = config_of(folder, config)
    if not is_tracking(path):
        tube(folder, load_config(path), given.false_alarms)
        return
    if not bags:
        raise typer.BadParameter("give the bags on which the disturbance is measured")
    from bags.commands import states

    states.funnel(expand_bags(bags), load_tracking_config(path), folder)


def tube(folder: Path, settings: Config, false_alarms: float | None = None) -> OutputTubeDesign:
    """Design a tube around the model in a folder, and what it catches.

    false_alarms: in place of what the settings say, None for that.
    """
    from bags.chain.steps import design_funnel_files, what_a_funnel_catches
    from bags.commands import show
    from bags.designs import documents
    from bags.pictures import tables
    from bags.pictures.report import write_catching

    model = folder / documents.MODEL
    with progress_bar("designing") as progress:
        progress("policy, observer and tube", 0.1)
        design = design_funnel_files(model, settings, folder, false_alarms)
        progress("sabotaging the test trials", 0.7)
        catching = what_a_funnel_catches(model, settings, design)
        progress("done", 1.0)
    show.say_tube(out, design)
    tables.say_catching(out, catching)
    written = [folder / name for name in design.documents()]
    show.say_written(out, [*written, *write_catching(folder, catching)])
    return design


def _around_trajectory(folder: Path, given: Given, wired: Wired, bags: list[Path]) -> None:
    """Design a funnel for given equations, and for what they leave out of bags if there are any."""
    from bags.chain.problems import load_problem, measured
    from bags.commands import show
    from bags.designs import documents
    from nlsid_core import files
    from nlsid_core.design import design

    assert given.problem is not None
    problem, push, wiring = load_problem(given.problem), None, wired.wiring()
    if bool(bags) != (wiring is not None):
        raise DataError(
            "how far the equations are off is measured in BAG..., with -y for the state and -u for "
            "the inputs: give all three, or none"
        )
    if wiring is not None:
        field: Any = problem.dynamics
        push = measured(
            field,
            bags,
            wiring,
            seconds=given.seconds or None,
            safety_factor=given.safety_factor,
        )
        problem = replace(problem, dynamics=field.pushed(push.box))

    with progress_bar("designing") as progress:
        made = design(problem, progress=progress)
    for path in (*made.save(folder), *show.draw_tube(folder, made)):
        out.print(f"wrote {path}", soft_wrap=True)
    out.print(str(made), soft_wrap=True)
    if push is not None:
        path = folder / documents.PUSH
        files.write_document(path, push.document())
        out.print(f"wrote {path}", soft_wrap=True)
        out.print(f"measured, not proved: {push}", soft_wrap=True, markup=False)


def check(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Designs' folders, or files (FILE.proof.json)."),
    ],
    second: Annotated[
        bool, typer.Option("--second", help="Ask the checker that Coq proves right, too.")
    ] = False,
    seconds: Annotated[
        int, typer.Option(min=1, help="Seconds of processor time that a proof may take.")
    ] = deciding.USUAL.seconds,
    memory: Annotated[
        int, typer.Option(min=1, help="MB that a proof may take.")
    ] = deciding.USUAL.memory,
) -> None:
    """Check proofs in exact arithmetic, without a solver: PROVED (status 0) or REJECTED (1).

    The lines below the verdict say what its assumptions were measured on. That is not proved, but
    status is 1 if it contradicts itself. Status 2: a proof could not be read, or the second
    kernel was asked and has no opinion of it.
    """
    raise typer.Exit(decided(paths, deciding.Limits(seconds, memory), second=second))


def decided(paths: list[Path], limits: deciding.Limits, *, second: bool = False) -> int:
    """Say of every proof whether it is one; the status that `check` ends with."""
    from bags.designs.provenance import of_proof

    status = 0
    proofs = [proof for path in paths for proof in _proofs(path)]
    for path in proofs:
        name = str(path) if str(path).isprintable() else ascii(str(path))
        try:
            said = str(deciding.Deciding(path, limits, remembered=False).wait())
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
        except (OSError, DocumentError) as error:  # the latter of what the kernel does not read
            status = 2
            typer.echo(f"NOT READ {name}: {getattr(error, 'strerror', error)}")
    return status


def _proofs(path: Path) -> list[Path]:
    """The proofs in a folder, or the proof itself; DocumentError if the path is neither."""
    proofs = sorted(path.glob("*.proof.json")) if path.is_dir() else [path]
    if not any(proof.name.endswith(".proof.json") for proof in proofs):
        raise DocumentError(
            f"{path} is no FILE.proof.json, and no folder that has one: `nlsid identify` and "
            "`nlsid funnel` write them"
        )
    return proofs


def report(
    folder: DesignArgument,
    bags: SomeBagsArgument = None,
    config: ConfigOption = None,
    page: Annotated[
        Path | None, typer.Option("--out", help="The page; default DIR/design.html.")
    ] = None,
) -> None:
    """Write one page about a design: proofs, model, what it catches, pictures, recordings.

    The proofs are checked again. Bags that the design was not made with are held against its
    funnel. The page is one file, and can be printed.
    """
    from bags.commands import show
    from bags.commands.page import folder_page, recorded
    from bags.designs import documents
    from bags.designs.wiring import sampler_of
    from bags.monitoring.replay import to_judge
    from bags.recordings.folders import expand_bags
    from bags.tools.info import bag_info
    from nlsid_core import files

    target = page or folder / documents.DESIGN_REPORT
    held: dict[str, str] = {}
    if bags:
        settings = settings_if_any(folder, config)
        design, folders = documents.load(folder), expand_bags(bags)
        topics = sampler_of(design).topics
        with progress_bar("reading") as progress:
            recordings = []
            for done, bag in enumerate(folders):
                progress(bag.name, done / len(folders))
                recordings.append(bag_info(bag, topics=topics, messages=True))
        chosen = to_judge(design, folders)
        replays = show.replayed(design, chosen.judged, settings)
        held = recorded(recordings, replays, chosen.said)
        out.print(show.replay_table(replays))
        for line in chosen.said:
            out.print(line, soft_wrap=True, markup=False, highlight=False)
    files.write_atomically(target, folder_page(folder, held).encode())
    out.print(f"wrote {target}", soft_wrap=True)


def export(
    folder: DesignArgument,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files; default the design's.")
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option("--c", help="Write a linear tube's table for a monitor in C instead."),
    ] = None,
) -> None:
    """Write proved tolerances: joint_trajectory_controller.yaml, validator.yaml, tolerances.txt.

    These are path and goal tolerances of ros2_control's joint_trajectory_controller for positions,
    thresholds of Autoware's validators for speeds and distances, and a table of all signals. The
    tube's width has to be constant: `funnel: {level: constant}` in the configuration.
    """
    from bags.designs import documents, tolerances
    from nlsid_core.running.c_table import write_table

    if table is not None:
        out.print(
            f"{write_table(documents.load(folder), table)}\nwrote {table}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
        return

    found = tolerances.tolerances(folder)
    target = folder if out_dir is None else out_dir
    target.mkdir(parents=True, exist_ok=True)
    out.print(str(found), soft_wrap=True, markup=False, highlight=False)
    written = found.write(target)
    for path in written:
        out.print(f"wrote {path}", soft_wrap=True)
    kinds = (
        (tolerances.CONTROLLER, tolerances.POSITIONS),
        (tolerances.VALIDATOR, ("m/s", "m")),
    )
    for name, units in kinds:
        if target / name not in written:
            out.print(f"no {name}: no signal is in {' or '.join(units)}", soft_wrap=True)


def learn(
    bags: BagsArgument,
    signals: Signals,
    folder: Annotated[Path, typer.Option("--out", help="The design's folder.")] = Path("design"),
    definitions: DefinitionsOption = None,
    _verbose: VerboseOption = False,
) -> None:
    """Make a checked design from bags: init, identify, funnel, check and report, asking nothing.

    The configuration that it uses is written too: robot.yaml. Where a person has to decide, it
    ends with the reason and status 2. Status 1: nothing can be identified from these bags.
    """
    from bags.chain.config import load_config
    from bags.recordings.folders import expand_bags
    from bags.setup.proposing import take_next
    from bags.setup.written import yaml_text
    from nlsid_core.files import write_atomically

    proposal = models_cli.proposed(folder, bags, signals, definitions, robot="robot")
    for left in reversed(range(MODELS)):
        settings = load_config(folder / CONFIG)
        try:
            models_cli.identify_here(expand_bags(bags), settings, folder)
            tube(folder, settings)
            break
        except (DataError, SolverError) as refusal:
            taken = take_next(proposal, refusal) if left else ""
            if not taken:
                raise
            write_atomically(folder / CONFIG, yaml_text(proposal).encode())
            said = (
                f"no tube of it: {refusal}; the next best is taken: {taken}; {proposal.expectation}"
            )
            out.print(said, soft_wrap=True, markup=False)
    status = decided([folder], deciding.USUAL)
    report(folder)
    out.print(f"next: nlsid monitor {folder} BAG...; nlsid run monitor {folder}", soft_wrap=True)
    raise typer.Exit(status)
