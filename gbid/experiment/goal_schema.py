"""Schema of the goals of a design: one section for each goal of `gbid.control`, generated from its arguments.

The module is imported when a YAML has goals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, Union, cast, get_type_hints

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, Tag, create_model

from gbid import control
from gbid.control.loop.half_sine import HalfSine
from gbid.control.tuning.goals import BoundLike, DisturbanceSpectrum, Goal, Whirl
from gbid.core.errors import nearest
from gbid.core.option_types import Allowed, CountOrZero, Finite, Positive
from gbid.experiment.fields import Names, Pair, Section, Switch

GOALS: dict[str, type[Goal]] = {
    kind.__name__: kind
    for kind in (
        control.MaxDamping,
        control.MaxDecay,
        control.MinDamping,
        control.SlowestPole,
        control.FastestPole,
        control.PeakSensitivity,
        control.PeakComplementary,
        control.PeakControl,
        control.StaticAmplification,
        control.AxisSensitivity,
        control.RollOff,
        control.MinDiskMargin,
        control.MinGainMargin,
        control.MinPhaseMargin,
        control.RmsPosition,
        control.RmsControl,
        control.PeakResponse,
        control.RmsResponse,
        control.PiezoTravel,
    )
}
"""Goals that a YAML can name."""


@dataclass(frozen=True)
class GoalEntry:
    """Goal of a design as the YAML gives it.

    Attributes
    ----------
    goal : str
        Its name in `GOALS`.
    arguments : dict
        Arguments as plain values; those left out have the defaults of the goal.
    """

    goal: str
    arguments: Mapping[str, Any]


class HitSection(Section):
    """Half-sine impact of a goal."""

    peak_n: Positive = 12.0
    duration_s: Positive = 2e-3


_Row = Annotated[tuple[Finite, ...], Field(min_length=1)]


class TransferFunction(Section):
    """Limit over frequency as a transfer function: coefficients of powers of s, the highest first."""

    numerator: _Row
    denominator: _Row


_KINDS: dict[Any, Any] = {
    float: Finite,
    bool: Switch,
    int | None: CountOrZero,
    float | None: Positive,
    BoundLike: Annotated[
        Finite | Annotated[tuple[Pair, ...], Field(min_length=1)] | TransferFunction,
        Allowed(
            "a number, breakpoints as [[frequency_hz, limit], ...], or a transfer function as {numerator: [...], "
            "denominator: [...]} with the coefficients of powers of s, the highest first"
        ),
    ],
    HalfSine: HitSection,
    DisturbanceSpectrum: Names,
    Whirl: Annotated[Whirl, Allowed("both, forward or backward")],
    tuple[str, ...]: Names,
    tuple[float, ...]: tuple[Finite, ...],
}
"""Type in the YAML of each type of argument of a goal."""
_Spectrum = Annotated[
    tuple[_Row, ...],
    Field(min_length=2),
    Allowed("rows [frequency_hz, density of each source], in units squared per Hz, with rising frequencies"),
]
"""Spectrum of sources that are independent of each other."""


def _section_of(kind: type[Goal]) -> type[Section]:
    """Return the section class of a goal; arguments with a default are optional keys."""
    hints = get_type_hints(kind)
    arguments: dict[str, Any] = {"goal": (cast(Any, Literal)[kind.__name__], ...)}
    for argument in fields(cast(Any, kind)):
        required = str(argument.default) == str(argument.default_factory)  # both MISSING
        default = ... if required else Field(default_factory=lambda: None)  # has no default in the JSON schema
        allowed = _Spectrum if argument.name == "spectrum" else _KINDS[hints[argument.name]]
        arguments[argument.name] = (allowed, default)
    description = f"{(kind.__doc__ or '').splitlines()[0]} For its arguments see `gbid.control.{kind.__name__}`."
    return create_model(f"{kind.__name__}Section", __base__=Section, __doc__=description, **arguments)


def _named(value: Any) -> Any:
    """Return a goal entry of the list; refuse unknown goals, and entries without a goal."""
    if not isinstance(value, dict) or "goal" not in value:
        raise ValueError(f"expected a goal with its arguments, such as {{goal: MaxDamping}}, found {value!r}")
    if str(value["goal"]) not in GOALS:
        raise ValueError(f"no goal {value['goal']!r}; {nearest(str(value['goal']), GOALS)}")
    return value


def _as_entry(section: Any) -> GoalEntry:
    return GoalEntry(section.goal, section.model_dump(include=section.model_fields_set - {"goal"}))


_sections = tuple(Annotated[_section_of(kind), Tag(name)] for name, kind in GOALS.items())
_one_of = Annotated[Union[_sections], Field(discriminator="goal")]  # type: ignore[valid-type]  # noqa: UP007
GoalForm = Annotated[_one_of, BeforeValidator(_named), AfterValidator(_as_entry), PlainSerializer(vars)]
"""Type of an entry of the list of goals."""
