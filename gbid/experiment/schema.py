"""Schema of an experiment YAML, section by section, and patterns of file names."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, cast, get_args, get_type_hints

from pydantic import (
    AllowInfNan,
    BeforeValidator,
    Field,
    PlainSerializer,
    Strict,
    WithJsonSchema,
    WrapValidator,
    create_model,
)

from gbid import control
from gbid.control.impact.half_sine import HalfSine
from gbid.control.tuning.goals import BoundLike, DisturbanceSpectrum, Goal
from gbid.core.errors import UsageError
from gbid.experiment.fields import (
    Count,
    CountOrZero,
    Holds,
    Name,
    Names,
    NamesOrNone,
    NotNegative,
    Number,
    Pair,
    Positive,
    Section,
    Switch,
    Text,
    given,
    nearest,
)
from gbid.experiment.rig_schema import LoopSection, RigSection
from gbid.export.chain import ChainOptions
from gbid.identify.disturbances import TREND_WORDS
from gbid.identify.options import HIGHEST_DEGREE, FitOptions, Scope, TrendName


class CrossvalSection(Section):
    """Recordings on which the models of a fit are validated (paper, Sec. 3.8).

    `on`: ``cyclic`` is model j on recording j + 1 of its operating point, the last on the first; ``others`` each model
    on all other excited recordings; ``point`` on those of its own operating point; else names of recordings.
    `residuals` are tested for all ``pairs``, for the first pair of each of the ``models``, or not at all (``none``).
    The default is all pairs when there are at most 200, else one pair for each model.
    """

    on: Names = ("cyclic",)
    minimum_percent: Number | None = None
    residuals: Literal["pairs", "models", "none"] | None = None


# ---- Schema of the impacts section: hammer impacts on the rig, in open and closed loop.


class ImpactPoint(Section):
    """Operating point at which the rotor is hit."""

    pressure_bar: Positive
    speed_rpm: NotNegative


class HammerTrain(Section):
    """Impacts along each axis, and how their ring-downs are fitted.

    `repeats` is the number of impacts in a recording, `spacing_s` the time between them.
    """

    axes: Annotated[tuple[Literal["x", "y"], ...], Field(min_length=1)] = ("x", "y")
    peak_n: Positive = 12.0
    impact_s: Positive = 2e-3
    repeats: Count = 5
    spacing_s: Positive = 0.4
    harmonics: CountOrZero | None = None
    lags: Annotated[int, Strict(), Field(ge=0, le=6)] | Literal["auto"] = "auto"


class ImpactsSection(HammerTrain):
    """Hammer impacts with and without a controller (paper, Sec. 5.1); see `gbid.fit_ringdown`, `gbid.validate_impact`.

    `controller`: ``paper`` is the controller in the model file of the rig, ``tuned`` the design of the
    section controller (``tuned:NAME`` when there are several), else a controller file.
    `beside`: further closed loops by name, each with a controller written in the same way.
    `model`: model that predicts the modes: a name, a file, or ``lpv`` for the surfaces of this experiment;
    the model of the rig when left out. `repeats` is the number of impacts in a recording, `spacing_s` the time between
    them.
    """

    controller: Text = "paper"
    beside: dict[Name, Text] = Field(default_factory=dict)
    model: Text | None = None
    operating_points: Annotated[tuple[ImpactPoint, ...], Field(min_length=1)]
    loops: Annotated[tuple[Literal["open", "closed"], ...], Field(min_length=1)] = ("open", "closed")


# ---- Schema of the cycle section.

MOST_ROUNDS = 5

Points = Annotated[tuple[ImpactPoint, ...], Field(min_length=1)]


class TrialSection(HammerTrain):
    """Impacts that measure the damping of each round.

    `operating_points`: where the rotor is hit; by default at the points of the new recordings.
    """

    operating_points: Points | None = None


class CycleSection(Section):
    """Identification-for-control cycle on the virtual rig.

    In each round the controller of the round before runs on the rig while new recordings are made. The surfaces are
    fitted again to all recordings so far, in open and in closed loop, and the controller is tuned again. Impacts
    measure the damping of every round. Round 0 is the design of this experiment.

    `design`: name of the design; it may be left out when there is one. `rounds`: number of rounds after round 0.
    `operating_points`: those of the new recordings; by default those of the rig. `recordings`: number in each round at
    each point. `in_run`: whether `gbid run` runs the cycle as well; `gbid cycle` runs it in any case. `duration_s`,
    `amplitude_m`, `hold_s`: of the new recordings; by default those of the section rig.
    """

    design: Name | None = None
    rounds: Annotated[int, Strict(), Field(ge=1, le=MOST_ROUNDS)] = 2
    operating_points: Points | None = None
    recordings: Count = 1
    in_run: Switch = True
    duration_s: Positive | None = None
    amplitude_m: Positive | None = None
    hold_s: Positive | None = None
    impacts: Annotated[TrialSection, BeforeValidator(given)] = TrialSection()


# ---- Schema of the excite section; names and defaults are those of `gbid.design_excitation`.


class ExciteLimitsSection(Section):
    """Limits of an excitation; see `gbid.ExcitationLimits`.

    `peaks` and `radius` are by signal or channel of the fit, in SI units. `clearance_m` is that of the rig when left
    out, with its unbalance, run-out and scatter; without a rig there is none.
    """

    peaks: dict[Text, Positive] = Field(min_length=1)
    radius: dict[Text, Positive] = Field(default_factory=dict)
    clearance_m: Positive | None = None
    taken_m: NotNegative = 0.0


class ExciteSection(Section):
    """Excitation of the next recording, for each model of a fit; see `gbid.design_excitation`.

    `together`: whether the recordings of the fit count as well, so that the next one is best after them.
    """

    fit: Name
    duration_s: Positive = 5.0
    kind: Literal["multisine", "prbs"] = "multisine"
    focus: Names | dict[Text, Positive] | None = None
    together: Switch = True
    limits: ExciteLimitsSection


# ---- Schema of the figures section.

Format = Literal["png", "pdf", "svg"]


class FigureSection(Section):
    """Time range that the figure shows, and whether residual tests and Bode diagrams are drawn as well.

    `formats`: file formats of the pictures; each takes its time.
    """

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False
    bode: Switch = False
    formats: Annotated[tuple[Format, ...], Field(min_length=1)] = ("png",)


# ---- Schema of the fits section: all options of `gbid.fit` and `gbid.fit_multistart`.


def _window(value: Any) -> Any:
    if value == "one":
        return None
    if value != "auto" and (not isinstance(value, int) or isinstance(value, bool) or value < 2):
        raise ValueError(
            f"expected a number of samples, at least 2, or the word auto or one (single shooting), found {value!r}"
        )
    return value


_STATE: dict[str, Any] = {
    "anyOf": [
        {"enum": ["estimated", "zero", "structure"]},
        {
            "type": "array",
            "items": {"anyOf": [{"type": "number"}, {"enum": ["estimated", "structure"]}]},
            "minItems": 1,
        },
    ]
}


OwnStateField = Literal["estimated", "zero", "structure"] | tuple[float | Literal["estimated", "structure"], ...]


def _initial_state(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _own_state(state) for name, state in value.items()}
    return value if value == "auto" else _own_state(value)


def _own_state(value: Any) -> Any:
    if value in ("estimated", "zero", "structure"):
        return value
    states = value if isinstance(value, list | tuple) else ()
    if not states or not all(
        v in ("estimated", "structure") or (type(v) in (int, float) and math.isfinite(v)) for v in states
    ):
        raise ValueError(
            "expected the word estimated or zero, the word structure, or a list of numbers and of the words "
            f"estimated and structure, found {value!r}"
        )
    return tuple(v if isinstance(v, str) else float(v) for v in states)


def _start(value: Any) -> Any:
    if isinstance(value, str) and value != "data":
        raise ValueError(f"expected values by the names of parameters, or the word data, found {value!r}")
    return value


def _trend(value: Any) -> Any:
    for word in value.values() if isinstance(value, dict) else (value,):
        if not (isinstance(word, str) and word in TREND_WORDS) and not (
            type(word) is int and 0 <= word <= HIGHEST_DEGREE
        ):
            words = ", ".join(TREND_WORDS)
            raise ValueError(f"expected {words}, or a degree from 0 to {HIGHEST_DEGREE}, found {word!r}")
    return value


def _one_or_several(value: Any) -> Any:
    return (value,) if isinstance(value, int | float) else value


_TREND = [{"enum": list(TREND_WORDS)}, {"type": "integer", "minimum": 0, "maximum": HIGHEST_DEGREE}]


class StructureOptions(Section):
    """Options of a built-in structure; `order` and `piece_s` are for scheduled ones, see `gbid.scheduled`."""

    delay: Literal["pade", "exact"] | None = None
    pade_order: Count | None = None
    disturbance_gain: Literal["full", "diagonal", "states", "none"] | None = None
    film: Literal["linear", "stiffening"] | None = None
    unbalance: Switch | None = None
    order: Annotated[int, Strict(), Field(ge=0, le=2)] | None = None
    piece_s: Positive | None = None


class PriorSection(Section):
    """Prior knowledge of a parameter: a normal distribution, in the unit of the parameter."""

    value: Number
    std: Positive


class MultiStartSection(Section):
    """Further starts, drawn at random; see `gbid.fit_multistart`."""

    starts: Annotated[int, Strict(), Field(ge=2)] = 10
    seed: CountOrZero = 0
    reach: Positive = 0.5


Stretches = Annotated[tuple[tuple[NotNegative, Positive], ...], Field(min_length=1)]


class FitSection(Section, FitOptions):  # type: ignore[misc]  # sections are frozen by their configuration
    """One fit of a structure, to each recording or to all together; its other keys are options: see `gbid.fit`.

    `left_out`: by name of a recording, stretches ``[from, to]`` [s] from the first sample; the sample at ``to`` is used
    again. `local` needs `together`. ``inputs: []`` is a free decay. `loop`: the recordings were made under a
    controller; the structure is then that of the loop, from what was injected.
    """

    structure: Text
    options: StructureOptions = StructureOptions()
    loop: Annotated[LoopSection | None, BeforeValidator(given)] = None
    recordings: Names | None = None
    together: Switch = False
    multi_start: MultiStartSection | None = None
    # Options of `gbid.fit` that have another form in the YAML.
    inputs: NamesOrNone | None = None
    outputs: Names | None = None
    intersample: Holds | None = None
    output_weights: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    window: Annotated[
        int | Literal["auto"] | None,
        BeforeValidator(_window),
        WithJsonSchema({"anyOf": [{"enum": ["auto", "one"]}, {"type": "integer", "minimum": 2}]}),
    ] = "auto"
    start: Annotated[
        dict[Text, Number] | Literal["data"],
        BeforeValidator(_start),
        WithJsonSchema({"anyOf": [{"const": "data"}, {"type": "object", "additionalProperties": {"type": "number"}}]}),
    ] = Field(default_factory=dict)
    fixed: dict[Text, Number] = Field(default_factory=dict)
    bounds: dict[Text, tuple[Number | None, Number | None]] = Field(default_factory=dict)  # type: ignore[assignment]
    prior: dict[Text, PriorSection] = Field(default_factory=dict)  # type: ignore[assignment]
    local: dict[Text, Scope] = Field(default_factory=dict)
    trend: Annotated[
        TrendName | dict[Text, TrendName],
        BeforeValidator(_trend),
        WithJsonSchema({"anyOf": [*_TREND, {"type": "object", "additionalProperties": {"anyOf": _TREND}}]}),
    ] = "none"
    hum: Annotated[tuple[Positive, ...], BeforeValidator(_one_or_several)] = ()
    initial_state: Annotated[
        Literal["auto"] | OwnStateField | dict[Text, OwnStateField],
        BeforeValidator(_initial_state),
        WithJsonSchema({"anyOf": [{"enum": ["auto"]}, _STATE, {"type": "object", "additionalProperties": _STATE}]}),
    ] = "auto"
    left_out: dict[Text, Stretches] = Field(default_factory=dict)  # type: ignore[assignment]  # in seconds
    ipopt: dict[Text, Number | Text] = Field(default_factory=dict)


# ---- Schema of the import section: recordings listed one by one, found by file name, or listed in a table.

Kind = Literal["excited", "stationary", "staircase"]
KINDS: dict[str, Kind] = {
    "excited": "excited",
    "prbs": "excited",
    "stationary": "stationary",
    "still": "stationary",
    "staircase": "staircase",
}
"""Words for the kind of a recording in file names and tables."""


class ColumnsSection(Section):
    """Columns of one signal in a file; see `gbid.recording.SignalMapping`.

    `rests_at_limits`: the signal stays at its largest or smallest value by design, as an input may. It is then not
    reported as saturated.
    """

    columns: Names
    unit: str | None = None
    stored_unit: str | None = None
    channels: Names | None = None
    rests_at_limits: Switch = False


class FileSection(Section):
    """Mapping of a file; see `gbid.recording.ImportMapping`.

    `remove_mean` subtracts the mean of each signal over the samples used; a linear model has no offset.
    """

    sample_time_s: Positive | None = None
    time: Text | None = None
    time_unit: Text | None = None
    samples: tuple[CountOrZero, Count | None] | None = None
    from_s: NotNegative | None = None
    to_s: Positive | None = None
    piece: Count | None = None
    encoding: Text | None = None
    decimal: Literal[".", ","] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    header_line: Count | None = None
    remove_mean: Switch = False
    conditions: dict[Text, Number] = Field(default_factory=dict)
    signals: Annotated[dict[Text, ColumnsSection], Field(min_length=1)]


class ImportedSection(FileSection):
    """One recording from a file; see `gbid.recording.ImportMapping`.

    `remove_mean` subtracts the mean of each signal over the samples used; a linear model has no offset.
    """

    name: Name
    file: Text
    kind: Kind = "excited"


class FolderSection(FileSection):
    """All files of the data folder whose names match a pattern; see `gbid.recording.ImportMapping`.

    `pattern` is a file name with fields: ``{name}`` and ``{kind}``, ``{pressure_bar:g}`` (a number),
    ``{speed_rpm:d}`` (a whole number), and any other word for a part that is ignored. With a ``/`` in it, subfolders
    are searched. `more_conditions` names further fields to store as conditions. `kinds` gives the meaning of the words
    of ``{kind}``, `kind` that of a recording without this field. `ignore` lists patterns of files, with ``*`` and
    ``?``, that do not belong to the experiment. `operating_point` may be false for rigs without pressure and speed.
    """

    pattern: Text
    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    ignore: Names | None = None
    more_conditions: Names | None = None
    operating_point: Switch = True


class TableSection(FileSection):
    """Recordings listed in a CSV table in the data folder; see `gbid.recording.ImportMapping`.

    Each recording has a row with the columns ``file``, ``pressure_bar``, ``speed_rpm``, and optionally ``name`` and
    ``kind``. `more_conditions` names further columns to store as conditions. `operating_point` may be false for rigs
    without pressure and speed.
    """

    file: Text
    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    more_conditions: Names | None = None
    operating_point: Switch = True


class ImportSection(Section):
    """Recordings from measured files: listed one by one, found by file name, or listed in a table."""

    data_folder: Text = "."
    recordings: Annotated[tuple[ImportedSection, ...], Field(min_length=1)] | None = None
    folder: FolderSection | None = None
    table: TableSection | None = None


# ---- Schema of the lpv section.

Term = Literal["1", "P", "Omega", "Omega P", "P^2", "Omega^2"]


def _order(value: Any) -> Any:
    """Return the order; refuse any other value with one message for all three forms."""
    terms = get_args(Term)
    listed = isinstance(value, list | tuple) and value and all(term in terms for term in value)
    if not listed and value != "auto" and (type(value) is not int or value not in (0, 1, 2)):
        words = ", ".join(f'"{term}"' for term in terms)
        raise ValueError(f"expected 0, 1, 2, auto, or a list of terms out of {words}; found {value!r}")
    return value


class LpvSection(Section):
    """Surfaces of the key parameters of a fit to each recording (paper, Eq. 16); see `gbid.fit_lpv`.

    `actuators`: the word ``nominal`` (choice of the section nominal), or the name or file of a model; default none.
    `direct`: whether the surfaces are also estimated directly from the recordings; see `gbid.fit_lpv_direct`.
    """

    fit: Name
    weighting: Literal["scatter", "fits", "ordinary"] = "scatter"
    order: Annotated[
        Annotated[int, Strict(), Field(ge=0, le=2)] | Literal["auto"] | tuple[Term, ...], BeforeValidator(_order)
    ] = 2
    robust: Switch = False
    direct: Switch = False
    actuators: Text | None = None


# ---- Schema of the nominal section.


class NominalSection(Section):
    """Fit whose most central model is the nominal actuator; see `gbid.nominal_actuator`."""

    fit: Name


# ---- Schema of the prefilter section.


class PrefilterSection(Section):
    """Corrections of the excited recordings before the fits (paper, Sec. 3.5).

    `harmonics`: their number, or ``auto`` for the smallest one that leaves no more than others on held-out data.
    `slow_roll`: stationary recordings at a low speed. Their map, the run-out alone, is for recordings without an
    operating point, in which the speed changes; a fit estimates the unbalance of those (option ``unbalance``).
    """

    method: Literal["harmonics", "bins", "auto", "none"] = "harmonics"
    align_index: Switch = False
    harmonics: Count | Literal["auto"] = 10
    bins: Annotated[int, Strict(), Field(ge=4)] = 100
    spikes: Switch = True
    median: Count = 1
    remove_mean: Switch = True
    slow_roll: Names | None = None


# ---- Schema of the static sections.

Share = Annotated[float, Strict(), Field(gt=0, le=1)]


class StaticSection(Section):
    """Static characterisation from staircases (paper, Sec. 3.1 and Appendix A).

    `kind: bearing` is the map from piezo positions to disc position, from all its recordings together; `kind: piezo`
    characterises one piezo stack or pair from one recording. See `gbid.characterise_staircase` and
    `gbid.characterise_piezo`; keys that are left out have their defaults.
    """

    recordings: Names
    kind: Literal["bearing", "piezo"] = "bearing"
    command: Text | None = None
    source: Text | None = None
    position: Text | None = None
    keep: Share | None = None
    channel: Text | None = None
    command_channel: Text | None = None
    settle_s: NotNegative | None = None
    limits: tuple[Number, Number] | None = None


def wanted_signals(section: StaticSection) -> dict[str, str]:
    """Return the signals by the key that names them, with the defaults of the functions."""
    if section.kind == "piezo":
        return {"command": section.command or "r", "position": section.position or "u"}
    return {
        "command": section.command or "r",
        "source": section.source or "u",
        "position": section.position or "p",
    }


# ---- Schema of the target section; names, units and defaults are those of `gbid.export.ChainOptions`.

_DEFAULT = ChainOptions()


class TargetSection(Section):
    """Limits, ramps, guards and watchdog of the control chain in C; see `gbid.export.ChainOptions`.

    `disc_limit_m`: 0.8 of the clearance of the rig when left out, else 20 um.
    """

    number: Literal["double", "float"] = _DEFAULT.number
    limit_m: Positive = _DEFAULT.limit_m
    offset_m: Positive = _DEFAULT.offset_m
    stroke_m: Positive = _DEFAULT.stroke_m
    zero_m: Pair = _DEFAULT.zero_m
    median: Literal[1, 3] = 1
    spike_limit_m: Positive | None = _DEFAULT.spike_limit_m
    disc_limit_m: Positive | None = None
    beyond_samples: Count = _DEFAULT.beyond_samples
    bad_samples: Count = _DEFAULT.bad_samples
    stuck_samples: Count = _DEFAULT.stuck_samples
    stuck_speed_rpm: NotNegative = _DEFAULT.stuck_speed_rpm
    ramp_s: Positive = _DEFAULT.ramp_s
    fade_s: Positive = _DEFAULT.fade_s
    pressure_rate: Positive = _DEFAULT.pressure_rate
    speed_rate: Positive = _DEFAULT.speed_rate


# ---- Schema of the goals of a design: one section for each goal of gbid.control, made from its arguments.

GOALS: dict[str, type[Goal]] = {
    kind.__name__: kind
    for kind in (
        control.MaxDamping,
        control.MaxDecay,
        control.MinDamping,
        control.SlowestPole,
        control.PeakSensitivity,
        control.PeakComplementary,
        control.PeakControl,
        control.StaticAmplification,
        control.RollOff,
        control.MinDiskMargin,
        control.MinGainMargin,
        control.MinPhaseMargin,
        control.RmsPosition,
        control.RmsControl,
        control.PiezoTravel,
    )
}
"""Goals that a YAML can name."""


class HitSection(Section):
    """Half-sine impact of a goal."""

    peak_n: Positive = 12.0
    duration_s: Positive = 2e-3


class GoalSection(Section):
    """Goal of a design: its name, and its arguments as given; those left out have the defaults of the goal."""

    goal: str

    def given(self) -> dict[str, Any]:
        """Return the arguments that the YAML gives."""
        return {name: value for name, value in self if name in self.model_fields_set and name != "goal"}

    def __reduce__(self) -> tuple[Callable[..., GoalSection], tuple[str, dict[str, Any]]]:
        # its class has no name in this module, which pickling needs
        return restored_entry, (self.goal, self.given())


def restored_entry(goal: str, given: dict[str, Any]) -> GoalSection:
    """Return the entry of a goal from its arguments, in another process."""
    return _SECTIONS[goal](goal=goal, **given)


def _numbers(values: Any) -> bool:
    return isinstance(values, list | tuple) and all(_number(v) for v in values)


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _limit(value: Any) -> Any:
    """Return a limit over frequency in one of its three forms."""
    if _number(value):
        return value
    if isinstance(value, list | tuple) and value and all(_numbers(pair) and len(pair) == 2 for pair in value):
        return tuple(map(tuple, value))
    rational = isinstance(value, dict) and set(value) == {"numerator", "denominator"}
    if rational and all(_numbers(part) and len(part) for part in value.values()):
        return {name: tuple(part) for name, part in value.items()}
    raise ValueError(
        "expected a number, breakpoints as [[frequency_hz, limit], ...], or a transfer function as {numerator: [...], "
        f"denominator: [...]}} with the coefficients of powers of s, the highest first; found {value!r}"
    )


_LIST = {"type": "array", "items": {"type": "number"}, "minItems": 1}
_LIMIT_FORMS = [
    {"type": "number", "exclusiveMinimum": 0},
    {"type": "array", "items": {**_LIST, "minItems": 2, "maxItems": 2}, "minItems": 2},
    {
        "type": "object",
        "properties": {"numerator": _LIST, "denominator": _LIST},
        "required": ["numerator", "denominator"],
        "additionalProperties": False,
    },
]
_KINDS: dict[Any, Any] = {
    float: Number,
    bool: Switch,
    int | None: CountOrZero,
    BoundLike: Annotated[Any, BeforeValidator(_limit), WithJsonSchema({"anyOf": _LIMIT_FORMS})],
    HalfSine: HitSection,
    DisturbanceSpectrum: Names,
}
"""Type in the YAML of each type of argument of a goal."""


def _without_default(schema: dict[str, Any]) -> None:
    schema.pop("default", None)


def _section_of(kind: type[Goal]) -> type[GoalSection]:
    """Return the section of a goal: its arguments by name, those with a default optional."""
    hints = get_type_hints(kind)
    arguments: dict[str, Any] = {}
    for argument in fields(cast(Any, kind)):
        required = str(argument.default) == str(argument.default_factory)  # both MISSING
        default = ... if required else Field(None, json_schema_extra=_without_default)
        arguments[argument.name] = (_KINDS[hints[argument.name]], default)
    words = f"{(kind.__doc__ or '').splitlines()[0]} For its arguments see `gbid.control.{kind.__name__}`."
    name: Any = Literal.__getitem__(kind.__name__)
    return create_model(f"{kind.__name__}Section", __base__=GoalSection, __doc__=words, goal=(name, ...), **arguments)


def _entry(value: Any) -> Any:
    """Return an entry of the list; refuse one without the name of a goal, and unknown names."""
    if not isinstance(value, dict) or "goal" not in value:
        raise ValueError(f"expected a goal with its arguments, such as {{goal: MaxDamping}}, found {value!r}")
    if value["goal"] not in GOALS:
        raise ValueError(f"no goal {value['goal']!r}; {nearest(str(value['goal']), GOALS)}")
    return value


_SECTIONS = {name: _section_of(kind) for name, kind in GOALS.items()}

if TYPE_CHECKING:
    GoalEntry = GoalSection
else:
    _one_of = Union[tuple(_SECTIONS.values())]  # noqa: UP007
    GoalEntry = Annotated[Annotated[_one_of, Field(discriminator="goal")], BeforeValidator(_entry)]


# ---- Schema of the controller section.

Cap = Annotated[float, Strict(), AllowInfNan(False), Field(gt=1)]
"""Cap on the peak of S_o; it exceeds 1, the value of S_o at high frequencies."""


def _points(value: Any, listed: Callable[[Any], Any]) -> Any:
    """Return a word unchanged, and check a list; pydantic's union would list both forms in every error."""
    if not isinstance(value, str):
        if value in ([], None):
            raise ValueError("is empty; list at least one operating point, or write model or domain")
        return listed(value)
    if value not in ("model", "domain"):
        raise ValueError(f"expected the word model or domain, or a list of operating points, found {value!r}")
    return value


