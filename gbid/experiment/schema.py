"""Schema of an experiment YAML, section by section, and patterns of file names."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    PlainSerializer,
    Tag,
    WithJsonSchema,
)

from gbid.control.tuning.design_options import DesignOptions
from gbid.core.errors import UsageError
from gbid.core.option_types import (
    Allowed,
    Count,
    CountOrZero,
    Duration,
    Exact,
    Finite,
    LimitedCount,
    LimitedCountOrZero,
    NotNegative,
    Order,
    Positive,
    Share,
)
from gbid.core.units import conversion_factor
from gbid.experiment.fields import (
    Deferred,
    Holds,
    Name,
    Names,
    NamesOrNone,
    OptionsSection,
    Pair,
    Section,
    Switch,
    Text,
    given,
)
from gbid.experiment.rig_schema import Axes, LoopSection, NamedController, Places, RigSection
from gbid.export.chain import ChainOptions
from gbid.identify.options import FitOptions, Scope
from gbid.lpv import MachineData
from gbid.lpv.model import SCHEDULING, TERMS


class CrossvalSection(Section):
    """Recordings on which the models of a fit are validated (paper, Sec. 3.8).

    `on`: ``cyclic`` is model j on recording j + 1 of its operating point, the last on the first; ``others`` each model
    on all other excited recordings; ``point`` on those of its own operating point; else names of recordings.
    `residuals` are tested for all ``pairs``, for the first pair of each of the ``models``, or not at all (``none``).
    The default is all pairs when there are at most 200, else one pair for each model.
    """

    on: Names = ("cyclic",)
    minimum_percent: Finite | None = None
    residuals: Literal["pairs", "models", "none"] | None = None


class HammerTrain(Section):
    """Impacts along each axis, and how their ring-downs are fitted.

    `repeats` is the number of impacts in a recording, `spacing_s` the time between them.
    """

    axes: Axes = ("x", "y")
    peak_n: Positive = 12.0
    impact_s: Duration = 2e-3
    repeats: LimitedCount = 5
    spacing_s: Duration = 0.4
    harmonics: LimitedCountOrZero | None = None
    lags: Annotated[int, Exact(), Ge(0), Le(6)] | Literal["auto"] = "auto"


class ImpactsSection(HammerTrain):
    """Hammer impacts with and without a controller (paper, Sec. 5.1); see `gbid.fit_ringdown`, `gbid.validate_impact`.

    `controller`: ``paper`` is the controller in the model file of the rig, ``tuned`` the design of the
    section controller (``tuned:NAME`` when there are several), else a controller file, or ``file.py:name``.
    `beside`: further closed loops by name, each with a controller written in the same way.
    `model`: model that predicts the modes: a name, a file, or ``lpv`` for the surfaces of this experiment;
    the model of the rig when left out. `repeats` is the number of impacts in a recording, `spacing_s` the time between
    them.
    """

    controller: NamedController = Field(default="paper", validate_default=True)
    beside: dict[Name, NamedController] = Field(default_factory=dict)
    model: Text | None = None
    operating_points: Places
    loops: Annotated[tuple[Literal["open", "closed"], ...], Field(min_length=1)] = ("open", "closed")


MOST_ROUNDS = 5


class TrialSection(HammerTrain):
    """Impacts that measure the damping of each round.

    `operating_points`: where the rotor is hit; by default at the points of the new recordings.
    """

    operating_points: Places | None = None


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
    rounds: Annotated[int, Exact(), Ge(1), Le(MOST_ROUNDS)] = 2
    operating_points: Places | None = None
    recordings: LimitedCount = 1
    in_run: Switch = True
    duration_s: Duration | None = None
    amplitude_m: Positive | None = None
    hold_s: Duration | None = None
    impacts: Annotated[TrialSection, BeforeValidator(given)] = TrialSection()


class ExciteLimitsSection(Section):
    """Limits of an excitation; see `gbid.excite.ExcitationLimits`.

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
    duration_s: Duration = 5.0
    kind: Literal["multisine", "prbs"] = "multisine"
    focus: Annotated[Names | dict[Text, Positive], Allowed("names, or positive weights by name")] | None = None
    together: Switch = True
    limits: ExciteLimitsSection


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


