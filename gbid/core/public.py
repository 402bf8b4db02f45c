"""Public names: each is imported when it is first used, and calls from outside are checked against its types."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache, wraps
from types import FunctionType
from typing import Any

import lazy_loader  # type: ignore[import-untyped]

Around = Callable[[Any, tuple[Any, ...], dict[str, Any]], AbstractContextManager[object]]
"""From a function and the arguments of a call to the context of the call."""


def attach(
    package: str, file: str, around: Around | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package whose stub lists its public names.

    Functions and constructors check their arguments, see `gbid.core.option_types.check_call`. Calls from
    gbid itself are not checked: mypy did. Functions run with one thread of BLAS: their matrices are small, and threads
    that wait for each other take several times the processor time.

    Parameters
    ----------
    package, file : str
        ``__name__`` and ``__file__`` of the package.
    around : callable, optional
        Context of a call of a function from outside.
    """
    imported, names, listed = lazy_loader.attach_stub(package, file)

    def get(name: str) -> Any:
        value = imported(name)
        if isinstance(value, FunctionType) and value.__globals__ is not globals():  # else it is a checked one already
            value = _checked_function(value, around)
            # pickles name it by the shortest package that hands it out
            value.__module__ = min(value.__module__, package, key=len)
        elif isinstance(value, type):
            _check_calls_of(value)
        vars(sys.modules[package])[name] = value
        return value

    return get, names, listed


_REPLACING = ("dataclasses", "copy")
"""Modules through which a constructor is called by `dataclasses.replace`: what counts is who calls that."""


@cache
def _checked_function(function: Any, around: Around | None) -> Any:
    """Return a function that checks its arguments: one for all packages that make the same function public."""
    return _checked(function, function.__name__, around=around)


@cache
def _check_calls_of(kind: type) -> None:
    """Let the constructor of a class check its arguments."""
    constructor = vars(kind).get("__init__")
    if isinstance(constructor, FunctionType) and kind.__module__.startswith("gbid."):
        setattr(kind, "__init__", _checked(constructor, kind.__name__, kind))  # noqa: B010


def _checked(function: Any, owner: str, of: type | None = None, around: Around | None = None) -> Any:
    @wraps(function)
    def checked(*args: Any, **keywords: Any) -> Any:
        frame = sys._getframe(1)
        caller = frame.f_globals.get("__name__") or ""
        while caller in _REPLACING and frame.f_back:
            frame = frame.f_back
            caller = frame.f_globals.get("__name__") or ""
        if not caller.startswith("gbid."):
            from gbid.core.arrays import one_blas_thread
            from gbid.core.brief import progress_line
            from gbid.core.option_types import check_call

            is_shown = of is None and keywords.get("progress") is True
            with progress_line() if is_shown else nullcontext() as line:
                keywords = {**keywords, "progress": line} if is_shown else keywords
                check_call(function, owner, args, keywords, of)
                if of is None:
                    with one_blas_thread(), nullcontext() if around is None else around(function, args, keywords):
                        return function(*args, **keywords)
        return function(*args, **keywords)

    return checked
