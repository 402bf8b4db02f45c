"""Schema of the fits section: all options of `gbid.fit` and `gbid.fit_multistart`."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Strict, WithJsonSchema

from gbid.experiment.fields import (
    Count,
    CountOrZero,
    Holds,
    Names,
    NamesOrNone,
    NotNegative,
    Number,
    Positive,
    Section,
    Switch,
    Text,
    given,
)
from gbid.experiment.stages.loop.schema import LoopSection
from gbid.identify.disturbances.asked import HIGHEST_DEGREE, TREND_WORDS, TrendName


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


class FitSection(Section):
    """One fit of a structure, to each recording or to all together; see `gbid.fit`.

    `left_out`: by name of a recording, stretches ``[from, to]`` [s] from the first sample; the sample at ``to`` is used
    again. `local` needs `together`. ``inputs: []`` is a free decay. `loop`: the recordings were made under a
    controller; the structure is then that of the loop, from what was injected.
    """

    structure: Text
    options: StructureOptions = StructureOptions()
    loop: Annotated[LoopSection | None, BeforeValidator(given)] = None
    recordings: Names | None = None
    together: Switch = False
    inputs: NamesOrNone | None = None
    outputs: Names | None = None
    focus: Literal["prediction", "simulation"] = "prediction"
    intersample: Holds | None = None
    criterion: Literal["auto", "trace", "det"] = "auto"
    horizon: Count = 1
    output_weights: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    window: Annotated[
        int | Literal["auto"] | None,
        BeforeValidator(_window),
        WithJsonSchema({"anyOf": [{"enum": ["auto", "one"]}, {"type": "integer", "minimum": 2}]}),
    ] = "auto"
    stop: Literal["tolerance", "paper"] = "tolerance"
    max_iterations: Count = 100
    engine: Literal["auto", "compiled", "numpy"] = "auto"
    start: Annotated[
        dict[Text, Number] | Literal["data"],
        BeforeValidator(_start),
        WithJsonSchema({"anyOf": [{"const": "data"}, {"type": "object", "additionalProperties": {"type": "number"}}]}),
    ] = Field(default_factory=dict)
    fixed: dict[Text, Number] = Field(default_factory=dict)
    bounds: dict[Text, tuple[Number | None, Number | None]] = Field(default_factory=dict)
    prior: dict[Text, PriorSection] = Field(default_factory=dict)
    local: dict[Text, Literal["recording", "operating_point"]] = Field(default_factory=dict)
    offsets: Switch = False
    robust: Literal["huber", "student"] | None = None
    robust_threshold: Positive | None = None
    std: Literal["auto", "bootstrap"] = "auto"
    bootstrap_draws: Annotated[int, Strict(), Field(ge=50)] | None = None
    bootstrap_seed: CountOrZero | None = None
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
    left_out: dict[Text, Annotated[tuple[tuple[NotNegative, Positive], ...], Field(min_length=1)]] = Field(
        default_factory=dict
    )
    ipopt: dict[Text, Number | Text] = Field(default_factory=dict)
    multi_start: MultiStartSection | None = None
