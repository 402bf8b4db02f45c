"""Types of options and arguments with their bounds, and functions that take a dataclass of options by keywords."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from functools import cache, wraps
from typing import Annotated, Any, Concatenate, ParamSpec, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Le

from gbid.core.errors import nearest


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


class OneText:
    """Mark of a list of texts that may be given as one text."""


class Own:
    """Mark of a type whose values the constructor checks itself, with words about the data."""


Number = Annotated[float, Exact()]
Finite = Annotated[float, Exact(finite=True)]
Positive = Annotated[float, Exact(finite=True), Gt(0)]
NotNegative = Annotated[float, Exact(finite=True), Ge(0)]
Share = Annotated[float, Exact(), Gt(0), Le(1)]
Count = Annotated[int, Exact(), Ge(1)]
CountOrZero = Annotated[int, Exact(), Ge(0)]
Names = Annotated[tuple[str, ...], OneText()]


_First = TypeVar("_First")
_Second = TypeVar("_Second")
_Made = TypeVar("_Made")
_Result = TypeVar("_Result")
_Keywords = ParamSpec("_Keywords")
_Constructor = TypeVar("_Constructor", bound=Callable[..., None])


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


def check_options(options: Any, owner: str = "") -> None:
    """Check the fields of a dataclass of options against their types; a value that is the default is allowed.

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
    kind: Any = type(options)
    made, defaults = _defaults_of(kind)
    given = {name: value for name, default in defaults if (value := getattr(options, name)) is not default}
    if given:
        from gbid.core.option_check import check_fields  # with pydantic

        check_fields(made, given, owner)


@cache
def _defaults_of(kind: type) -> tuple[type, list[tuple[str, Any]]]:
    """Return the dataclass among a class and its bases, and the defaults of its fields."""
    made = next(each for each in kind.__mro__ if "__dataclass_fields__" in vars(each))
    return made, [(field.name, getattr(made, field.name, MISSING)) for field in fields(made) if field.init]


@cache
def types_of(made: Any) -> dict[str, Any]:
    """Return the types of the fields of a dataclass."""
    hints = get_type_hints(made, include_extras=True)
    return {field.name: hints[field.name] for field in fields(made)}


def plain(value: Any) -> Any:
    """Return a value of plain types, as JSON has them: dicts, tuples in place of lists and arrays, Python's numbers."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(map(plain, value))
    return value.item() if isinstance(value, np.generic) else value


def checks_arguments(constructor: _Constructor) -> _Constructor:
    """Return the ``__init__`` of a class that checks its arguments, see `gbid.core.option_check.check_call`."""

    @wraps(constructor)
    def checked(*args: Any, **keywords: Any) -> None:
        from gbid.core.option_check import check_call

        check_call(constructor, args, keywords)
        constructor(*args, **keywords)

    return cast(_Constructor, checked)


# ---- Functions that take a dataclass of options by keywords.


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
        called.options_kind = kind  # type: ignore[attr-defined]
        return called

    return decorate


def options_of_call(kind: type[_Made], owner: str, options: Mapping[str, Any]) -> _Made:
    """Return a dataclass of the further keywords of a call; TypeError for one that it does not have."""
    names = inspect.signature(kind).parameters
    for name in options:
        if name not in names:
            raise TypeError(f"{owner}() got an unexpected keyword argument {name!r}; {nearest(name, names)}")
    return kind(**options)


def _with_options(text: str, kind: Any) -> str:
    """Return a docstring whose line ``**options`` is replaced by the attributes of a dataclass and its bases."""
    begin, heading, rest = text.partition("\n**options\n")
    sections = [
        inspect.cleandoc(base.__doc__ or "").partition("Attributes\n----------\n")[2].partition("\n\nNotes\n")[0]
        for base in reversed(kind.__mro__)
    ]
    return "\n".join([begin, *filter(None, sections)]) + "\n" + rest.lstrip(" ") if heading else text