def _plain(value: Any) -> Any:
    return value if isinstance(value, str) else [point.model_dump() for point in value]


if TYPE_CHECKING:
    PointsSchema = tuple[ImpactPoint, ...] | Literal["model", "domain"]
else:
    PointsSchema = Annotated[
        tuple[ImpactPoint, ...],
        WrapValidator(_points),
        PlainSerializer(_plain),
        WithJsonSchema(
            {
                "anyOf": [
                    {"enum": ["model", "domain"]},
                    {"type": "array", "items": ImpactPoint.model_json_schema(), "minItems": 1},
                ]
            }
        ),
    ]


class DrawnPlantsSection(Section):
    """Plants besides the surfaces themselves; the design must meet the limits for each.

    `plants`: ``draws`` from the covariance of the surfaces' coefficients, or ``recordings``: the fit of every
    recording by its deviation from the surfaces, at all operating points.
    """

    plants: Literal["draws", "recordings"] = "draws"
    draws: Count = 10
    seed: CountOrZero = 0


Probability = Annotated[float, Strict(), AllowInfNan(False), Field(ge=0.5, lt=1)]


class RobustSection(Section):
    """Design that holds with a probability over plants drawn from the surfaces; see `gbid.control.tune_robust`.

    The draws come from the covariance of the coefficients and the scatter between recordings. `price`: further
    probabilities, for the curve of the price of robustness.
    """

    probability: Probability = 0.95
    confidence: Annotated[float, Strict(), AllowInfNan(False), Field(gt=0, lt=1)] = 0.95
    draws: Annotated[int, Strict(), Field(ge=10)] = 200
    fresh: Annotated[int, Strict(), Field(ge=10)] = 500
    seed: CountOrZero = 0
    price: tuple[Probability, ...] = ()


