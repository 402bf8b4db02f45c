"""Types of the values in an experiment YAML; they are strict: no value is converted to another type."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AllowInfNan, BaseModel, BeforeValidator, ConfigDict, Field, Strict, WithJsonSchema


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _one_or_several(kind: dict[str, Any], fewest: int = 1) -> WithJsonSchema:
    """Return a schema for editors that allows a single value in place of a list."""
    return WithJsonSchema({"anyOf": [kind, {"type": "array", "items": kind, "minItems": fewest}]})


def _one_or_two(value: Any) -> Any:
    numbers = tuple(value) if isinstance(value, list | tuple) else (value,)
    good = all(type(v) in (int, float) and math.isfinite(v) and v >= 0 for v in numbers)
    if not good or len(numbers) != (2 if isinstance(value, list | tuple) else 1):
        raise ValueError(f"expected a finite number of at least zero, or two of them for x and y, found {value!r}")
    return numbers if len(numbers) == 2 else numbers[0]


Number = Annotated[float, Strict(), AllowInfNan(False)]
Positive = Annotated[float, Strict(), AllowInfNan(False), Field(gt=0)]
NotNegative = Annotated[float, Strict(), AllowInfNan(False), Field(ge=0)]
Count = Annotated[int, Strict(), Field(ge=1)]
CountOrZero = Annotated[int, Strict(), Field(ge=0)]
Switch = Annotated[bool, Strict()]
Text = Annotated[str, Field(min_length=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$")]
"""Name that is also used in file names."""
Names = Annotated[
    tuple[Text, ...],
    BeforeValidator(_as_list),
    Field(min_length=1),
    _one_or_several({"type": "string", "minLength": 1}),
]
"""One or several names; a single name needs no list."""
NamesOrNone = Annotated[
    tuple[Text, ...],
    BeforeValidator(_as_list),
    _one_or_several({"type": "string", "minLength": 1}, fewest=0),
]
"""As `Names`, or an empty list."""
Pair = tuple[Number, Number]
OneOrTwo = Annotated[
    float | tuple[float, float],
    BeforeValidator(_one_or_two),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "number", "minimum": 0},
                {"type": "array", "items": {"type": "number", "minimum": 0}, "minItems": 2, "maxItems": 2},
            ]
        }
    ),
]
"""Standard deviation: one value for both axes, or one for x and one for y."""
TwoRows = tuple[tuple[Number, ...], tuple[Number, ...]]
Holds = Annotated[
    tuple[Literal["zoh", "foh"], ...],
    BeforeValidator(_as_list),
    Field(min_length=1),
    _one_or_several({"enum": ["zoh", "foh"]}),
]


class Section(BaseModel):
    """Section of the YAML: unknown keys are refused, and values are constant."""

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())


def given(value: Any) -> Any:
    """Return the value; refuse a key without a value."""
    if value is None:
        raise ValueError("is empty; write {} for the defaults, or leave the key out")
    return value