class StructureOptions(Section):
    """Options of a built-in structure; `order` and `piece_s` are for scheduled ones, see `gbid.scheduled`.

    Those from `axes` on are for magnetic bearings, see `gbid.structure.RigidRotor` and `gbid.MagneticBearing`.
    """

    delay: Literal["exact", "pade"] | None = None
    pade_order: Order | None = None
    disturbance_gain: Literal["full", "diagonal", "states", "none"] | None = None
    poles: Literal["real", "any"] | None = None
    film: Literal["linear", "stiffening"] | None = None
    unbalance: Switch | None = None
    order: Annotated[int, Exact(), Ge(0), Le(2)] | None = None
    piece_s: Positive | None = None
    axes: Names | None = None
    mass_kg: Positive | None = None
    inertia_kg_m2: Positive | None = None
    polar_inertia_kg_m2: NotNegative | None = None
    arms_m: tuple[Finite, Finite] | None = None
    sensor_arms_m: tuple[Finite, Finite] | None = None
    speed_rpm: Finite | None = None
    k_s: Finite | None = None
    k_i: Finite | None = None
    amplifier_hz: Positive | None = None
    amplifier_delay_s: NotNegative | None = None
    longest_delay_s: Positive | None = None
    sensor_hz: Positive | None = None


class PriorSection(Section):
    """Prior knowledge of a parameter: a normal distribution, in the unit of the parameter."""

    value: Finite
    std: Positive


class MultiStartSection(Section):
    """Further starts, drawn at random; see `gbid.fit_multistart`."""

    starts: Annotated[int, Exact(), Ge(2), Le(10_000)] = 10
    seed: CountOrZero = 0
    reach: Positive = 0.5


class ResponseSection(Section):
    """File of frequency responses, with what it does not state, as `gbid.FrequencyData.read` takes it.

    `reference`: they are responses of a closed loop, of the inputs and outputs of the fit to these signals.
    """

    file: Text
    averages: Positive | None = None
    std: Positive | None = None
    reference: Names | None = None


if TYPE_CHECKING:
    _Response = ResponseSection
else:
    _file = Annotated[Text, AfterValidator(lambda file: ResponseSection(file=file)), Tag("file")]
    _Response = Annotated[
        _file | Annotated[ResponseSection, Tag("section")],
        Discriminator(lambda value: "file" if isinstance(value, str) else "section"),
    ]
Stretches = Annotated[tuple[tuple[NotNegative, Positive], ...], Field(min_length=1)]


class FitSection(OptionsSection, FitOptions, frozen=True):
    """One fit of a structure, to each recording or to all together; its other keys are options: see `gbid.fit`.

    `left_out`: by name of a recording, stretches ``[from, to]`` [s] from the first sample; the sample at ``to`` is used
    again. `local` needs `together`. ``inputs: []`` is a free decay. `loop`: the recordings were made under a
    controller; the structure is then that of the loop, from what was injected. `responses`: files of frequency
    responses, or such a file with its `averages`, `std` or `reference`. They are fitted in one criterion with the
    recordings, or alone with ``recordings: []``.
    """

    structure: Text
    options: StructureOptions = StructureOptions()
    loop: Annotated[LoopSection | None, BeforeValidator(given)] = None
    recordings: NamesOrNone | None = None
    responses: tuple[_Response, ...] = ()
    together: Switch = False
    multi_start: MultiStartSection | None = None
    # Options of `gbid.fit` that have another form in the YAML.
    inputs: NamesOrNone | None = None
    outputs: Names | None = None
    intersample: Holds | None = None
    window: Annotated[
        Annotated[int, Exact(), Ge(2)] | Literal["auto"] | None,
        BeforeValidator(lambda word: None if word == "one" else word),
        Allowed("a number of samples, at least 2, or the word auto or one (single shooting)"),
        WithJsonSchema({"anyOf": [{"enum": ["auto", "one"]}, {"type": "integer", "minimum": 2}]}),
    ] = "auto"
    fixed: dict[Text, Finite] = Field(default_factory=dict)
    bounds: dict[Text, tuple[Finite | None, Finite | None]] = Field(default_factory=dict)  # type: ignore[assignment]
    prior: dict[Text, PriorSection] = Field(default_factory=dict)  # type: ignore[assignment]
    local: dict[Text, Scope] = Field(default_factory=dict)
    left_out: dict[Text, Stretches] = Field(default_factory=dict)  # type: ignore[assignment]  # in seconds