class ControllerSection(Section):
    """Controller of fixed structure with gains tuned over operating points (paper, Sec. 5); see `gbid.tune`.

    `structure`: ``P``, ``PD``, ``PI``, ``PID``, ``biquad``, ``filter``, ``lead-lag``, ``notch``, ``PPF``, ``observer``,
    ``resonant``, ``full P``, ``full PD``, ``full biquad``, or your own as ``file.py:name``. `lowpass_hz`, `order` and
    `tune_corner` (whether the corner is a gain as well) are options of the built-in structures; `options` holds those
    of one structure by name, such as ``{filter_order: 6}``.
    `schedule`: terms of pressure and speed on which the gains depend; without it gains are constant.
    `model`: ``lpv`` or ``lpv_direct`` for the surfaces of this experiment, else the name or file of a model. When it is
    left out, the surfaces are used if there is a section lpv, else the model of the rig.
    `operating_points`: ``model`` for those of the model, ``domain`` for its whole rectangle, or a list.
    `peak_sensitivity`: null for none. `goals`: objectives and limits by the names of `gbid.control`, each with its
    arguments, such as ``{goal: PeakSensitivity, limit: 2.0}``; they replace `objective` and `peak_sensitivity`.
    `robust`: a design that holds with a probability; it needs goals and, as `uncertainty` does, the surfaces of this
    experiment.
    `pareto`: further caps on the peak of S_o; the same design is tuned under each.
    `sample_time_s` and `method`: sampling of the controller file; the default is the sample time of the rig.
    `design_for`: ``sampled`` tunes the loop as it runs, with the delay of sampling and one sample for computation;
    ``continuous`` tunes the loop of the paper, which has more damping than the loop that will run.
    """

    structure: Text = "P"
    lowpass_hz: Positive | None = None
    order: CountOrZero | None = None
    tune_corner: Switch | None = None
    options: dict[Text, Number | Pair] = Field(default_factory=dict)
    schedule: Annotated[tuple[Term, ...], Field(min_length=1)] | None = None
    model: Text | None = None
    operating_points: PointsSchema = "model"
    peak_sensitivity: Cap | None = 2.6
    objective: Literal["damping", "decay"] = "damping"
    design_for: Literal["continuous", "sampled"] = "continuous"
    goals: Annotated[tuple[GoalEntry, ...] | None, BeforeValidator(given), Field(min_length=1)] = None
    bounds: dict[Text, Pair] = Field(default_factory=dict)
    uncertainty: Annotated[DrawnPlantsSection | None, BeforeValidator(given)] = None
    robust: Annotated[RobustSection | None, BeforeValidator(given)] = None
    start: dict[Text, Number] = Field(default_factory=dict)
    starts: Count | None = None
    seed: CountOrZero = 0
    pareto: tuple[Cap, ...] = ()
    sample_time_s: Positive | None = None
    method: Literal["tustin", "zoh"] = "tustin"


