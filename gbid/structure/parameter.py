"""Parameters of a structure (name, start value, bounds, unit), and caches of functions of a structure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import dataclass, fields
from functools import lru_cache, wraps
from math import inf, isfinite, isnan
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.core.option_types import check_options


@dataclass(frozen=True)
class Parameter:
    """Parameter of a structure, free or fixed.

    Parameters
    ----------
    name : str
        A Python identifier.
    start : float or None
        Start value of the fit, or value of a fixed parameter. With None the start value is estimated from the data.
    lower, upper : float
        Bounds of the estimate.
    fixed : bool
        Whether the parameter keeps its start value.
    unit : str
        Unit, for tables and files.

    Raises
    ------
    UsageError
        When the name is not an identifier, when the bounds exclude the start value or each other, or when a fixed
        parameter has no value.
    """

    name: str
    start: float | None = None
    lower: float = -inf
    upper: float = inf
    fixed: bool = False
    unit: str = ""

    def __post_init__(self) -> None:
        check_options(self, "Parameter")
        where = f"parameter {self.name!r}"
        if not self.name.isidentifier():
            raise UsageError(f"{where}: the name must be a Python identifier")
        if isnan(self.lower) or isnan(self.upper) or not self.lower < self.upper:
            raise UsageError(f"{where}: lower = {self.lower} must be below upper = {self.upper}")
        if self.start is None:
            if self.fixed:
                raise UsageError(f"{where}: fixed without a value; give start")
        elif not isfinite(self.start):
            raise UsageError(f"{where}: start = {self.start} is not finite")
        elif not self.lower <= self.start <= self.upper:
            raise UsageError(
                f"{where}: start = {self.start:g} lies outside its bounds [{self.lower:g}, {self.upper:g}]"
            )

    def renamed(self, name: str) -> Parameter:
        """Return a copy under another name, such as ``k_xx[run 1]`` for the value of one recording.

        Parameters
        ----------
        name : str
            Any text; only parameters of structures need identifiers.
        """
        renamed = copy(self)
        object.__setattr__(renamed, "name", name)
        return renamed


class Values(dict[str, Any]):
    """Parameter values by name, as keys or attributes: ``p["tau"]`` or ``p.tau``."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"no parameter {name!r}; choose from {', '.join(self)}") from None

    @classmethod
    def of(cls, parameters: tuple[Parameter, ...], values: Any) -> Values:
        """Return parameter values by name, from a vector of numbers or symbols."""
        return cls({parameter.name: values[i] for i, parameter in enumerate(parameters)})


def set_fields(instance: Any, values: Mapping[str, Any]) -> None:
    """Set fields of a frozen dataclass in its `__init__`, for example to convert lists to tuples.

    Raises
    ------
    UsageError
        When it has parameters of which two have the same name.
    """
    for each in fields(instance):
        object.__setattr__(instance, each.name, values[each.name])
    names = [parameter.name for parameter in instance.parameters]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"structure {instance.name!r}: parameter {min(twice)!r} is listed more than once")


def as_vector(structure: Any, values: Mapping[str, float]) -> FloatArray:
    """Return the values of all parameters as a vector in the order of the structure, (n_parameters,).

    Raises
    ------
    UsageError
        When a value is missing.
    """
    if missing := [q.name for q in structure.parameters if q.name not in values]:
        raise UsageError(f"structure {structure.name!r}: no value for {', '.join(missing)}; give them in values")
    return np.array([float(values[q.name]) for q in structure.parameters])


def known_names(parameters: tuple[Parameter, ...], given: Iterable[str], what: str) -> None:
    """Refuse names that are not parameters of a structure.

    Raises
    ------
    UsageError
        When a name is unknown; the text lists the unknown and the known names.
    """
    names = [parameter.name for parameter in parameters]
    unknown = [name for name in given if name not in names]
    if unknown:
        raise UsageError(f"{what} names unknown parameters: {', '.join(unknown)}; choose from {', '.join(names)}")


# ---- Caches of functions of a structure.

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_MOST = 32  # results of a function that are kept
_known: ContextVar[dict[tuple[Any, ...], tuple[Any, Any]] | None] = ContextVar("known", default=None)


@contextmanager
def asked_once() -> Iterator[None]:
    """Return a context that caches symbolic matrices and equations during one fit.

    It is that of one fit with what is stored of it, the outermost context. Functions of a user may return something
    else in the next one.
    """
    known = _known.get()
    before = _known.set({} if known is None else known)
    try:
        yield
    finally:
        _known.reset(before)


def once(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a function of a structure whose results are cached within `asked_once`.

    A class with ``is_value = True`` says that equal structures have equal matrices: then the results last for all fits.
    """
    lasting = cast(Callable[_Arguments, _Result], lru_cache(_MOST)(function))

    @wraps(function)
    def cached(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        structure: Any = arguments[0]
        if getattr(structure, "is_value", False) and _is_hashable(structure):
            return lasting(*arguments, **options)
        known = _known.get()
        if known is None:
            return function(*arguments, **options)
        key = function.__qualname__, id(structure), *arguments[1:], *options.items()
        if key not in known:
            known[key] = structure, function(*arguments, **options)  # with the structure, so that its id stays its own
        result: _Result = known[key][1]
        return result

    return cached


def _is_hashable(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:  # names of signals in a list
        return False
    return True
