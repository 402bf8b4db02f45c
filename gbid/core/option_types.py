"""Options as frozen dataclasses: types with bounds, one check of values, and functions that take them by keywords."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cache, wraps
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Concatenate,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from gbid.core.errors import UsageError


@dataclass(frozen=True)
class Exact:
    """Mark of a type whose values pydantic does not convert: ``"3"``, ``3.0`` and ``True`` are no whole numbers.

    Attributes
    ----------
    finite : bool
        Whether a number must be finite.
    """

    finite: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Return the schema of pydantic for the type, strict."""
        schema = {**handler(source), "strict": True}
        return {**schema, "allow_inf_nan": False} if self.finite and schema["type"] == "float" else schema


@dataclass(frozen=True)
class Allowed:
    """Mark of a type: what it allows, in words; pydantic says them in place of what each form of the value would be.

    Attributes
    ----------
    text : str
        The words, as they stand after "give" and "expected".
    """

    text: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Return the schema of pydantic for the type, with one error in the words of the mark."""

        def checked(value: Any, inner: Callable[[Any], Any]) -> Any:
            try:
                return inner(value)
            except ValueError:
                raise ValueError(f"expected {self.text}, found {value!r}") from None

        return {
            "type": "function-wrap",
            "function": {"type": "no-info", "function": checked},
            "schema": handler(source),
        }


Number = Annotated[float, Exact()]
Finite = Annotated[float, Exact(finite=True)]
Positive = Annotated[float, Exact(finite=True), Gt(0)]
NotNegative = Annotated[float, Exact(finite=True), Ge(0)]
Count = Annotated[int, Exact(), Ge(1)]
CountOrZero = Annotated[int, Exact(), Ge(0)]


def type_parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Origin and arguments of a type behind its aliases, as ``typing.get_origin`` and ``get_args`` give them.

    From numpy 2.5 on ``NDArray[np.float64]`` is such an alias, ``type NDArray[...] = ndarray[...]``; before, its
    origin was ``ndarray``.
    """
    origin, args = get_origin(hint), get_args(hint)
    value = getattr(hint if origin is None else origin, "__value__", None)
    if value is None:
        return origin, args
    return type_parts(value if origin is None else value[args])


# ---- Check of the values of a dataclass of options against the types of its fields.


def check_options(options: Any, owner: str = "") -> None:
    """Check each option against the type of its field.

    Parameters
    ----------
    options : dataclass
        Its types are made of numbers, texts, ``Literal``, ``None``, sequences, mappings with names, and ``Annotated``
        with bounds.
    owner : str
        What the options belong to, for the message.

    Raises
    ------
    UsageError
        For the first value that its type does not allow; names the option and what is allowed.
    """
    made = next(kind for kind in type(options).__mro__ if "__dataclass_fields__" in vars(kind))
    for name, kind in _types(made).items():
        value = getattr(options, name)
        if not _allows(kind, value):
            words = _words(kind)
            verb = "choose" if all(word.startswith("'") for word in words) else "give"
            raise UsageError(f"{owner}{': ' if owner else ''}{name} = {value!r}; {verb} {_either(words)}", name)


@cache
def _types(made: Any) -> dict[str, Any]:
    hints = get_type_hints(made, include_extras=True)
    return {field.name: hints[field.name] for field in fields(made)}


def _allows(kind: Any, value: Any) -> bool:
    """Return whether a type allows a value."""
    origin, args = type_parts(kind)
    if origin is Annotated:
        return _allows(args[0], value) and all(_holds(bound, value) for bound in args[1:])
    if origin in (Union, UnionType):
        return any(_allows(each, value) for each in args)
    if origin is Literal:
        return any(type(value) is type(each) and value == each for each in args)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(_allows(args[1], each) for each in value.values())
    if origin is tuple and args[-1] is not ...:
        is_row = isinstance(value, list | tuple | np.ndarray) and len(value) == len(args)
        return is_row and all(map(_allows, args, value))
    if origin is Callable:
        return callable(value)
    if origin is not None:  # a sequence
        return isinstance(value, list | tuple | np.ndarray) and all(_allows(args[0], each) for each in value)
    if kind is Any:
        return True
    if kind in (None, NoneType):
        return value is None
    if isinstance(value, bool | np.bool_) or kind is bool:
        return kind is bool and isinstance(value, bool)
    numbers = {float: Real, int: Integral}
    return isinstance(value, numbers.get(kind, kind))


