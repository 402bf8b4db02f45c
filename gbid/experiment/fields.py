"""Kinds of values in an experiment YAML: strict, so that nothing is read as what it is not."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AllowInfNan, BaseModel, BeforeValidator, ConfigDict, Field, Strict, WithJsonSchema


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _one_or_several(kind: dict[str, Any]) -> WithJsonSchema:
    """Tell editors that a single word needs no list."""
    return WithJsonSchema({"anyOf": [kind, {"type": "array", "items": kind, "minItems": 1}]})


Number = Annotated[float, Strict(), AllowInfNan(False)]
Positive = Annotated[float, Strict(), AllowInfNan(False), Field(gt=0)]
NotNegative = Annotated[float, Strict(), AllowInfNan(False), Field(ge=0)]
Count = Annotated[int, Strict(), Field(ge=1)]
CountOrZero = Annotated[int, Strict(), Field(ge=0)]
Switch = Annotated[bool, Strict()]
Text = Annotated[str, Field(min_length=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$")]
"""A name that also names files."""
Names = Annotated[
    tuple[Text, ...],
    BeforeValidator(_as_list),
    Field(min_length=1),
    _one_or_several({"type": "string", "minLength": 1}),
]
"""One or several names; a single one needs no list."""
Pair = tuple[Number, Number]
TwoRows = tuple[tuple[Number, ...], tuple[Number, ...]]
Holds = Annotated[
    tuple[Literal["zoh", "foh"], ...],
    BeforeValidator(_as_list),
    Field(min_length=1),
    _one_or_several({"enum": ["zoh", "foh"]}),
]


class Section(BaseModel):
    """A block of keys: unknown ones are refused, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())