Kind = Literal["excited", "stationary", "staircase"]
KINDS: dict[str, Kind] = {
    "excited": "excited",
    "prbs": "excited",
    "stationary": "stationary",
    "still": "stationary",
    "staircase": "staircase",
}
"""Words for the kind of a recording in file names and tables."""


class CalibrationSection(Section):
    """Points of a calibration sheet: numbers in the file, and values in the unit of the signal."""

    points: Annotated[list[tuple[Finite, Finite]], Field(min_length=2)]


_Calibration = Annotated[
    Annotated[CalibrationSection, Tag("section")] | Annotated[list[CalibrationSection], Tag("list")],
    Discriminator(lambda value: "list" if isinstance(value, list) else "section"),
]


class ColumnsSection(Section):
    """Columns of one signal in a file; see `gbid.recording.SignalMapping`.

    `rests_at_limits`: the signal stays at its largest or smallest value by design, as an input may. It is then not
    reported as saturated.
    """

    columns: Names
    unit: str | None = None
    stored_unit: str | None = None
    channels: Names | None = None
    hold: Switch = False
    interpolate: Switch = False
    scale: Finite | list[Finite] | None = None
    offset: Finite | list[Finite] | None = None
    calibration: _Calibration | None = None
    rests_at_limits: Switch = False


class FileSection(Section):
    """Mapping of a file; see `gbid.recording.ImportMapping`.

    `remove_mean` subtracts the mean of each signal over the samples used; a linear model has no offset.
    """

    sample_time_s: Positive | None = None
    time: Text | None = None
    time_unit: Text | None = None
    samples: tuple[CountOrZero, Count | None] | None = None
    axis: Literal[0, 1] | None = None
    from_s: NotNegative | None = None
    to_s: Positive | None = None
    piece: Count | None = None
    gaps: Literal["pieces", "missing"] | None = None
    encoding: Text | None = None
    decimal: Literal[".", ","] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    header_line: CountOrZero | None = None
    remove_mean: Switch = False
    conditions: dict[Text, Finite] = Field(default_factory=dict)
    signals: Annotated[dict[Text, ColumnsSection], Field(min_length=1)]


class ImportedSection(FileSection):
    """One recording from a file; see `gbid.recording.ImportMapping`.

    `remove_mean` subtracts the mean of each signal over the samples used; a linear model has no offset.
    """

    name: Name
    file: Text
    kind: Kind = "excited"


class ListedSection(FileSection):
    """Mapping of many files: kinds of recordings by words, and whether they need an operating point."""

    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    more_conditions: Names = ()
    operating_point: Switch = True


class FolderSection(ListedSection):
    """All files of the data folder whose names match a pattern; see `gbid.recording.ImportMapping`.

    `pattern` is a file name with fields: ``{name}`` and ``{kind}``, ``{pressure_bar:g}`` (a number, with a decimal
    point or comma), ``{speed_rpm:d}`` (a whole number), and any other word for a part that is ignored. With a ``/`` in
    it, subfolders are searched. `more_conditions` names further fields to store as conditions. `kinds` gives the
    meaning of the words of ``{kind}``, `kind` that of a recording without this field. `ignore` lists patterns of files,
    with ``*`` and ``?``, that do not belong to the experiment. `operating_point` may be false for rigs without pressure
    and speed.
    """

    pattern: Text
    ignore: Names = ()


class TableSection(ListedSection):
    """Recordings listed in a CSV table in the data folder; see `gbid.recording.ImportMapping`.

    Each recording has a row with the columns ``file``, ``pressure_bar``, ``speed_rpm``, and optionally ``name`` and
    ``kind``. `more_conditions` names further columns to store as conditions. `operating_point` may be false for rigs
    without pressure and speed.
    """

    file: Text