# ---- Schema of an experiment YAML: keys, types and ranges. Checks across sections are in `checks`.


class ExperimentFile(Section):
    """Whole experiment file."""

    format: Literal[1]
    name: Name
    title: str = ""
    results: Text | None = None
    rig: Annotated[RigSection | None, BeforeValidator(given)] = None
    imported: Annotated[ImportSection | None, BeforeValidator(given)] = Field(default=None, alias="import")
    prefilter: Annotated[PrefilterSection | None, BeforeValidator(given)] = None
    static: dict[Name, StaticSection] = Field(default_factory=dict)
    fits: dict[Name, FitSection] = Field(default_factory=dict)
    excite: dict[Name, ExciteSection] = Field(default_factory=dict)
    crossval: dict[Text, CrossvalSection] = Field(default_factory=dict)
    nominal: Annotated[NominalSection | None, BeforeValidator(given)] = None
    lpv: Annotated[LpvSection | None, BeforeValidator(given)] = None
    controller: dict[Name, ControllerSection] = Field(default_factory=dict)
    target: Annotated[TargetSection | None, BeforeValidator(given)] = None
    impacts: Annotated[ImpactsSection | None, BeforeValidator(given)] = None
    cycle: Annotated[CycleSection | None, BeforeValidator(given)] = None
    figures: dict[Text, FigureSection] = Field(default_factory=dict)


