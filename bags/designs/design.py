"""What a robot runs and is held against: a model, a policy and a funnel that belong together."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeAlias, TypeGuard, TypeVar

from bags.signals.expressions import Expression
from bags.signals.sampling import Sampler
from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.documents import read
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError, DocumentError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.protocol import AnyFunnel, read_funnel
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.models import (
    Signal,
    StableModel,
    StateModel,
    TrapezoidalModel,
)
from nlsid_core.models.measured_state import MeasuredState, read_measured_state
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.protocol import AnyPolicy, read_policy
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.policies.tube import TubePolicy
from nlsid_core.running.comparison import Centre
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.held import Held
from nlsid_core.running.monitor import Dynamics, Monitor, refuse_mismatch

M = TypeVar("M", bound=Dynamics)
P = TypeVar("P", bound=AnyPolicy | None)
F = TypeVar("F", bound=AnyFunnel | None)
CONTINUOUSLY = Held()


@dataclass(frozen=True)
class Wiring:
    """Where a continuous funnel's state and inputs are, and s between samples.

    A vector field has equations and no signals, so whoever runs its funnel says this.
    """

    response: SignalVector
    command: SignalVector
    period: float

    @classmethod
    def parse(cls, response: Iterable[str], command: Iterable[str], period: float) -> "Wiring":
        """Read each `topic:field.path[index]`; BagError if a vector is not on one topic."""
        return cls(SignalVector.parse(response), SignalVector.parse(command), period)

    @classmethod
    def parse_if_any(
        cls, response: Sequence[str], command: Sequence[str], period: float
    ) -> "Wiring | None":
        """`parse`, None if neither was said."""
        return cls.parse(response, command, period) if response or command else None


@dataclass(frozen=True, eq=False)
class WiredDesign(Generic[M, P, F]):
    """The parts of a design of any kind, and where their signals are.

    wiring: of a continuous funnel, None until somebody says it. held: how the proof of a continuous
    funnel lets its policy be applied. later: of a composition, the stages that follow this one;
    composition: the digest of its proof. funnel: None of a policy that is not proved.
    """

    model: M
    policy: P
    funnel: F
    wiring: Wiring | None = None
    held: Held = CONTINUOUSLY
    later: "tuple[WiredDesign[M, P, F], ...]" = ()
    composition: str = ""

    @property
    def stages(self) -> "tuple[WiredDesign[M, P, F], ...]":
        """This one, and those of a composition that follow."""
        return self, *self.later

    @property
    def name(self) -> str:
        """What is measured, in words."""
        if isinstance(self.model, VectorField):
            return ", ".join(f"x{i}" for i in range(self.model.n))
        return ", ".join(signal.name for signal in self.signals[0])

    @property
    def signals(self) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
        """The model's outputs or states, and its inputs."""
        model: Any = self.model
        measured = model.x if isinstance(model, StateModel | TrapezoidalModel) else model.y
        return tuple((s,) if isinstance(s, Signal) else s for s in (measured, model.u))  # type: ignore[return-value]

    @property
    def response(self) -> SignalPath | SignalVector:
        """Where a policy reads outputs or state; BagError if they are not on one topic."""
        if isinstance(self.model, VectorField):
            return self._wired().response
        return _read_at(self.signals[0], single=self.is_single)

    @property
    def command(self) -> SignalPath | SignalVector:
        """Where a policy writes the inputs; BagError if they are not on one topic."""
        if isinstance(self.model, VectorField):
            return self._wired().command
        return _read_at(self.signals[1], single=self.is_single)

    @property
    def is_single(self) -> bool:
        """One output and one input of an identified model: numbers, not vectors."""
        measured = isinstance(self.model, StateModel | TrapezoidalModel | VectorField)
        return not measured and all(len(part) == 1 for part in self.signals)

    @property
    def period(self) -> float:
        """S between samples."""
        return self._wired().period if isinstance(self.model, VectorField) else self.model.period

    def sampler(self) -> Sampler:
        """What makes samples of messages, by the rule that the model was identified with."""
        if isinstance(self.model, VectorField):
            wiring = self._wired()
            y, u = (list(map(Expression, v.paths)) for v in (wiring.response, wiring.command))
            return Sampler(y, u, period=self.period)
        outputs, inputs = ([signal.path for signal in part] for part in self.signals)
        return Sampler(outputs, inputs, period=self.period)

    @property
    def has_plan(self) -> bool:
        """Whether the funnel is always around the policy's plan; a tube may follow commands."""
        return not isinstance(self.funnel, TubeFunnel)

    @property
    def digest(self) -> str:
        """Of the funnel's document, or of the composition's proof: how an announcement names it.

        Without a funnel of the policy's.
        """
        named: Any = self.funnel if self.funnel is not None else self.policy
        return self.composition or files.digest(named.document())

    @property
    def made_with(self) -> dict[str, str]:
        """What recordings were used for (training, calibration or both), by their digests."""
        trained: set[str] = set()
        calibrated: set[str] = set()
        for stage in self.stages:
            model, funnel = stage.model, stage.funnel
            trained |= {digest for _, digest in getattr(model, "bags", ())}
            for tube in funnel.tubes if isinstance(funnel, TubeFunnel) else ():
                trained |= {digest for _, digest in tube.designed_on}
                calibrated |= {digest for _, digest in tube.measured_on}
        parts = {"training": trained, "calibration": calibrated}
        return {
            digest: " and ".join(use for use, part in parts.items() if digest in part)
            for digest in trained | calibrated
        }

    def monitor(self, centre: Centre) -> Monitor:
        """A monitor for one run; centre: of a tube with a policy."""
        if self.later:
            parts: list[Any] = [(s.model, s.policy, s.funnel) for s in self.stages]
            held = [stage.held for stage in self.stages]
            return Monitor.of_stages(parts, period=self.period, held=held)
        period = self.period if isinstance(self.model, VectorField) else None
        funnel: AnyFunnel | None = self.funnel
        if funnel is None:
            raise DocumentError("nothing is proved of this policy: no funnel to hold a robot to")
        return Monitor(
            self.model, self.policy, funnel, centre=centre, period=period, held=self.held
        )

    def controller(self, limits: Limits, settling: float) -> Controller:
        """A controller for one run; `settling`: s to wait for a state where it may start."""
        period = self.period if isinstance(self.model, VectorField) else None
        if self.policy is None:
            raise DocumentError("this tube is around a model's simulation only: no policy to run")
        if self.funnel is None:
            return Controller.unproved(self.model, self.policy, limits=limits, period=period)
        if self.later:
            parts: list[Any] = [(s.model, s.policy, s.funnel) for s in self.stages]
            return Controller.of_stages(
                parts, limits=limits, settling=settling, period=self.period, held=self.held
            )
        return Controller(
            self.model,
            self.policy,
            self.funnel,
            limits=limits,
            settling=settling,
            period=period,
            held=self.held,
        )

    def _wired(self) -> Wiring:
        if self.wiring is None:
            raise DataError(
                "a vector field names no signals: say where the state and the inputs are "
                "(response, command) and how often they come (period)"
            )
        return self.wiring


