"""Public names: imported at their first use; public functions check the arguments of outside calls."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from contextvars import ContextVar
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

    A package hands out functions `checked`; gbid itself takes them from their modules as they are.

    Parameters
    ----------
    package, file : str
        ``__name__`` and ``__file__`` of the package.
    around : callable, optional
        Context of a call of a function.
    """
    imported, names, listed = lazy_loader.attach_stub(package, file)

    def get(name: str) -> Any:
        value = imported(name)
        if isinstance(value, FunctionType):
            value = value if value.__globals__ is globals() else checked(value, around)
            # pickles name it by the shortest package that hands it out
            value.__module__ = min(value.__module__, package, key=len)
        vars(sys.modules[package])[name] = value
        return value

    return get, names, listed


@cache
def checked(function: Any, around: Around | None = None) -> Any:
    """Return a public function that checks its arguments; see `gbid.core.option_types.check_call`.

    It runs with one thread of BLAS: matrices are small, and threads that wait for each other take several times the
    processor time. ``progress=True`` shows steps on one line. Calls within a call of a public function are not checked.
    """

    @wraps(function)
    def called(*args: Any, **keywords: Any) -> Any:
        if _INSIDE.get():
            return function(*args, **keywords)
        from gbid.core.arrays import one_blas_thread
        from gbid.core.brief import progress_line
        from gbid.core.option_types import check_call

        is_shown = keywords.get("progress") is True
        with progress_line() if is_shown else nullcontext() as line:
            keywords = {**keywords, "progress": line} if is_shown else keywords
            check_call(function, args, keywords)
            inside = _INSIDE.set(True)
            try:
                with one_blas_thread(), nullcontext() if around is None else around(function, args, keywords):
                    return function(*args, **keywords)
            finally:
                _INSIDE.reset(inside)

    return called


_INSIDE = ContextVar("_INSIDE", default=False)
"""Whether a public function is running."""
