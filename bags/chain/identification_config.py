"""The section `identification`: one form for each model class, its options and its methods."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from bags.chain.sections import Corner, Section, problems
from nlsid_core.errors import DataError
from nlsid_core.identification import (
    BlockCascadeClass,
    Fit,
    ImplicitClass,
    LinearClass,
    LinearStateClass,
    Model,
    ModelClass,
    MonotoneClass,
    StateAffineClass,
    identify,
    methods_of,
)
from nlsid_core.trajectory import Dataset

Count = Annotated[int, Field(ge=0)]
Lags = Annotated[int, Field(ge=1, le=100)]
Degree = Annotated[int, Field(ge=0, le=5)]
Delays = Annotated[tuple[Count, ...], Field(strict=False)]
Progress = Callable[[str, float], None]


def _pairs(value: object) -> object:
    """One [low, high] is the range of one input."""
    return [value] if isinstance(value, list) and value and not _nested(value) else value


def _nested(value: list[object]) -> bool:
    return any(isinstance(entry, list | tuple) for entry in value)


Ranges = Annotated[tuple[Corner, ...], BeforeValidator(_pairs), Field(strict=False)]


class _Identification(Section, ABC):
    """What every model class takes. transient: samples at the start of each trial not scored.

    allow_unproved: write a model without a proof of stability too; nothing is certified then.
    """

    method: str
    iterations: int = Field(default=40, ge=1, le=1000)
    transient: Count = 0
    seed: Count = 0
    allow_unproved: bool = False
    accept_untested_repeats: bool = False

    @property
    @abstractmethod
    def model_class(self) -> ModelClass[Model]:
        """The same as the core's noun."""

    @model_validator(mode="after")
    def _refuse_impossible(self) -> "_Identification":
        known = methods_of(self.model_class)  # and whatever the class itself refuses
        if self.method not in known:
            raise ValueError(f"method '{self.method}' is not for these degrees; {', '.join(known)}")
        return self

    def identify(
        self,
        train: Dataset,
        *,
        validation: Dataset | None = None,
        test: Dataset | None = None,
        comparators: Sequence[str] | None = None,
        allow_unproved: bool | None = None,
        progress: Progress | None = None,
    ) -> Fit[Model]:
        """`nlsid_core.identification.identify` with these options."""
        return identify(
            train,
            self.model_class,
            method=self.method,
            comparators=comparators,
            validation=validation,
            test=test,
            iterations=self.iterations,
            transient=self.transient,
            allow_unproved=self.allow_unproved if allow_unproved is None else allow_unproved,
            accept_untested_repeats=self.accept_untested_repeats,
            rng=np.random.default_rng(self.seed),
            progress=progress,
        )

    def each(self, options: Mapping[str, Sequence[object]]) -> "list[IdentificationConfig]":
        """This section with every combination of the options' values; DataError names a wrong one.

        The last option varies fastest.
        """
        here = self.model_dump(exclude=set(self.hidden))
        own = [k for k in here if k not in _Identification.model_fields and k != "model"]
        for key in options:
            if key not in own:
                known = ", ".join(own)
                raise DataError(
                    f"select.{key}: a {self.tag} model has no such option; there are: {known}"
                )
        made = []
        for values in product(*options.values()):
            changed = dict(zip(options, values, strict=True))
            try:
                made.append(_ADAPTER.validate_python(here | changed))
            except ValidationError as error:
                raise DataError(problems(error, prefix=["select"]).strip()) from error
        return made


class LinearConfig(_Identification):
    """Linear difference equations of one input and one output with n lags."""

    tag: ClassVar[str] = "linear"
    hidden: ClassVar[frozenset[str]] = frozenset({"seed", "accept_untested_repeats"})
    model: Literal["linear"] = "linear"
    lags: Lags
    method: Literal["rse", "rse_first", "least_squares", "sem", "sem_certified"] = "rse"

    @property
    def model_class(self) -> LinearClass:
        """The same as the core's noun."""
        return LinearClass(self.lags)


class StateAffineConfig(_Identification):
    """Linear in the outputs, polynomial in the inputs; see `StateAffineClass`.

    input_range: [low, high], or one for each input (default: the data's); on_out_of_range: what
    the model does with an input beyond it.
    """

    tag: ClassVar[str] = "state_affine"
    hidden: ClassVar[frozenset[str]] = frozenset({"seed", "accept_untested_repeats"})
    model: Literal["state_affine"]
    lags: Lags
    delays: Delays | None = None
    leading_degree: Degree = 0
    lagged_degree: Degree = 0
    right_degree: Degree = 1
    input_range: Ranges | None = None
    on_out_of_range: Literal["clip", "refuse"] = "clip"
    method: Literal[
        "rse", "rse_first", "rse_certified", "sem_certified", "rie", "least_squares"
    ] = "rse"

    @property
    def model_class(self) -> StateAffineClass:
        """The same as the core's noun."""
        return StateAffineClass(
            self.lags,
            delays=self.delays,
            leading_degree=self.leading_degree,
            lagged_degree=self.lagged_degree,
            right_degree=self.right_degree,
            u_range=self.input_range,
            on_out_of_range=self.on_out_of_range,
        )


