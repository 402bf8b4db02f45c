"""Types of options and arguments: bounds, one check of values, and functions that take options by keywords."""

from __future__ import annotations

import ast
import builtins
import importlib
import inspect
import math
import os
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Set
from dataclasses import MISSING, InitVar, dataclass, fields, is_dataclass
from functools import cache, wraps
from numbers import Complex, Integral, Real
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
        if value is not getattr(made, name, MISSING) and not _allows(kind, value):  # defaults are allowed: most options
            raise _not_allowed(owner, name, value, kind)


def _not_allowed(owner: str, name: str, value: Any, kind: Any, also: str = "") -> UsageError:
    """Return the error for a value; of a list or a mapping it names the first entry that its type does not allow."""
    place = name
    while (entry := _first_wrong_entry(kind, value)) is not None:
        key, value, kind = entry
        place = f"{place}[{key!r}]"
    words = list(dict.fromkeys(_words(kind)))
    verb = "choose" if all(word.startswith("'") for word in words) else "give"
    return UsageError(f"{owner}{': ' if owner else ''}{place} = {_short(value)}; {verb} {_either(words)}{also}", name)


def _first_wrong_entry(kind: Any, value: Any) -> tuple[Any, Any, Any] | None:
    """Return key, value and type of the first entry that is not allowed; None where the whole is not."""
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


def _short(value: Any) -> str:
    """Return a value as a message shows it: on one line, and the type alone where its text would be long."""
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


@cache
def _types(made: Any) -> dict[str, Any]:
    hints = get_type_hints(made, include_extras=True)
    return {field.name: hints[field.name] for field in fields(made)}


_LARGEST = 1 << 63  # of whole numbers: what an array of numpy holds


def _allows(kind: Any, value: Any) -> bool:
    """Return whether a type allows a value."""
    origin, args = type_parts(kind)
    if isinstance(kind, InitVar):
        return _allows(kind.type, value)
    if isinstance(kind, TypeVar):
        return _allows(kind.__bound__ or Any, value)
    if origin is Annotated:
        if any(isinstance(mark, Own) or (isinstance(mark, OneText) and isinstance(value, str)) for mark in args[1:]):
            return True
        return _allows(args[0], value) and all(_holds(bound, value) for bound in args[1:])
    if origin in (Union, UnionType):
        kinds = _alternatives(kind)
        is_row = ArrayOfNumbers in kinds and isinstance(value, list | tuple) and len(value) > 0
        return any(_allows(each, value) for each in kinds) or (is_row and all(_allows(kind, each) for each in value))
    if origin is Literal:
        return any(type(value) is type(each) and value == each for each in args)
    if kind is ArrayOfNumbers or origin is np.ndarray:
        return _is_array(kind, value)
    if origin is type:
        return isinstance(value, type)
    if origin is Callable or kind is Callable:
        return callable(value)
    if isinstance(origin, type) and issubclass(origin, Collection | Iterable):
        return _allows_entries(origin, args, value)
    if kind is Any or isinstance(kind, ParamSpec | str):
        return True
    if kind in (None, NoneType):
        return value is None
    if isinstance(value, bool | np.bool_) or kind is bool:
        return kind in (bool, object) and isinstance(value, bool | np.bool_)
    numbers = {float: Real, int: Integral, complex: Complex, Path: os.PathLike}
    known = numbers.get(kind, kind)
    if type(value) is int and known in (Real, Integral, Complex):
        return abs(value) < _LARGEST
    if known in (Real, Integral, Complex) and isinstance(value, np.ndarray) and value.ndim == 0:
        return isinstance(value[()], known)
    return not isinstance(known, type) or (isinstance(value, known) and not isinstance(value, type))


def _allows_entries(origin: type, args: tuple[Any, ...], value: Any) -> bool:
    """Return whether a mapping, a tuple of fixed length or another collection allows a value and its entries."""
    if issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            _allows(args[0], key) and _allows(args[1], each) for key, each in value.items()
        )
    if origin is tuple and args[-1:] != (...,):
        is_row = isinstance(value, list | tuple | np.ndarray) and np.ndim(value) > 0 and len(value) == len(args)
        return is_row and all(map(_allows, args, value))
    if isinstance(value, str | bytes | bytearray | Mapping) or not isinstance(value, Iterable):
        return False
    if isinstance(value, np.ndarray) and (value.ndim == 0 or value.dtype.kind in "biuf"):
        return value.ndim > 0 and (not len(value) or _allows(args[0], value[0]))
    if not isinstance(value, Collection):  # an iterator, which must not be used up
        return not issubclass(origin, Collection)
    return not (isinstance(value, Set) and issubclass(origin, list | tuple)) and all(_allows(args[0], x) for x in value)


class ArrayOfNumbers:
    """Mark in place of ``numpy.typing.ArrayLike``, a union of types that allows texts."""


@cache
def _alternatives(kind: Any) -> tuple[Any, ...]:
    """Return the alternatives of a union, with `ArrayOfNumbers` for those of ``numpy.typing.ArrayLike``."""
    args, array = get_args(kind), get_args(npt.ArrayLike)
    if not set(array) <= set(args):
        return args
    return (ArrayOfNumbers, *(each for each in args if each not in array))


