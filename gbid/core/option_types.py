"""Types of options and arguments with bounds, checks of values, and functions that take options as keywords."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import MISSING, InitVar, dataclass, fields
from functools import cache, cached_property, partial, reduce, wraps
from operator import or_
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Concatenate,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Gt, Le, Lt

from gbid.core.errors import UsageError, nearest


@dataclass(frozen=True)
class Exact:
    """Mark of a type whose values are not converted: ``"3"``, ``3.0`` and ``True`` are no whole numbers.

    Attributes
    ----------
    finite : bool
        Whether a number must be finite.
    """

    finite: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Return the strict schema of pydantic for the type."""
        schema = {**handler(source), "strict": True}
        return {**schema, "allow_inf_nan": False} if self.finite and schema["type"] == "float" else schema


@dataclass(frozen=True)
class Allowed:
    """Mark of a type with a description of the allowed values, for error messages.

    Attributes
    ----------
    text : str
        The words, as they stand after "give" and "expected".
    """

    text: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Return the schema of pydantic for the type; any error has the text of the mark."""

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
    """Mark of a type whose values the constructor checks, with messages about the data."""


Number = Annotated[float, Exact()]
Finite = Annotated[float, Exact(finite=True)]
Positive = Annotated[float, Exact(finite=True), Gt(0)]
NotNegative = Annotated[float, Exact(finite=True), Ge(0)]
Share = Annotated[float, Exact(), Gt(0), Le(1)]
Count = Annotated[int, Exact(), Ge(1)]
CountOrZero = Annotated[int, Exact(), Ge(0)]
LimitedCount = Annotated[int, Exact(), Ge(1), Le(1000)]
LimitedCountOrZero = Annotated[int, Exact(), Ge(0), Le(1000)]
Order = Annotated[int, Exact(), Ge(1), Le(20)]
Duration = Annotated[float, Exact(finite=True), Gt(0), Le(36_000)]
Names = Annotated[tuple[str, ...], OneText()]


_MOST_ENTRIES = 10_000_000  # of a list or a range
_DEEPEST = 50  # lists and mappings one within another
_First = TypeVar("_First")
_Second = TypeVar("_Second")
_Made = TypeVar("_Made")
_Result = TypeVar("_Result")
_Keywords = ParamSpec("_Keywords")
_Constructor = TypeVar("_Constructor", bound=Callable[..., Any])


def type_parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return origin and arguments of a type, with aliases resolved; see ``typing.get_origin`` and ``get_args``.

    From numpy 2.5 on ``NDArray[np.float64]`` is such an alias, ``type NDArray[...] = ndarray[...]``; before, its
    origin was ``ndarray``.
    """
    origin, args = get_origin(hint), get_args(hint)
    value = getattr(hint if origin is None else origin, "__value__", None)
    if value is None:
        return origin, args
    return type_parts(value if origin is None else value[args])


def check_options(options: Any, owner: str = "") -> None:
    """Check the fields of a dataclass of options against their types; default values need no check.

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
    declared, defaults = _defaults_of(kind)
    given = {name: value for name, default in defaults if (value := getattr(options, name)) is not default}
    if given:
        check_fields(declared, given, owner)


@cache
def _defaults_of(kind: type) -> tuple[type, list[tuple[str, Any]]]:
    """Return the dataclass among a class and its bases, with the default of each field."""
    declared = next(each for each in kind.__mro__ if "__dataclass_fields__" in vars(each))
    return declared, [(field.name, getattr(declared, field.name, MISSING)) for field in fields(declared) if field.init]


@cache
def types_of(kind: Any) -> dict[str, Any]:
    """Return the types of the fields of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def _refuse_depth(depth: int) -> None:
    if depth > _DEEPEST:
        raise UsageError(f"values are nested more than {_DEEPEST} deep, or in themselves; give them flat")


