"""Schema of the section rig and of the keys loop; values of the rig are the dataclasses of `gbid.rig` themselves."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, Self

from annotated_types import Ge, Le, Lt
from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, model_validator

from gbid import rig
from gbid.core.errors import UsageError
from gbid.core.option_types import (
    CountOrZero,
    Duration,
    Exact,
    Finite,
    LimitedCount,
    LimitedCountOrZero,
    NotNegative,
    Order,
    Positive,
)
from gbid.experiment.fields import Name, Names, OptionsSection, Pair, Section, Switch, Text, given


@dataclass(frozen=True)
class ControllerName:
    """Controller that a YAML names: ``paper``, ``tuned``, ``tuned:NAME``, ``file.py:name``, or a controller file.

    Attributes
    ----------
    kind : {"paper", "tuned", "python", "file"}
        What it is.
    file : str
        Python file or controller file; else empty.
    name : str
        Name of the design, empty for the only one; or name in the Python file.
    """

    kind: Literal["paper", "tuned", "python", "file"]
    file: str = ""
    name: str = ""

    @classmethod
    def read(cls, text: str) -> "ControllerName":
        """Return the controller that a text names."""
        if text == "paper":
            return cls("paper")
        word, _, design = text.partition(":")
        if word == "tuned":
            return cls("tuned", name=design)
        file, _, name = text.rpartition(":")
        return cls("python", file, name) if file else cls("file", text)

    def __str__(self) -> str:
        word = self.file or self.kind
        return f"{word}:{self.name}" if self.name else word


if TYPE_CHECKING:
    NamedController = ControllerName
else:
    NamedController = Annotated[Text, AfterValidator(ControllerName.read), PlainSerializer(str)]


class ControllerChoice(Section):
    """Controller of a loop: one that exists (`controller`), or a structure with its gains (`structure`, `gains`).

    `controller`: ``paper`` is the controller in the model file of the rig, ``tuned`` or ``tuned:NAME`` a design of the
    section controller for a named model, else a controller file, or ``file.py:name`` of a model or structure of your
    own. `structure`, `lowpass_hz`, `order` and `options` are those of a design. The sign is that of `gbid.close_loop`:
    positive gains are positive feedback.
    """

    controller: NamedController | None = None
    structure: Text | None = None
    gains: dict[Text, Finite] = Field(default_factory=dict)
    lowpass_hz: Positive | None = None
    order: Annotated[CountOrZero, Le(20)] | None = None
    options: dict[Text, Finite | Pair] = Field(default_factory=dict)


class RigLoopSection(ControllerChoice):
    """Recordings of the rig under a controller, ``<point>_loop1`` and so on; all its gains must be known.

    The references of a PRBS are added to the output of the controller and recorded as w. `amplitude_m`, `hold_s`: those
    of the section prbs when left out. `runout`: ``online``, the controller subtracts the run-out map of the rotor
    without controller; ``offline``, the controller answers to the run-out, and the prefilter subtracts the answers that
    `stationary` recordings under the controller show; ``none`` for sensors without run-out.
    """

    recordings: LimitedCount = 2
    stationary: LimitedCountOrZero | None = None
    amplitude_m: Positive | None = None
    hold_s: Duration | None = None
    runout: Literal["online", "offline", "none"] = "online"


class LoopSection(ControllerChoice):
    """Loop in which the recordings of a fit were made; see `gbid.ClosedLoop`. Empty: the loop of the section rig.

    ``focus: prediction`` is then the direct method, ``focus: simulation`` the indirect one. Gains of a structure that
    `gains` does not name are estimated along, as ``controller_<gain>``. `sampled`: the controller as it runs, with
    `sample_time_s` and `computation_samples` from the measurement to the action; else a continuous one whose output is
    late by `delay_s`, by default the computation and half a sample. `beside`: a fit of the same structure to recordings
    without controller, whose standard deviations are shown beside those of this fit.
    """

    sampled: Switch = True
    sample_time_s: Positive | None = None
    computation_samples: LimitedCountOrZero = 1
    delay_s: NotNegative | None = None
    measured: Annotated[tuple[CountOrZero, ...], Field(min_length=1)] | None = None
    injected: Literal["plant input", "set point"] = "plant input"
    pade_order: Order | None = 3
    beside: Text | None = None


class RigPart(OptionsSection, frozen=True):
    """Section whose keys are the fields of a dataclass of `gbid.rig`, which refuses values that do not fit."""

    @model_validator(mode="after")
    def _fields_fit(self) -> Self:
        try:
            getattr(self, "__post_init__")()  # noqa: B009  # of the dataclass
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self


Axes = Annotated[tuple[Literal["x", "y"], ...], Field(min_length=1)]


class Place(Section):
    """Operating point of a list."""

    pressure_bar: Positive
    speed_rpm: NotNegative


Places = Annotated[tuple[Place, ...], Field(min_length=1)]


class OperatingPoint(Place):
    """Operating point of the rig, with a number of PRBS recordings where the point needs its own."""

    prbs_recordings: LimitedCountOrZero | None = None


class PrbsSection(Section):
    """Recordings with moving piezos (paper, Sec. 3.4); see `gbid.rig.Prbs`."""

    recordings: LimitedCountOrZero = 2
    amplitude_m: Positive = rig.Prbs.amplitude_m
    hold_s: Duration = rig.Prbs.hold_s


class PlayedSection(Section):
    """Recordings with the signal of a file, as `gbid excite` writes it; see `gbid.rig.Played`.

    `file`: relative to the YAML. `at`: operating points; all when left out.
    """

    file: Text
    recordings: LimitedCount = 1
    at: Places | None = None


class StationarySection(Section):
    """Recordings with piezos at rest (paper, Sec. 3.5)."""

    recordings: LimitedCountOrZero = 1
    duration_s: Duration | None = None


class StaircaseSection(Section):
    """Staircases of the references, `recordings` for each axis (paper, Sec. 3.1); see `gbid.rig.Staircase`.

    `at`: operating points of the staircases; all when left out.
    """

    recordings: LimitedCountOrZero = 1
    at: Places | None = None
    axes: Axes = ("x", "y")
    step_m: Positive = rig.Staircase.step_m
    steps: LimitedCount = rig.Staircase.steps
    hold_s: Duration = rig.Staircase.hold_s


class StackStaircaseSection(Section):
    """Staircases of single stacks, open loop and controlled (Figs. A.28, A.29); see `gbid.rig.StackStaircase`.

    `at`: operating points of the staircases; all when left out.
    """

    recordings: LimitedCountOrZero = 1
    at: Places | None = None
    stacks: Annotated[tuple[Annotated[int, Exact(), Ge(1), Le(4)], ...], Field(min_length=1)] = (
        rig.StackStaircase.stack,
    )
    controlled: Annotated[tuple[Switch, ...], Field(min_length=1)] = (False, True)
    steps: LimitedCount = rig.StackStaircase.steps
    hold_s: Duration = rig.StackStaircase.hold_s


class HammerSection(Section):
    """Hammer impacts, `recordings` for each axis (paper, Sec. 5.1); see `gbid.rig.Hammer` and `gbid.rig.Impact`."""

    recordings: LimitedCountOrZero = 1
    axes: Axes = ("x", "y")
    times_s: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (rig.Impact.time,)
    peak_n: Positive = rig.Impact.peak
    impact_s: Positive = rig.Impact.duration
    duration_s: Duration = rig.Hammer.duration_s


class RunUpSection(RigPart, rig.RunUp, frozen=True):
    """Runs with rising or falling speed; see `gbid.rig.RunUp`."""

    recordings: LimitedCountOrZero = 1


Course = Annotated[tuple[NotNegative, ...], Field(min_length=2)]


class CourseSection(Section):
    """Recordings during which pressure and speed change, ``<name>1`` and so on; see `gbid.rig.ScheduledRun`.

    `times_s`: times of the values of `pressure_bar` and `speed_rpm`, straight between them; by default start and end.
    `coast_down`: the speed falls from the first to the second value as against viscous friction.
    """

    name: Name
    recordings: LimitedCount = 1
    duration_s: Duration | None = None
    times_s: Course | None = None
    pressure_bar: NotNegative | Course
    speed_rpm: NotNegative | Course
    coast_down: Switch = False
    excited: Switch = True


class SensorSection(RigPart, rig.SensorChain, frozen=True):
    """Errors of the sensors; see `gbid.rig.SensorChain`."""


class UnbalanceSection(RigPart, rig.Unbalance, frozen=True):
    """Mass unbalance of the rotor; see `gbid.rig.Unbalance`."""


class ActuatorSection(Section):
    """Piezos: linear pairs as in the model, or four stacks; see `gbid.rig.PiezoStacks`.

    `spread` makes the stacks unequal, with random numbers of `seed`. `hysteresis_m`, `creep` and `creep_times_s` are
    the values of all four stacks before that. `slow_pole_factors` and `fast_pole_factors` multiply the poles of the
    stacks of x and of y; the controllers keep their zeros, which then no longer cancel the slow poles.
    """

    kind: Literal["linear", "stacks"] = "linear"
    offset_m: Positive = rig.PiezoStacks.offset
    spread: Annotated[float, Exact(), Ge(0), Lt(0.3)] = 0.0
    seed: CountOrZero = 0
    hysteresis_m: NotNegative = rig.PiezoStack.hysteresis
    creep: NotNegative = rig.PiezoStack.creep
    creep_times_s: tuple[Positive, ...] = rig.PiezoStack.creep_times
    slow_pole_factors: tuple[Positive, Positive] = (1.0, 1.0)
    fast_pole_factors: tuple[Positive, Positive] = (1.0, 1.0)
    record_stacks: Switch = False


class FlexibleModeSection(RigPart, rig.FlexibleMode, frozen=True):
    """Bending mode that the identified structure does not contain; see `gbid.rig.FlexibleMode`."""


class StiffeningSection(RigPart, rig.FilmStiffening, frozen=True):
    """Gas film whose stiffness rises away from the centre; see `gbid.rig.FilmStiffening`."""


class FilmSection(RigPart, rig.GasFilm, frozen=True):
    """Gas film by the Reynolds equation in place of the fourteen parameters of the model; see `gbid.rig.GasFilm`.

    The model then gives the actuators and the domain. The pressure of the operating points is that above the ambient.
    """


class NonSynchronousSection(RigPart, rig.NonSynchronous, frozen=True):
    """Whirl near a speed (paper, Sec. 4); see `gbid.rig.NonSynchronous`."""


class ProcessNoiseSection(RigPart, rig.ProcessNoise, frozen=True):
    """Broadband force; see `gbid.rig.ProcessNoise`."""


class ScatterSection(RigPart, rig.Scatter, frozen=True):
    """Scatter of the true parameters between recordings (paper, Sec. 4); see `gbid.rig.Scatter`."""


class FaultSection(RigPart, rig.Faults, frozen=True):
    """Faults of the recordings whose names match one of the patterns; see `gbid.rig.Faults`."""

    recordings: Names
    dead: dict[Text, Finite] = Field(default_factory=dict)
    saturation: dict[Text, Positive] = Field(default_factory=dict)


class RigSection(Section):
    """Recordings of the virtual rig.

    `loop`: recordings under a controller. A rotor that is unstable without one has no other recordings.
    `controller`: what closes the loop: ``python``, the sampled matrices in the program of the rig, or
    ``compiled``, the control chain in C as it is exported, with the options of the section target (its ramps are
    shortened to the settling time).
    """

    model: Text = "theisen2016"
    seed: CountOrZero = 1
    operating_points: Annotated[tuple[OperatingPoint, ...], Field(min_length=1)]
    duration_s: Duration = rig.Prbs.duration_s
    settle_s: Annotated[NotNegative, Le(3600)] = 0.5
    sample_time_s: Positive = 2e-4
    oversampling: Annotated[int, Exact(), Ge(20), Le(1000)] = 20
    controller: Literal["python", "compiled"] = "python"
    touch_down: Literal["refuse", "flag"] = "refuse"
    clearance_m: Positive = 25e-6
    moving_mass_kg: Positive = rig.Machine.moving_mass
    prbs: PrbsSection = PrbsSection()
    played: Annotated[PlayedSection | None, BeforeValidator(given)] = None
    loop: Annotated[RigLoopSection | None, BeforeValidator(given)] = None
    stationary: StationarySection = StationarySection()
    staircase: Annotated[StaircaseSection | None, BeforeValidator(given)] = None
    stack_staircase: Annotated[StackStaircaseSection | None, BeforeValidator(given)] = None
    hammer: Annotated[HammerSection | None, BeforeValidator(given)] = None
    run_up: Annotated[RunUpSection | None, BeforeValidator(given)] = None
    courses: tuple[CourseSection, ...] = ()
    sensors: SensorSection = SensorSection()
    unbalance: UnbalanceSection = UnbalanceSection()
    actuators: ActuatorSection = ActuatorSection()
    flexible_mode: Annotated[FlexibleModeSection | None, BeforeValidator(given)] = None
    film: Annotated[FilmSection | None, BeforeValidator(given)] = None
    stiffening: Annotated[StiffeningSection | None, BeforeValidator(given)] = None
    non_synchronous: Annotated[NonSynchronousSection | None, BeforeValidator(given)] = None
    process_noise: Annotated[ProcessNoiseSection | None, BeforeValidator(given)] = None
    scatter: Annotated[ScatterSection | None, BeforeValidator(given)] = None
    effects: dict[Text, dict[Text, Finite]] = Field(default_factory=dict)
    faults: tuple[FaultSection, ...] = ()

    @model_validator(mode="after")
    def _excitation_switches(self) -> Self:
        if self.prbs.recordings and self.prbs.hold_s >= self.duration_s:
            raise ValueError(
                f"prbs.hold_s: {self.prbs.hold_s:g} s, so a PRBS never switches within the {self.duration_s:g} s of a "
                "recording (duration_s); hold it for some milliseconds"
            )
        return self