class ImportSection(Section):
    """Recordings from measured files: listed one by one, found by file name, or listed in a table."""

    data_folder: Text = "."
    recordings: Annotated[tuple[ImportedSection, ...], Field(min_length=1)] | None = None
    folder: FolderSection | None = None
    table: TableSection | None = None


_Terms = Annotated[tuple[Text, ...], Field(min_length=1)]
_ORDER = Annotated[
    Annotated[int, Exact(), Ge(0), Le(3)] | Literal["auto"] | _Terms,
    Allowed("0, 1, 2, auto, or a list of terms such as " + ", ".join(f'"{term}"' for term in TERMS)),
]


class LpvSection(Section):
    """Surfaces of the key parameters of a fit to each recording (paper, Eq. 16); see `gbid.fit_lpv`.

    `scheduling`: conditions of the recordings over which the surfaces are fitted; by default pressure and speed. Terms
    of others have their names, such as ``"eccentricity^2"``.
    `actuators`: the word ``nominal`` (choice of the section nominal), or the name or file of a model; default none.
    `direct`: whether the surfaces are also estimated directly from the recordings; see `gbid.fit_lpv_direct`.
    """

    fit: Name
    weighting: Literal["scatter", "fits", "ordinary"] = "scatter"
    scheduling: Annotated[Names, Field(min_length=1)] = SCHEDULING
    order: _ORDER = 2
    robust: Switch = False
    direct: Switch = False
    actuators: Text | None = None


class NominalSection(Section):
    """Fit whose most central model is the nominal actuator; see `gbid.validate.nominal_actuator`."""

    fit: Name


class PrefilterSection(Section):
    """Corrections of the excited recordings before the fits (paper, Sec. 3.5).

    `harmonics`: their number, or ``auto`` for the smallest one that leaves no more than others on held-out data.
    `slow_roll`: stationary recordings at a low speed. Their map, the run-out alone, is for recordings without an
    operating point, in which the speed changes; a fit estimates the unbalance of those (option ``unbalance``).
    """

    method: Literal["harmonics", "bins", "auto", "none"] = "harmonics"
    align_index: Switch = False
    harmonics: LimitedCount | Literal["auto"] = 10
    bins: Annotated[int, Exact(), Ge(4), Le(100_000)] = 100
    spikes: Switch = True
    median: LimitedCount = 1
    remove_mean: Switch = True
    slow_roll: Names | None = None


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
    limits: Pair | None = None


def wanted_signals(section: StaticSection) -> dict[str, str]:
    """Return the signals of a static section by key, with defaults filled in."""
    source = {} if section.kind == "piezo" else {"source": section.source or "u"}
    position = section.position or ("u" if section.kind == "piezo" else "p")
    return {"command": section.command or "r", **source, "position": position}


class MachineSection(OptionsSection, MachineData, frozen=True):
    """Numbers of a real machine that no recording shows; see `gbid.lpv.MachineData`.

    `moving_mass_kg`: without it the response to an impact is left out of tables, report and explorer. `piezo_travel_m`
    and `clearance_m`: without them there is no control chain in C, unless the section target has its limits. A virtual
    rig and a model that comes with gbid have their own.
    """


class TargetSection(OptionsSection, ChainOptions, frozen=True):
    """Limits, ramps, guards and watchdog of the control chain in C; see `gbid.export.ChainOptions`.

    What is left out follows from the travel of the stacks and the clearance, which the section machine or rig gives.
    """


def _goal_form() -> Any:
    from gbid.experiment.goal_schema import GoalForm  # what computes the goals is a tenth of a start

    return GoalForm


if TYPE_CHECKING:
    from gbid.experiment.goal_schema import GoalEntry as _Goal
else:
    _Goal = Annotated[Any, Deferred(_goal_form), PlainSerializer(vars)]