def plain(value: Any, depth: int = 0) -> Any:
    """Return a value as JSON has it: dicts, tuples (for lists and arrays), numbers of Python."""
    _refuse_depth(depth)
    if isinstance(value, Mapping):
        return {key: plain(each, depth + 1) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(plain(each, depth + 1) for each in value)
    return value.item() if isinstance(value, np.generic) else value


def checks_arguments(constructor: _Constructor) -> _Constructor:
    """Return the ``__init__`` or a class method with a check of its arguments; see `check_call`."""

    @wraps(constructor)
    def checked(*args: Any, **keywords: Any) -> Any:
        check_call(constructor, args, keywords)
        return constructor(*args, **keywords)

    return cast(_Constructor, checked)


@dataclass(frozen=True, eq=False)
class CheckedType:
    """Type of an option or argument; its pydantic check is built at the first use."""

    hint: Any

    @cached_property
    def _validate(self) -> Callable[[Any], Any]:
        from pydantic import (
            TypeAdapter,  # here and below: the import takes longer than that of all that is small in gbid
        )

        return TypeAdapter(_pydantic_type(self.hint), config={"strict": True}).validator.validate_python

    def allows(self, value: Any) -> bool:
        """Return whether the type allows a value."""
        try:
            self._validate(value)
        except ValueError:  # of pydantic
            return False
        return True


def check_fields(kind: type, values: Mapping[str, Any], owner: str) -> None:
    """Check values for fields of a dataclass; see `check_options`."""
    kinds = _kinds_of(kind)
    for name, value in values.items():
        if not kinds[name].allows(value):
            raise _not_allowed(owner, name, value, kinds[name].hint)


@cache
def _kinds_of(kind: type) -> dict[str, CheckedType]:
    return {name: CheckedType(hint) for name, hint in types_of(kind).items()}


def check_call(function: Any, given: tuple[Any, ...], keywords: Mapping[str, Any]) -> None:
    """Check each argument of a call against its annotation, and refuse nan.

    Raises
    ------
    UsageError
        For the first argument that its annotation does not allow; names it, its value, and what is allowed.
    TypeError
        When an argument is missing, or when there is none of its name.
    """
    owner, (signature, kinds) = function.__qualname__.removesuffix(".__init__"), _annotated(function)
    try:
        arguments = signature.bind(*given, **keywords).arguments
    except TypeError as error:
        unknown = next((name for name in keywords if name not in signature.parameters), None)
        hint = f"; {nearest(unknown, signature.parameters)}" if unknown else ""
        raise TypeError(f"{owner}() {error}{hint}") from None
    for name, value in arguments.items():
        parameter, kind = signature.parameters[name], kinds.get(name)
        if kind is None:
            continue
        is_named, is_listed = parameter.kind is parameter.VAR_KEYWORD, parameter.kind is parameter.VAR_POSITIONAL
        for each in value.values() if is_named else value if is_listed else [value]:
            if not kind.allows(each):
                raise _not_allowed(owner, name, each, kind.hint, _other_way_round(owner, name, each, kinds))
            if _has_nan(each):
                raise UsageError(f"{owner}: {name} = {short_text(each)}; give a finite number", name)


def _other_way_round(owner: str, name: str, value: Any, kinds: Mapping[str, CheckedType]) -> str:
    """Return a hint that two arguments are swapped, when the first value fits the second argument."""
    first, second = [*kinds, "", ""][:2]
    swapped = name == first and second and kinds[second].hint is not Any and kinds[second].allows(value)
    return f"; the order is the other way round: {owner}({first}, {second})" if swapped and value is not None else ""


@cache
def _annotated(function: Any) -> tuple[inspect.Signature, dict[str, CheckedType]]:
    """Return the signature of a function and the types of its arguments, including options."""
    signature, hints = inspect.signature(function), get_type_hints(inspect.unwrap(function), include_extras=True)
    if hasattr(function, "options_kind"):
        hints |= types_of(function.options_kind)
    return signature, {name: CheckedType(hints[name]) for name in signature.parameters if name in hints}


def _has_nan(value: Any, depth: int = 0) -> bool:
    """Return whether a number is nan, also within lists and mappings; arrays of data may contain nan."""
    if isinstance(value, list | tuple | Mapping) and len(value) <= 1000:
        _refuse_depth(depth)
        return any(_has_nan(each, depth + 1) for each in (value.values() if isinstance(value, Mapping) else value))
    return isinstance(value, float | np.floating) and math.isnan(value)


def _not_allowed(owner: str, name: str, value: Any, kind: Any, also: str = "") -> UsageError:
    """Return the error for a value; for a list or mapping, the error names the first wrong entry."""
    place = name
    while (entry := _first_wrong_entry(kind, value)) is not None:
        key, value, kind = entry
        place = f"{place}[{key!r}]"
    alternatives = list(dict.fromkeys(_words(kind)))
    verb = "choose" if all(word.startswith("'") for word in alternatives) else "give"
    return UsageError(
        f"{owner}{': ' if owner else ''}{place} = {short_text(value)}; {verb} {_either(alternatives)}{also}", name
    )


def _first_wrong_entry(kind: Any, value: Any) -> tuple[Any, Any, Any] | None:
    """Return key, value and type of the first entry that is not allowed; None if all entries are allowed."""
    while get_origin(kind) is Annotated and not any(isinstance(mark, Allowed) for mark in get_args(kind)):
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, UnionType):
        kinds = [each for each in get_args(kind) if each is not NoneType]
        return _first_wrong_entry(kinds[0], value) if len(kinds) == 1 else None
    origin, args = get_origin(kind), get_args(kind)
    if not isinstance(origin, type) or not issubclass(origin, Collection):
        return None
    if not isinstance(value, Mapping | list | tuple) or issubclass(origin, Mapping) != isinstance(value, Mapping):
        return None
    entries: Iterable[tuple[Any, Any, Any]]
    if isinstance(value, Mapping):
        if not all(_allows(args[0], key) for key in value):
            return None
        entries = ((key, each, args[1]) for key, each in value.items())
    elif origin is tuple and args[-1:] != (...,):
        if len(value) != len(args):
            return None
        entries = zip(range(len(value)), value, args, strict=True)
    else:
        entries = ((number, each, args[0]) for number, each in enumerate(value))
    return next((entry for entry in entries if not _allows(entry[2], entry[1])), None)