SampledDesign: TypeAlias = WiredDesign[MeasuredState, SampledPolicy, SampledFunnel]
ContinuousDesign: TypeAlias = WiredDesign[VectorField, ContinuousPolicy, ContinuousFunnel]
WiredTube: TypeAlias = WiredDesign[StableModel, TubePolicy | None, TubeFunnel]
AnyDesign: TypeAlias = SampledDesign | ContinuousDesign | WiredTube


def read_design(
    documents: Mapping[str, Json], *, wiring: Wiring | None = None, claim: Json | None = None
) -> AnyDesign:
    """The documents `model` (or vector field), `policy` and `funnel` as what they are.

    The funnel's kind decides. claim: of its proof, which says how old an input may be. Raises
    DocumentError if one is not what it should be, CertificateMismatch if they do not belong
    together, DataError if samples come less often than is proved.
    """
    if "funnel" not in documents:
        raise DocumentError("a design has a funnel")
    funnel = read_funnel(documents["funnel"])
    readers: dict[type[AnyFunnel], tuple[type[AnyPolicy] | None, Any]] = {
        SampledFunnel: (SampledPolicy, read_measured_state),
        ContinuousFunnel: (ContinuousPolicy, VectorField.from_document),
        TubeFunnel: (
            TubePolicy if "policy" in documents else None,
            partial(read, source="model"),
        ),
    }
    kind, read_model = readers[type(funnel)]
    wanted = {"model", "funnel"} | ({"policy"} if kind is not None else set())
    if documents.keys() != wanted:
        raise DocumentError(
            f"{', '.join(documents)}: with this funnel go {', '.join(sorted(wanted))}"
        )
    policy = None if kind is None else read_policy(documents["policy"])
    if kind is not None and not isinstance(policy, kind):
        raise DocumentError(
            f"policy: a {type(policy).__name__}, the funnel needs a {kind.__name__}"
        )
    model = read_model(documents["model"])
    refuse_mismatch(model, policy, funnel)
    held = CONTINUOUSLY
    if isinstance(funnel, ContinuousFunnel):
        if claim is None:
            raise DocumentError("with a continuous funnel goes the claim of its proof")
        held = Held.of_claim(claim)
    if held.hold and wiring is not None:
        held.refuse(wiring.period)
    design: Any = WiredDesign(model, policy, funnel, wiring, held)
    made: AnyDesign = design
    return made


def _read_at(signals: tuple[Signal, ...], *, single: bool) -> SignalPath | SignalVector:
    if single:
        return Expression.parse(signals[0].path).path
    return SignalVector.parse(signal.path for signal in signals)


def is_sampled(design: AnyDesign) -> TypeGuard[SampledDesign]:
    """Whether it is a sampled funnel around a motion of a measured state."""
    return isinstance(design.funnel, SampledFunnel)


def is_continuous(design: AnyDesign) -> TypeGuard[ContinuousDesign]:
    """Whether it is a funnel of a vector field."""
    return isinstance(design.funnel, ContinuousFunnel)


def is_tube(design: AnyDesign) -> TypeGuard[WiredTube]:
    """Whether it is a tube around the simulation of a model, and perhaps around a plan."""
    return isinstance(design.funnel, TubeFunnel)
