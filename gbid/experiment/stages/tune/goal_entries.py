"""Schema of the goals of a design: one section for each goal of gbid.control, made from its arguments."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, cast, get_type_hints

from pydantic import BeforeValidator, Field, WithJsonSchema, create_model

from gbid import control
from gbid.control.impact.half_sine import HalfSine
from gbid.control.tuning.goals.bound import BoundLike
from gbid.control.tuning.goals.disturbance import DisturbanceSpectrum
from gbid.control.tuning.goals.goal import Goal
from gbid.experiment.fields import CountOrZero, Names, Number, Positive, Section, Switch
from gbid.experiment.problems import nearest

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