def short_text(value: Any) -> str:
    """Return a value as text for a message: on one line; of a long value only the type."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    try:
        text = repr(value)
    except Exception:  # of a class of the user
        text = "\n"
    kind, name = type(value).__name__, getattr(value, "name", "")
    if type(value).__module__.startswith("gbid.") and isinstance(name, str) and name:
        return f"the {kind} {name!r}"
    return text if len(text) <= 120 and "\n" not in text and " object at 0x" not in text else f"a value of type {kind}"


def _allows(hint: Any, value: Any) -> bool:
    return CheckedType(hint).allows(value)


def _pydantic_type(kind: Any) -> Any:
    """Return the type that pydantic checks in place of an annotated type.

    A number may be one of numpy, a list or tuple any collection, a path a text, and an array whatever numpy makes one
    of. Values of other classes are told by ``isinstance``.
    """
    from pydantic import AllowInfNan, BeforeValidator, InstanceOf

    origin, args = type_parts(kind)
    annotated: Any  # types made here are no types for mypy
    if isinstance(kind, InitVar | TypeVar):
        return _pydantic_type(kind.type if isinstance(kind, InitVar) else kind.__bound__ or Any)
    if origin is Annotated:
        if any(isinstance(mark, Own) for mark in args):
            return Any
        bounds: list[Any] = [mark for mark in args[1:] if isinstance(mark, Gt | Ge | Lt | Le)]
        if any(isinstance(mark, Exact) and mark.finite for mark in args):
            bounds.append(AllowInfNan(False))
        if args[0] in (float, int):
            return Annotated[(args[0], *bounds, BeforeValidator(_number))]
        annotated = _pydantic_type(args[0])
        annotated = Annotated[(annotated, *bounds)] if bounds else annotated
        return annotated | str if any(isinstance(mark, OneText) for mark in args) else annotated
    if origin in (Union, UnionType):
        annotated = reduce(or_, map(_pydantic_type, _alternatives(kind)))
        if ArrayOfNumbers in _alternatives(kind):  # rows of alternatives, such as lists of axes
            annotated |= _only(
                lambda value: isinstance(value, list | tuple) and all(_allows(kind, each) for each in value)
            )
        return annotated
    if origin is Literal:
        return _only(lambda value: any(type(value) is type(each) and value == each for each in args))
    if kind is ArrayOfNumbers or origin is np.ndarray:
        return _only(partial(_is_array, _array_kind(kind), kind is ArrayOfNumbers))
    if origin is Callable or kind is Callable:
        return _only(callable)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        annotated = dict
        annotated = annotated[_pydantic_type(args[0]), _pydantic_type(args[1])]
        return Annotated[annotated, BeforeValidator(lambda value: dict(value) if isinstance(value, Mapping) else value)]
    if isinstance(origin, type) and issubclass(origin, Iterable):
        each = [entry if entry is ... else _pydantic_type(entry) for entry in args]
        annotated = tuple
        annotated = annotated[(*each,)] if origin is tuple else annotated[each[0], ...]
        annotated = Annotated[annotated, BeforeValidator(partial(_entries, issubclass(origin, Sequence)))]
        return (
            annotated if issubclass(origin, Collection) else annotated | InstanceOf[Iterator[Any]]
        )  # not to be used up
    if kind in (float, int, complex):
        return Annotated[kind, BeforeValidator(_number)]
    if kind in (bool, str, None, NoneType, Any, object) or isinstance(kind, ParamSpec | str):
        return Any if isinstance(kind, ParamSpec | str) else kind
    annotated = os.PathLike if kind is Path else origin or kind
    return _only(lambda value: isinstance(value, annotated) and (annotated is type or not isinstance(value, type)))


def _only(test: Callable[[Any], bool]) -> Any:
    """Return a type for pydantic whose values must pass a test."""
    from pydantic import PlainValidator

    def tested(value: Any) -> Any:
        if not test(value):
            raise ValueError
        return value

    return Annotated[Any, PlainValidator(tested)]


def _number(value: Any) -> Any:
    """Return a numpy number as a Python number; ValueError for an integer beyond 64 bits."""
    if type(value) is int and abs(value) >= 1 << 63:
        raise ValueError
    return value.item() if isinstance(value, np.generic | np.ndarray) and value.ndim == 0 else value


def _entries(ordered: bool, value: Any) -> Any:
    """Return the entries of a collection; texts, mappings and (where order counts) sets are no collections."""
    is_single = (isinstance(value, np.ndarray) and value.ndim == 0) or not isinstance(value, Collection)
    if is_single or isinstance(value, str | bytes | bytearray | Mapping) or (ordered and isinstance(value, Set)):
        raise ValueError
    if len(value) > _MOST_ENTRIES:
        raise ValueError
    return tuple(value)


class ArrayOfNumbers:
    """Mark that replaces ``numpy.typing.ArrayLike``, whose union of types includes texts."""


@cache
def _alternatives(kind: Any) -> tuple[Any, ...]:
    """Return the alternatives of a union; `ArrayOfNumbers` replaces the parts of ``numpy.typing.ArrayLike``."""
    args, array = get_args(kind), get_args(npt.ArrayLike)
    if not set(array) <= set(args):
        return args
    return (ArrayOfNumbers, *(each for each in args if each not in array))


def _array_kind(hint: Any) -> str:
    """Return the ``numpy.dtype.kind`` of a type of arrays; "c" (complex) for values that become an array."""
    if hint is ArrayOfNumbers:
        return "c"
    return np.dtype(next(iter(get_args(type_parts(hint)[1][1])), object)).kind


def _is_array(wanted: str, single: bool, value: Any) -> bool:
    """Return whether numpy converts a value to an array of numbers of the wanted kind."""
    if value is None or isinstance(value, str | bytes | Mapping | Set | type):
        return False
    if wanted == "O":
        return isinstance(value, np.ndarray | list | tuple)
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError, NotImplementedError):  # rows of different lengths; CasADi's symbols
        return False
    if (array.ndim == 0 and not single) or (array.dtype.kind == "O" and not isinstance(value, np.ndarray)):
        return False
    allowed = {"f": "biuf", "i": "biu", "u": "biu", "b": "b", "c": "biufcO", "U": "UO", "M": "M"}
    return array.dtype.kind in allowed.get(wanted, wanted)


def _words(kind: Any) -> list[str]:
    """Return a description of the values that a type allows, with all alternatives."""
    origin, args = type_parts(kind)
    if isinstance(kind, InitVar):
        return _words(kind.type)
    if kind is ArrayOfNumbers or origin is np.ndarray:
        return ["an array of real numbers" if _array_kind(kind) == "f" else "an array"]
    if origin is Annotated:
        stated = [mark.text for mark in args[1:] if isinstance(mark, Allowed)]
        bounds = [_bound(mark) for mark in args[1:] if isinstance(mark, Gt | Ge | Le | Lt)]
        return stated or [f"{_either(_words(args[0]))}{' ' if bounds else ''}{' and '.join(bounds)}"]
    if origin in (Union, UnionType):
        return [word for each in _alternatives(kind) for word in _words(each)]
    if origin is Literal:
        return [repr(each) for each in args]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return [f"a dict by name ({_either(_words(args[1]))})"]
    if origin is tuple and args[-1:] != (...,):
        return [f"({', '.join(_either(_words(each)) for each in args)})"]
    if origin is Callable or kind is Callable:
        return ["a function"]
    if origin is type:
        return ["a class"]
    if origin is not None:
        return [f"a list ({_either(_words(args[0]))})"]
    named = {float: "a number", int: "a whole number", str: "a text", bool: "True or False", NoneType: "None"}
    return [named.get(kind) or str(getattr(kind, "__name__", kind))]


def _bound(mark: Gt | Ge | Le | Lt) -> str:
    if isinstance(mark, Gt | Lt):
        return f"above {mark.gt}" if isinstance(mark, Gt) else f"below {mark.lt}"
    return f"of at least {mark.ge}" if isinstance(mark, Ge) else f"of at most {mark.le}"


def _either(alternatives: list[str]) -> str:
    *others, last = alternatives
    return f"{', '.join(others)} or {last}" if others else last


# ---- Functions that take a dataclass of options as keywords.


def takes_options(
    kind: Callable[_Keywords, _Made],
) -> Callable[
    [Callable[[_First, _Second, _Made], _Result]], Callable[Concatenate[_First, _Second, _Keywords], _Result]
]:
    """Return a decorator for a function with options: keywords become its third argument, a dataclass.

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
    """Return a dataclass of options from the keywords of a call; TypeError for an unknown keyword."""
    names = inspect.signature(kind).parameters
    for name in options:
        if name not in names:
            raise TypeError(f"{owner}() got an unexpected keyword argument {name!r}; {nearest(name, names)}")
    return kind(**options)


def _with_options(text: str, kind: Any) -> str:
    """Return a docstring with the attributes of a dataclass and its bases in place of ``**options``."""
    begin, heading, rest = text.partition("\n**options\n")
    sections = [
        inspect.cleandoc(base.__doc__ or "").partition("Attributes\n----------\n")[2].partition("\n\nNotes\n")[0]
        for base in reversed(kind.__mro__)
    ]
    return "\n".join([begin, *filter(None, sections)]) + "\n" + rest.lstrip(" ") if heading else text