def _is_array(kind: Any, value: Any) -> bool:
    """Return whether numpy makes an array of a value whose numbers are of the kind of a type of arrays."""
    if value is None or isinstance(value, str | bytes | Mapping | Set | type):
        return False
    wanted = np.dtype(next(iter(get_args(type_parts(kind)[1][1])), object)).kind if kind is not ArrayOfNumbers else "c"
    if wanted == "O":
        return isinstance(value, np.ndarray | list | tuple)
    try:
        found = np.asarray(value).dtype.kind
    except (ValueError, TypeError, RuntimeError, NotImplementedError):  # rows of different lengths; CasADi's symbols
        return False
    allowed = {"f": "biuf", "i": "biu", "u": "biu", "b": "b", "c": "biufcO", "U": "UO", "M": "M"}
    if found == "O" and not isinstance(value, np.ndarray):
        return False
    return found in allowed.get(wanted, wanted)


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
    if isinstance(kind, InitVar):
        return _words(kind.type)
    if kind is ArrayOfNumbers or origin is np.ndarray:
        is_real = kind is not ArrayOfNumbers and np.dtype(next(iter(get_args(args[1])), object)).kind == "f"
        return ["an array of real numbers" if is_real else "an array"]
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


# ---- The door: arguments of public functions against their annotations.


def check_call(
    function: Any, owner: str, given: tuple[Any, ...], keywords: Mapping[str, Any], of: type | None = None
) -> None:
    """Check each argument of a call against the annotation of the function, and that no number is nan.

    Parameters
    ----------
    function : function
        A constructor may get nan: a value states with it what is not known.
    owner : str
        Name of the function for the message.
    given, keywords
        Arguments of the call.
    of : type, optional
        Class of a method or constructor, whose first argument is the object.

    Raises
    ------
    UsageError
        For the first argument that its annotation does not allow; names it, its value, and what is allowed.
    TypeError
        When an argument is missing, or when there is none of its name.
    """
    signature, kinds = _annotated(function, of)
    try:
        arguments = signature.bind(*given, **keywords).arguments
    except TypeError as error:
        unknown = next((name for name in keywords if name not in signature.parameters), None)
        hint = f"; {nearest(unknown, signature.parameters)}" if unknown else ""
        raise TypeError(f"{owner}() {error}{hint}") from None
    for name, kind in kinds.items():
        if name not in arguments:
            continue
        parameter, value = signature.parameters[name], arguments[name]
        is_named, is_listed = parameter.kind is parameter.VAR_KEYWORD, parameter.kind is parameter.VAR_POSITIONAL
        for each in list(value.values()) if is_named else value if is_listed else [value]:
            is_one_number = not of and isinstance(each, Complex) and _is_for_arrays(kind)
            if is_one_number or not _allows(kind, each):
                raise _not_allowed(owner, name, each, kind, "" if of else _other_way_round(owner, name, each, kinds))
            if of is None and _has_nan(each):
                raise UsageError(f"{owner}: {name} = {_short(each)}; give a finite number", name)


def _is_for_arrays(kind: Any) -> bool:
    """Return whether a type is that of arrays, or of arrays and None."""
    parts = (
        [part for part in get_args(kind) if part is not NoneType] if get_origin(kind) in (Union, UnionType) else [kind]
    )
    return all(type_parts(part)[0] is np.ndarray for part in parts)


def _other_way_round(owner: str, name: str, value: Any, kinds: Mapping[str, Any]) -> str:
    """Return words for a first argument that belongs into the second place."""
    first, second = [*kinds, "", ""][:2]
    swapped = name == first and second and kinds[second] is not Any and _allows(kinds[second], value)
    return f"; the order is the other way round: {owner}({first}, {second})" if swapped and value is not None else ""


@cache
def _annotated(function: Any, of: type | None) -> tuple[inspect.Signature, dict[str, Any]]:
    """Return the signature of a function and the types of its arguments, of options as well."""
    signature, plain_function = inspect.signature(function), inspect.unwrap(function)
    is_made = is_dataclass(of) and plain_function.__code__.co_filename == "<string>"  # a constructor without a file
    names = _Names(plain_function)
    hints = get_type_hints(of if is_made else plain_function, localns=names, include_extras=True)
    if hasattr(function, "options_kind"):
        hints |= _types(function.options_kind)
    skipped = {"return", *(list(signature.parameters)[:1] if of else ())}
    return signature, {name: hints[name] for name in signature.parameters if name in hints and name not in skipped}


class _Names(dict[str, Any]):
    """Names of annotations that a module imports for type checkers only: imported when one is asked for."""

    def __init__(self, function: Any) -> None:
        super().__init__()
        self._function = function

    def __missing__(self, name: str) -> Any:
        if name in getattr(self._function, "__globals__", ()) or hasattr(builtins, name):
            raise KeyError(name)  # python goes on there
        module = sys.modules[self._function.__globals__["__name__"]]
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.ImportFrom) and any((each.asname or each.name) == name for each in node.names):
                return getattr(importlib.import_module(str(node.module)), name)
        raise KeyError(name)


def _has_nan(value: Any) -> bool:
    """Return whether a number is nan, also within lists and mappings; arrays of data may contain it."""
    if isinstance(value, list | tuple | Mapping) and len(value) <= 1000:
        return any(map(_has_nan, value.values() if isinstance(value, Mapping) else value))
    return isinstance(value, float | np.floating) and math.isnan(value)


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