Cap = Annotated[float, Exact(finite=True), Gt(1)]
"""Cap on the peak of S_o; it exceeds 1, the value of S_o at high frequencies."""
_Word = Annotated[
    Literal["model", "domain"], Allowed("the word model or domain, or a list of operating points"), Tag("word")
]
_Points = Annotated[
    _Word | Annotated[Places, Tag("list")],
    Discriminator(lambda value: "list" if value and not isinstance(value, str) else "word"),
]


class DrawnPlantsSection(Section):
    """Plants besides the surfaces themselves; the design must meet the limits for each.

    `plants`: ``draws`` from the covariance of the surfaces' coefficients, or ``recordings``: the fit of every
    recording by its deviation from the surfaces, at all operating points.
    """

    plants: Literal["draws", "recordings"] = "draws"
    draws: Annotated[Count, Le(10_000)] = 10
    seed: CountOrZero = 0


Probability = Annotated[float, Exact(finite=True), Ge(0.5), Lt(1)]


class RobustSection(Section):
    """Design that holds with a probability over plants drawn from the surfaces; see `gbid.control.tune_robust`.

    The draws come from the covariance of the coefficients and the scatter between recordings. `price`: further
    probabilities, for the curve of the price of robustness.
    """

    probability: Probability = 0.95
    confidence: Annotated[float, Exact(finite=True), Gt(0), Lt(1)] = 0.95
    draws: Annotated[int, Exact(), Ge(10), Le(100_000)] = 200
    fresh: Annotated[int, Exact(), Ge(10), Le(100_000)] = 500
    seed: CountOrZero = 0
    price: tuple[Probability, ...] = ()


_Option = Annotated[
    Finite | str | tuple[Finite, ...] | tuple[str, ...], Allowed("a number, a word, or a list of either")
]


class ControllerSection(OptionsSection, DesignOptions, frozen=True):
    """Controller of fixed structure with gains tuned over operating points; see `gbid.control.TuneOptions`.

    `structure`: ``P``, ``PD``, ``PI``, ``PID``, ``biquad``, ``filter``, ``lead-lag``, ``notch``, ``PPF``, ``observer``,
    ``resonant``, ``full P``, ``full PD``, ``full biquad``, or your own as ``file.py:name``. `lowpass_hz`, `order` and
    `tune_corner` (whether the corner is a gain as well) are options of the built-in structures; `options` holds those
    of one structure by name, such as ``{filter_order: 6}`` or ``{coupling: gyroscopic, notch_orders: [1.0]}``.
    `schedule`: terms of pressure and speed, or of the other variables of the model, on which the gains depend; without
    it gains are constant.
    `model`: ``lpv`` or ``lpv_direct`` for the surfaces of this experiment, a fit of it, whose models of any machine are
    the plants together, or the name or file of a model. When it is left out, the surfaces are used if there is a
    section lpv, else the model of the rig.
    `inputs`, `outputs`: channels of the models of a fit that the controller drives and measures; by default all. The
    axes of the controller are an option of its structure: ``options: {axes: [""]}`` is one input and one output.
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
    order: Annotated[CountOrZero, Le(20)] | None = None
    tune_corner: Switch | None = None
    options: dict[Text, _Option] = Field(default_factory=dict)
    schedule: _Terms | None = None
    model: Text | None = None
    inputs: tuple[Text, ...] | None = None
    outputs: tuple[Text, ...] | None = None
    operating_points: _Points = "model"
    peak_sensitivity: Cap | None = 2.6
    design_for: Literal["continuous", "sampled"] = "continuous"
    goals: Annotated[tuple[_Goal, ...] | None, BeforeValidator(given), Field(min_length=1)] = None
    bounds: dict[Text, Pair] = Field(default_factory=dict)
    uncertainty: Annotated[DrawnPlantsSection | None, BeforeValidator(given)] = None
    robust: Annotated[RobustSection | None, BeforeValidator(given)] = None
    start: dict[Text, Finite] = Field(default_factory=dict)
    pareto: tuple[Cap, ...] = ()
    sample_time_s: Positive | None = None


class ExperimentFile(Section):
    """Whole experiment file."""

    format: Literal[1]
    name: Name
    title: str = ""
    results: Text | None = None
    rig: Annotated[RigSection | None, BeforeValidator(given)] = None
    machine: MachineSection = MachineSection()
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


# ---- File names with conditions: patterns such as ``p{pressure_bar:g}_n{speed_rpm:d}_{kind}.mat``, or found by gbid.

_SPELT = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})
_FIELD = re.compile(r"\{(?P<name>[^{}:]*)(?::(?P<kind>[^{}]*))?\}")
_NUMBER = r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?"
_FORMS = {"g": _NUMBER, "d": r"[-+]?\d+", "": r"[^/]+?"}


def name_of(text: str) -> str:
    """Return a file name as a recording name: blanks and special characters become ``_``."""
    plain = unicodedata.normalize("NFKD", unicodedata.normalize("NFC", text).translate(_SPELT))
    word = re.sub(r"[^A-Za-z0-9_.+-]+", "_", plain.encode("ascii", "ignore").decode()).strip("_")
    return word if word[:1].isalnum() else f"r{word}"


@dataclass(frozen=True)
class NamePattern:
    """Pattern of file names with fields for conditions.

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
        """Return the fields of a file name; None without a match.

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
        cells = {name: match[name] for name in self.fields}
        return {n: float(cell.replace(",", ".")) if n in self.numbers else cell for n, cell in cells.items()}


def name_pattern(text: str) -> NamePattern:
    """Return the pattern of file names that a text describes.

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
        faults = {
            f"{match[0]} names no field; write {{name}}, {{kind}} or {{pressure_bar:g}}": not name.isidentifier(),
            f"{match[0]}: unknown form {form!r}; write :g for a number, :d for a whole one": form not in _FORMS,
            f"field {name!r} occurs twice; rename or remove one": name in fields,
            f"{name} is a word, not a number; write {{{name}}}": form and name in ("name", "kind"),
            f"{name} is a number; write {{{name}:g}}": not form and name in ("pressure_bar", "speed_rpm"),
        }
        if wrong := [words for words, is_wrong in faults.items() if is_wrong]:
            raise UsageError(f"{text!r}: {wrong[0]}")
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