# ---- Patterns of file names with conditions, such as ``p{pressure_bar:g}_n{speed_rpm:d}_{kind}.mat``.

_SPELT = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})
_FIELD = re.compile(r"\{(?P<name>[^{}:]*)(?::(?P<kind>[^{}]*))?\}")
_NUMBER = r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"
_FORMS = {"g": _NUMBER, "d": r"[-+]?\d+", "": r"[^/]+?"}


def name_of(text: str) -> str:
    """Return a text of a file name as the name of a recording: blanks and other signs become ``_``."""
    plain = unicodedata.normalize("NFKD", unicodedata.normalize("NFC", text).translate(_SPELT))
    word = re.sub(r"[^A-Za-z0-9_.+-]+", "_", plain.encode("ascii", "ignore").decode()).strip("_")
    return word if word[:1].isalnum() else f"r{word}"


@dataclass(frozen=True)
class NamePattern:
    """Pattern of file names.

    Attributes
    ----------
    text : str
        The pattern as written.
    fields : tuple of str
        Names of the fields.
    numbers : tuple of str
        Names of the fields that are numbers; these are conditions.
    regex : re.Pattern
        The pattern as a regular expression.
    """

    text: str
    fields: tuple[str, ...]
    numbers: tuple[str, ...]
    regex: re.Pattern[str]

    def read(self, path: str) -> dict[str, str | float] | None:
        """Return the fields of a file name; None when it does not match.

        Parameters
        ----------
        path : str
            Relative path, with ``/``.

        Returns
        -------
        dict of str to str or float
            Values by field.
        """
        match = self.regex.fullmatch(path)
        if match is None:
            return None
        found = match.groupdict()
        return {name: float(found[name]) if name in self.numbers else found[name] for name in self.fields}


