"""`nlsid gain` and the loops of `nlsid compose`, from model files."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bags.chain.gains import Gain
from bags.chain.training import save_training
from bags.commands.cli import app
from bags.commands.show import gain_lines, named_number
from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import CertificateRejected, DataError, Infeasible, NlsidError
from nlsid_core.identification import prove_gain
from nlsid_core.kernel import Verdict
from nlsid_core.models import (
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    PiecewiseLinear,
    Signal,
    StateAffineModel,
)
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.proofs import check
from tests.core.kernel.dissipation_claims import curved, feedthrough, integrator, moving
from tests.core.kernel.stability_claims import U, Y, linear

RUN = CliRunner()


def written(folder: Path, model: object, name: str = "model") -> Path:
    path = folder / f"{name}.json"
    files.write_document(path, model.document())  # type: ignore[attr-defined]
    return path


def test_the_gain_of_a_model_is_printed_between_proof_and_runs(tmp_path: Path) -> None:
    """The peak of its frequency response is 1.125627."""
    model = written(tmp_path, linear())
    result = RUN.invoke(app, ["gain", str(model)])
    assert result.exit_code == 0, result.output
    first, second, proved, wrote = result.output.splitlines()
    assert first == "gain at most 1.126 m/s per V: proved, of the model"
    assert second.startswith("at least 1.125 m/s per V: two simulated runs, a wave of 3.75 Hz, ")
    assert proved.startswith("PROVED incremental gain: two runs of the model satisfy ")
    proof = tmp_path / "model.gain.proof.json"
    assert wrote == f"wrote {proof}"
    assert "G = 1.126" in str(check(proof))


@pytest.mark.parametrize(("a", "b", "c"), [(0.5, 1e-4, 8.8e8), (0.9, 1e-6, 5.8e5)])
def test_runs_do_not_differ_by_more_than_is_proved_however_large_outputs_are(
    tmp_path: Path, a: float, b: float, c: float
) -> None:
    """y = a y(t-1) + b u(t-1) + c has the gain b/(1 - a); y itself is some 1e9."""
    model = DifferenceEquation(
        np.array([a]), np.array([0.0, b]), c, 0.1, Signal("y", "m"), Signal("u", "V"), (-1.0, 1.0)
    )  # fmt: skip
    result = RUN.invoke(app, ["gain", str(written(tmp_path, model))])
    assert result.exit_code == 0, result.output
    proved, seen = map(float, re.findall(r"at (?:most|least) (\S+)", result.output)[:2])
    assert 0.99 * b / (1 - a) < seen <= b / (1 - a) * 1.0001
    assert b / (1 - a) <= proved < 1.01 * b / (1 - a)


def test_an_index_of_passivity_is_a_proof_of_its_own(tmp_path: Path) -> None:
    """1/(1 - 0.5/z) has the least real part 2/3."""
    model = written(tmp_path, feedthrough())
    result = RUN.invoke(app, ["gain", str(model), "--passivity"])
    assert result.exit_code == 0, result.output
    assert result.output.startswith("passivity index at least 0.6665 m/s per V: proved, of the")
    assert "\nat most 0.6667 m/s per V: two simulated runs, " in result.output
    assert (tmp_path / "model.passivity.proof.json").is_file()


def test_what_has_no_gain_is_not_proved_but_with_a_discount(tmp_path: Path) -> None:
    model = written(tmp_path, integrator())
    result = RUN.invoke(app, ["gain", str(model)])
    assert result.exit_code == 1
    assert result.output.startswith("NOT PROVED")
    assert not (tmp_path / "model.gain.proof.json").exists()
    result = RUN.invoke(app, ["gain", str(model), "--discount", "0.875"])
    assert result.exit_code == 0, result.output
    assert result.output.startswith("gain at most 1.449 m/s per V, with discount 0.875: proved")
    assert "not compared with simulated runs" in result.output


def test_a_scale_takes_the_unit_away(tmp_path: Path) -> None:
    model = written(tmp_path, linear())
    result = RUN.invoke(app, ["gain", str(model), "--scale", "speed=0.5"])
    said = "gain at most 2.252: proved, of the model, speed in units of 0.5 m/s\n"
    assert result.output.startswith(said)
    proof = json.loads((tmp_path / "model.gain.proof.json").read_text())
    assert proof["claim"]["scales"] == {"u": [1.0], "y": [0.5]}


@pytest.mark.parametrize("given", ["speed", "=2", "speed=fast", "speed=nan"])
def test_a_scale_that_is_none_is_refused(given: str) -> None:
    with pytest.raises(DataError, match=r"NAME=VALUE"):
        named_number(given)


def test_scales_of_unknown_signals_or_of_no_size_are_refused(tmp_path: Path) -> None:
    model = written(tmp_path, linear())
    result = RUN.invoke(app, ["gain", str(model), "--scale", "sped=0.5"])
    assert isinstance(result.exception, DataError)
    assert "no signal is called sped; the model has speed, command" in str(result.exception)
    result = RUN.invoke(app, ["gain", str(model), "--scale", "speed=0"])
    assert "all positive" in str(result.exception)
    result = RUN.invoke(app, ["gain", str(model), "--scale", "speed=2", "--scale", "speed=3"])
    assert "--scale speed is given twice" in str(result.exception)
    result = RUN.invoke(app, ["gain", str(model), "--discount", "1.5"])
    assert "discount should satisfy" in str(result.exception)


def test_a_model_that_needs_a_box_says_so_where_no_trials_lie_beside_it(tmp_path: Path) -> None:
    model = written(tmp_path, moving())
    result = RUN.invoke(app, ["gain", str(model)])
    assert isinstance(result.exception, DataError)
    assert "needs a box of its outputs" in str(result.exception)
    assert "training.npz, and these are not beside the model" in str(result.exception)


@pytest.mark.parametrize("model", [curved(), moving()])  # moving: on a box
def test_a_model_that_clips_its_inputs_is_refused_an_index_with_the_reason(
    tmp_path: Path, model: StateAffineModel
) -> None:
    y, u = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 50))
    trial = Trajectory(t=0.1 * np.arange(50), y=y, u=u, name="run")
    training = save_training(tmp_path / "training.npz", Dataset((trial,)))
    path = written(tmp_path, replace(model, training=training))
    result = RUN.invoke(app, ["gain", str(path), "--passivity"])
    assert isinstance(result.exception, DataError)
    assert "clips its inputs to a range, and no index of passivity is proved" in str(
        result.exception
    )


def test_the_box_that_runs_have_to_stay_in_is_said_where_the_gain_is(tmp_path: Path) -> None:
    model = moving()
    [signal] = model.y
    proof = prove_gain(model, box={"y": [[-1.0, 1.5]]})
    assert proof is not None
    verdict = Verdict("dissipation", "made up", Fraction(1))
    said = gain_lines(Gain(model, proof, verdict, None, tmp_path))[0]
    box = f"{signal.name} in [-1, 1.5] {signal.unit}".rstrip()
    assert said.endswith(f"proved, of the model, for runs that stay in a box: {box}")


def test_a_gain_of_a_model_without_inputs_is_refused_with_words() -> None:
    free = ImplicitModel(
        h=Polynomials(np.array([[1, 0], [3, 0], [0, 1]]), np.array([[1.0], [0.1], [-0.5]])),
        shift=Polynomials(np.zeros((0, 1), dtype=np.int64), np.zeros((0, 0))),
        monotonicity=0.9, period=0.1, states=("x",), inputs=(), y=(Y,),
    )  # fmt: skip
    with pytest.raises(DataError, match="the model has no inputs, so nothing drives two runs"):
        prove_gain(free)


def test_a_gain_is_found_where_most_inputs_move_nothing_that_is_seen() -> None:
    """Two cells, the second behind the first: a storage is much more than what the mean shows."""
    knots = np.array([-0.47, -0.34, -0.21, -0.09, 0.04, 0.17, 0.29])
    levels = np.array([-1.03, -0.02, 0.98, 1.99, 3.0, 4.01, 5.01])
    given = (
        (knots, [-0.0188, 0.017, 0.0488, 0.0617, 0.0689, 0.0698, 0.0853]),
        ([-0.729, 0.271, 1.271], [-0.729, 0.271, 0.271]),
        (knots, [0.0, 0.0418, -0.0811, -0.0475, 0.136, 0.367, 0.538]),
        (levels, [-0.608, 0.168, 0.98, 1.79, 2.6, 3.4, 4.22]),
        ([4.37, 5.37, 6.37], [4.37, 5.37, 5.37]),
        (levels, [0.0, 0.156, 0.318, 0.467, 0.627, 0.785, 0.959]),
    )
    maps = tuple((np.array(k, dtype=float), np.array(v, dtype=float)) for k, v in given)
    into = np.zeros((6, 10))
    for row, entries in enumerate((
        {6: 1.0}, {0: 1.0, 8: 0.45, 9: 0.002}, {6: 1.0}, {7: 1.0},
        {0: -0.575, 1: 0.575, 2: 1.0, 3: 1.0, 8: 0.537, 9: 0.0024}, {7: 1.0},
    )):  # fmt: skip
        for column, entry in entries.items():
            into[row, column] = entry
    after, seen = np.eye(10)[[1, 4]], 0.17 * np.eye(10)[[7]]
    model = CellNetwork(
        maps=tuple(PiecewiseLinear(k, v) for k, v in maps),
        into=into, next=after, output=seen, start=np.array([-0.04, 2.08]), start_samples=20,
        period=0.05, y=(Y,), u=(U,),
    )  # fmt: skip
    proof = prove_gain(model)
    assert proof is not None

    def outputs(u: FloatArray) -> FloatArray:
        x, y = model.start, []
        for now in u:
            q = np.r_[np.zeros(6), x, now, 1.0]
            for j, (at, value) in enumerate(maps):
                reached = float(into[j] @ q)
                left, right = (np.diff(value) / np.diff(at))[[0, -1]]
                beyond = left * min(reached - at[0], 0.0) + right * max(reached - at[-1], 0.0)
                q[j] = np.interp(reached, at, value) + beyond
            y.append(float(seen[0] @ q))
            x = after @ q
        return np.array(y)

    rng = np.random.default_rng(1)
    ratios = []
    for size in np.geomspace(0.01, 10.0, 12):
        u = size * np.cumsum(rng.standard_normal((2, 300)), axis=1) / 10.0
        apart = outputs(u[0]) - outputs(u[1])
        ratios.append(np.linalg.norm(apart) / np.linalg.norm(u[0] - u[1]))
    assert 0.1 < max(ratios) <= proof.number < 2.0


def heard(gain: float) -> DifferenceEquation:
    return DifferenceEquation(
        np.array([0.25]), np.array([0.1, 0.3]) * gain, 0.0, 0.025, Signal("voltage", "V"),
        Signal("heard", "m/s"), (-1.0, 1.0),
    )  # fmt: skip


def test_two_gains_are_composed_into_a_loop(tmp_path: Path) -> None:
    proofs = []
    for name, model in (("car", linear()), ("other", heard(1.0))):
        path = written(tmp_path, model, name)
        assert RUN.invoke(app, ["gain", str(path)]).exit_code == 0
        proofs.append(str(tmp_path / f"{name}.gain.proof.json"))
    result = RUN.invoke(app, ["compose", *proofs, "--out", str(tmp_path / "loop")])
    assert result.exit_code == 0, result.output
    assert result.output.startswith("PROVED small gain: ")
    verdict = check(tmp_path / "loop" / "small_gain.proof.json")
    assert float(verdict.margin) == pytest.approx(1 - 1.125627 * 0.4 / 0.75, abs=1e-3)
    swapped = RUN.invoke(app, ["compose", *proofs[::-1], "--out", str(tmp_path / "swapped")])
    assert swapped.exit_code == 0


def test_a_loop_that_is_not_small_or_does_not_fit_is_refused(tmp_path: Path) -> None:
    same = DifferenceEquation(np.array([0.5]), np.array([0.1, 0.1]), 0.0, 0.025, Y, U, (-1.0, 1.0))
    paths = {}
    for name, model in (("car", linear()), ("loud", heard(2.0)), ("same", same)):
        assert RUN.invoke(app, ["gain", str(written(tmp_path, model, name))]).exit_code == 0
        paths[name] = str(tmp_path / f"{name}.gain.proof.json")
    out = ["--out", str(tmp_path / "loop")]
    loud = RUN.invoke(app, ["compose", paths["car"], paths["loud"], *out])
    assert isinstance(loud.exception, Infeasible)
    assert "1.126 and 1.067 have the product 1.201" in str(loud.exception)
    fits = RUN.invoke(app, ["compose", paths["car"], paths["same"], *out])
    assert isinstance(fits.exception, CertificateRejected)
    assert "the units differ" in str(fits.exception)
    # other scales make other numbers: their product says nothing
    again = RUN.invoke(app, ["gain", str(tmp_path / "car.json"), "--scale", "speed=0.01"])
    assert again.exit_code == 0
    scaled = RUN.invoke(app, ["compose", paths["car"], paths["loud"], *out])
    assert isinstance(scaled.exception, CertificateRejected)
    assert "the scales differ" in str(scaled.exception)
    passive = written(tmp_path, feedthrough(), "passive")
    assert RUN.invoke(app, ["gain", str(passive), "--passivity"]).exit_code == 0
    proof = str(tmp_path / "passive.passivity.proof.json")
    mixed = RUN.invoke(app, ["compose", paths["car"], proof, *out])
    assert isinstance(mixed.exception, CertificateRejected)
    assert "proves passivity, not a gain" in str(mixed.exception)
    alone = RUN.invoke(app, ["compose", paths["car"], *out])
    assert "a loop is of two proved gains" in str(alone.exception)
    assert not (tmp_path / "loop").exists()


@pytest.mark.parametrize(
    "broken",
    [
        lambda claim: claim["supply"].update(number="0.5"),
        lambda claim: claim["supply"].update(number=[1.0]),
        lambda claim: claim.pop("about"),
        lambda claim: claim.update(about=None),
        lambda claim: claim.update(about={"model": None}),
    ],
)
def test_a_loop_of_a_damaged_proof_is_refused_with_words(
    tmp_path: Path, broken: Callable[[Json], object]
) -> None:
    path = written(tmp_path, linear(), "car")
    assert RUN.invoke(app, ["gain", str(path)]).exit_code == 0
    proof = tmp_path / "car.gain.proof.json"
    document = files.load_document(proof)
    broken(document["claim"])
    files.write_document(proof, document)
    out = str(tmp_path / "loop")
    result = RUN.invoke(app, ["compose", str(proof), str(proof), "--out", out])
    assert isinstance(result.exception, NlsidError)
    assert str(proof) in str(result.exception)