_UNIT_WITH_SIGNS = (
    r"(?<![^\W\d_])(?:1|u|r|revs?|tr|umdr)[\W_](?:p(?:er|ro)[\W_])?min(?![^\W\d_])|(?<![^\W\d_])min[\W_]{1,2}1(?!\d)"
)
_TOKEN = re.compile(rf"{_UNIT_WITH_SIGNS}|\d+(?:[.,]\d+)?|[^\W\d_]+|[\W_]", re.IGNORECASE)
_BEFORE = {  # words before the number
    "pressure_bar": {"p", "ps", "psup", "druck", "pressure", "press", "bar"},
    "speed_rpm": {"n", "drehzahl", "speed", "rpm", "upm", "omega", "om"},
}
_THOUSANDS = re.compile(r"\d{1,3}[.,]\d{3}")  # 4.200 rpm: decimals or a thousands sign


@dataclass(frozen=True)
class NamesRead:
    """Common pattern of a set of file names.

    Attributes
    ----------
    pattern : NamePattern
        The pattern.
    tells_kind : bool
        Whether a single word differs between the files, which may be their kind.
    factors : dict of str to float
        Factors of fields in other units, which a pattern cannot read.
    """

    pattern: NamePattern
    tells_kind: bool
    factors: Mapping[str, float] = field(default_factory=dict)

    def read(self, file: str) -> dict[str, str | float] | None:
        """Return the fields of a file name; None without a match."""
        fields = self.pattern.read(file)
        factors = self.factors if fields else {}
        return fields and {**fields, **{key: float(f"{float(fields[key]) * f:.12g}") for key, f in factors.items()}}


def tokens_of(name: str) -> list[str]:
    """Return the words, numbers and separators of a file name."""
    return _TOKEN.findall(name)


