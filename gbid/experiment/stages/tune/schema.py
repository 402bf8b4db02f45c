"""Schema of the controller section."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AllowInfNan, BeforeValidator, Field, PlainSerializer, Strict, WithJsonSchema, WrapValidator

from gbid.experiment.fields import Count, CountOrZero, NotNegative, Number, Pair, Positive, Section, Switch, Text, given
from gbid.experiment.stages.impact.schema import ImpactPoint
from gbid.experiment.stages.lpv.schema import Term
from gbid.experiment.stages.tune.goal_entries import GoalEntry

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
    Points = tuple[ImpactPoint, ...] | Literal["model", "domain"]
else:
    Points = Annotated[
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


class ImpactSection(Section):
    """Half-sine impact along x and along y, under which no piezo stack may exceed its travel."""

    peak_n: Positive = 12.0
    duration_s: Positive = 2e-3
    piezo_travel_m: Positive = 45e-6


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
    arguments, such as ``{goal: PeakSensitivity, limit: 2.0}``; they replace `objective`, `peak_sensitivity`,
    `peak_control`, `static_amplification`, `slowest_pole` and `impact`. `robust`: a design that holds with a
    probability; it needs goals and, as `uncertainty` does, the surfaces of this experiment.
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
    operating_points: Points = "model"
    peak_sensitivity: Cap | None = 2.6
    peak_control: Positive | None = None
    static_amplification: Positive | None = None
    slowest_pole: NotNegative | None = None
    objective: Literal["damping", "decay"] = "damping"
    design_for: Literal["continuous", "sampled"] = "continuous"
    impact: Annotated[ImpactSection | None, BeforeValidator(given)] = None
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