def name_pattern(text: str) -> NamePattern:
    """Return the pattern of a text.

    Raises
    ------
    UsageError
        When a field has no name, an unknown form, or occurs twice, or when a brace has no partner.
    """
    parts, fields, numbers, end = [], [], [], 0
    for match in _FIELD.finditer(text):
        name, form = match["name"], match["kind"] or ""
        parts.append(_literal(text, text[end : match.start()]))
        end = match.end()
        if not name.isidentifier():
            raise UsageError(f"{text!r}: {match[0]} names no field; write {{name}}, {{kind}} or {{pressure_bar:g}}")
        if form not in _FORMS:
            raise UsageError(f"{text!r}: {match[0]}: unknown form {form!r}; write :g for a number, :d for a whole one")
        if name in fields:
            raise UsageError(f"{text!r}: field {name!r} occurs twice; rename or remove one")
        if form and name in ("name", "kind"):
            raise UsageError(f"{text!r}: {name} is a word, not a number; write {{{name}}}")
        if not form and name in ("pressure_bar", "speed_rpm"):
            raise UsageError(f"{text!r}: {name} is a number; write {{{name}:g}}")
        fields.append(name)
        if form:
            numbers.append(name)
        parts.append(f"(?P<{name}>{_FORMS[form]})")
    parts.append(_literal(text, text[end:]))
    return NamePattern(text, tuple(fields), tuple(numbers), re.compile("".join(parts)))


def _literal(text: str, part: str) -> str:
    if "{" in part or "}" in part:
        raise UsageError(f"{text!r}: a brace has no partner; write fields as {{name}}")
    return re.escape(part)