def read_names(files: Sequence[str]) -> NamesRead | None:
    """Return the common pattern of file names with equal words and separators and different numbers.

    A number before ``bar`` or after ``p`` is the pressure, one before ``rpm``, ``Umin``, ``1-min`` or after ``n`` the
    speed. One word may differ between the files.

    Parameters
    ----------
    files : sequence of str
        Names of the files with the same ending.

    Returns
    -------
    NamesRead or None
        None when the names have different forms.
    """
    split = [tokens_of(file.rpartition(".")[0]) for file in files]
    if len({tuple(map(_form, tokens)) for tokens in split}) != 1:
        return None
    parts: list[str] = []
    words: list[str] = []
    factors: dict[str, float] = {}
    quantities = _quantities(split[0])
    for i, column in enumerate(zip(*split, strict=True)):
        token, differs = column[0], len(set(column)) > 1
        quantity, factor = quantities.get(i, ("nr" if _form(token) == "number" else "", 1.0))
        if quantity == "speed_rpm" and any(map(_THOUSANDS.fullmatch, column)):
            quantity = "nr"
        if quantity and quantity not in factors and (quantity != "nr" or differs):
            factors[quantity] = factor
            integers = quantity != "pressure_bar" and all(each.isdigit() for each in column)
            parts.append(f"{{{quantity}:{'d' if integers else 'g'}}}")
        elif not differs:
            parts.append(token)
        elif quantity:
            parts.append(f"{{part{i}}}")
        else:
            words.append(f"word{i}" if words else "kind")
            parts.append(f"{{{words[-1]}}}")
    text = "".join(parts) + "." + files[0].rpartition(".")[2]
    others = {key: factor for key, factor in factors.items() if factor != 1.0}
    return NamesRead(name_pattern(text), len(words) == 1, others)


def _form(token: str) -> str:
    if re.fullmatch(r"[\d.,]*\d", token):
        return "number"
    return "word" if token[0].isalnum() else token


def _quantities(tokens: Sequence[str]) -> dict[int, tuple[str, float]]:
    """Return the quantities of the numbers in a file name by position, each with the factor to its unit.

    A word is the unit of the number before it, unless it is joined to the one behind it, or that before it is joined to
    a word of its own: V1 rpm4200.
    """
    quantities: dict[int, tuple[str, float]] = {}
    places = [k for k, token in enumerate(tokens) if token[0].isalnum()]
    numbers = {k for k in places if _form(tokens[k]) == "number"}
    for at, k in enumerate(places):
        word = tokens[k].lower()
        left, right = ({places[j]} & numbers if 0 <= j < len(places) else set() for j in (at - 1, at + 1))
        joined = bool(left) and k - 1 in left
        is_labelled = bool(right) and any(j - 1 in places for j in left)
        unit = _unit(word, joined)
        if unit and (left - quantities.keys()) and (joined or not (k + 1 in numbers or is_labelled)):
            quantities[min(left)] = unit
        elif right:
            quantities |= {min(right): (q, 1.0) for q, words in _BEFORE.items() if word in words}
    return quantities


_PASCALS = {"pa": "Pa", "kpa": "kPa", "mpa": "MPa"}


def _unit(word: str, joined: bool) -> tuple[str, float] | None:
    """Return quantity and factor of a unit; a single letter counts only right behind a number."""
    if pressure := factor_or_zero(_PASCALS.get(word, word), "bar"):
        return "pressure_bar", pressure
    parts = re.fullmatch(r"(.+?)[\W_]*(?:p(?:er|ro)[\W_]*)?min|min[\W_]+(1)", word)
    if parts and (speed := factor_or_zero(f"{parts[1] or parts[2]}/min", "rpm")):
        return "speed_rpm", speed
    is_turn = factor_or_zero(f"{word}/min", "rpm") == 1.0 and word not in ("1", "r") and (len(word) > 1 or joined)
    if is_turn or (word not in ("hz", "hertz") and len(word) > 1 and factor_or_zero(word, "rpm")):
        return "speed_rpm", 1.0 if is_turn else factor_or_zero(word, "rpm")
    return None


def factor_or_zero(unit: str, target: str) -> float:
    """Return the factor from one unit to another; 0 if the quantities differ."""
    try:
        return conversion_factor(unit, target)
    except UsageError:
        return 0.0