class BlockCascadeConfig(_Identification):
    """A filter, a static nonlinearity, a filter; see `BlockCascadeClass`. seed: of the starts."""

    tag: ClassVar[str] = "block_cascade"
    hidden: ClassVar[frozenset[str]] = frozenset({"iterations", "accept_untested_repeats"})
    model: Literal["block_cascade"]
    orders: Annotated[tuple[Count, Count], Field(strict=False)] = (3, 3)
    phases: Annotated[tuple[int, ...], Field(strict=False)] = (1, 2)
    intervals: Annotated[tuple[int, ...], Field(strict=False)] = (24, 48, 96)
    smoothing: Annotated[tuple[float, ...], Field(strict=False)] = (1e-8,)
    starts: int = Field(default=12, ge=1, le=1000)
    start_samples: int = Field(default=10_000, ge=1)
    begin: Literal["measured", "rest"] = "measured"
    method: Literal["sem"] = "sem"

    @property
    def model_class(self) -> BlockCascadeClass:
        """The same as the core's noun."""
        return BlockCascadeClass(
            self.orders,
            phases=self.phases,
            intervals=self.intervals,
            smoothing=self.smoothing,
            starts=self.starts,
            start_samples=self.start_samples,
            begin=self.begin,
        )


class MonotoneConfig(_Identification):
    """e(y) affine in the past with e increasing, of degree 1 or 3; see `MonotoneClass`.

    moment_rie removes the bias of noise by repeated experiments, each pair in both roles.
    accept_untested_repeats: do not test that repeats are repeats.
    """

    tag: ClassVar[str] = "monotone"
    hidden: ClassVar[frozenset[str]] = frozenset({"iterations", "seed"})
    model: Literal["monotone"]
    lags: Lags
    delays: Delays | None = None
    degree: Literal[1, 3] = 3
    method: Literal["moment_rie", "rie", "least_squares", "sem"] = "moment_rie"

    @property
    def model_class(self) -> MonotoneClass:
        """The same as the core's noun."""
        return MonotoneClass(self.lags, self.delays, self.degree)


class ImplicitConfig(_Identification):
    """e(y(t)) = f(past outputs, inputs), in a set of stable models; see `ImplicitClass`.

    box: [low, high] of every response, then every excitation (default: stable everywhere).
    """

    tag: ClassVar[str] = "implicit"
    hidden: ClassVar[frozenset[str]] = frozenset({"iterations", "seed", "accept_untested_repeats"})
    model: Literal["implicit"]
    lags: Lags = 1
    delays: Delays | None = None
    set: Literal["2.10", "2.11", "2.12", "2.13", "2.19"] = "2.11"
    left_degree: int = Field(default=3, ge=1, le=9)
    right_degree: int = Field(default=1, ge=1, le=5)
    input_degree: int = Field(default=1, ge=1, le=5)
    coupled: bool = False
    box: Ranges | None = None
    storage_degree: int = Field(default=0, ge=0, le=4)
    method: Literal["rie", "least_squares"] = "rie"

    @property
    def model_class(self) -> ImplicitClass:
        """The same as the core's noun."""
        return ImplicitClass(
            self.lags,
            delays=self.delays,
            set=self.set,
            left_degree=self.left_degree,
            right_degree=self.right_degree,
            input_degree=self.input_degree,
            coupled=self.coupled,
            box=self.box,
            storage_degree=self.storage_degree,
        )


class LinearStatesConfig(_Identification):
    """Linear models whose state is the measured responses; see `LinearStateClass`."""

    tag: ClassVar[str] = "linear_states"
    hidden: ClassVar[frozenset[str]] = frozenset({"iterations", "seed", "accept_untested_repeats"})
    model: Literal["linear_states"]
    method: Literal["least_squares"] = "least_squares"

    @property
    def model_class(self) -> LinearStateClass:
        """The same as the core's noun."""
        return LinearStateClass()


def _tag(section: Any) -> Any:
    return section.get("model", "linear") if isinstance(section, dict) else section.model


IdentificationConfig = Annotated[
    Annotated[LinearConfig, Tag("linear")]
    | Annotated[StateAffineConfig, Tag("state_affine")]
    | Annotated[BlockCascadeConfig, Tag("block_cascade")]
    | Annotated[MonotoneConfig, Tag("monotone")]
    | Annotated[ImplicitConfig, Tag("implicit")]
    | Annotated[LinearStatesConfig, Tag("linear_states")],
    Discriminator(
        _tag,
        custom_error_type="unknown_model",
        custom_error_message="there is no such model; there are: linear, state_affine, "
        "block_cascade, monotone, implicit, linear_states",
    ),
]
_ADAPTER: TypeAdapter[IdentificationConfig] = TypeAdapter(IdentificationConfig)