def _holds(bound: Any, value: Any) -> bool:
    """Return whether a number keeps a bound; other marks of a type hold."""
    if isinstance(bound, Gt):
        return bool(bound.gt < value)
    if isinstance(bound, Ge):
        return bool(bound.ge <= value)
    if isinstance(bound, Lt):
        return bool(value < bound.lt)
    if isinstance(bound, Exact):
        return not bound.finite or math.isfinite(value)
    return bool(value <= bound.le) if isinstance(bound, Le) else True


def _words(kind: Any) -> list[str]:
    """Return what a type allows, in words: each of its alternatives."""
    origin, args = type_parts(kind)
    if origin is Annotated:
        stated = [mark.text for mark in args[1:] if isinstance(mark, Allowed)]
        bounds = [_bound(mark) for mark in args[1:] if isinstance(mark, Gt | Ge | Le | Lt)]
        return stated or [f"{_either(_words(args[0]))}{' ' if bounds else ''}{' and '.join(bounds)}"]
    if origin in (Union, UnionType):
        return [word for each in args for word in _words(each)]
    if origin is Literal:
        return [repr(each) for each in args]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return [f"a dict by name ({_either(_words(args[1]))})"]
    if origin is tuple and args[-1] is not ...:
        return [f"({', '.join(_either(_words(each)) for each in args)})"]
    if origin is Callable:
        return ["a function"]
    if origin is not None:
        return [f"a list ({_either(_words(args[0]))})"]
    named = {float: "a number", int: "a whole number", str: "a text", bool: "True or False", NoneType: "None"}
    return [named.get(kind) or str(kind.__name__)]


def _bound(mark: Gt | Ge | Le | Lt) -> str:
    if isinstance(mark, Gt | Lt):
        return f"above {mark.gt}" if isinstance(mark, Gt) else f"below {mark.lt}"
    return f"of at least {mark.ge}" if isinstance(mark, Ge) else f"of at most {mark.le}"


def _either(words: list[str]) -> str:
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def plain(value: Any) -> Any:
    """Return a value of plain types, as JSON has them: dicts, tuples in place of lists and arrays, Python's numbers."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(map(plain, value))
    return value.item() if isinstance(value, np.generic) else value


# ---- Functions that take a dataclass of options by keywords.

_First = TypeVar("_First")
_Second = TypeVar("_Second")
_Made = TypeVar("_Made")
_Result = TypeVar("_Result")
_Keywords = ParamSpec("_Keywords")


def takes_options(
    kind: Callable[_Keywords, _Made],
) -> Callable[
    [Callable[[_First, _Second, _Made], _Result]], Callable[Concatenate[_First, _Second, _Keywords], _Result]
]:
    """Return a decorator: the third argument, a dataclass of options, is given by the names of its fields.

    Signature and docstring of the function list the options, with the words of the dataclass.
    """

    def decorate(
        function: Callable[[_First, _Second, _Made], _Result],
    ) -> Callable[Concatenate[_First, _Second, _Keywords], _Result]:
        positional = list(inspect.signature(function).parameters.values())[:2]
        signature = inspect.Signature([*positional, *inspect.signature(kind).parameters.values()])

        @wraps(function)
        def called(*args: Any, **keywords: Any) -> _Result:
            given = signature.bind(*args, **keywords).arguments
            first, second = (given.pop(each.name) for each in positional)
            made: Any = kind
            return function(first, second, made(**given))

        called.__signature__ = signature  # type: ignore[attr-defined]
        called.__doc__ = _with_options(inspect.getdoc(function) or "", kind)
        return called

    return decorate


def _with_options(text: str, kind: Any) -> str:
    """Return a docstring whose line ``**options`` is replaced by the attributes of a dataclass and its bases."""
    begin, heading, rest = text.partition("\n**options\n")
    sections = [
        inspect.cleandoc(base.__doc__ or "").partition("Attributes\n----------\n")[2].partition("\n\nNotes\n")[0]
        for base in reversed(kind.__mro__)
    ]
    return "\n".join([begin, *filter(None, sections)]) + "\n" + rest.lstrip(" ") if heading else text
