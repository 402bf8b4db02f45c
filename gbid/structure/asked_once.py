"""Functions of a structure that are called once for all parts of a fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar

_Asked = TypeVar("_Asked")
_Found = TypeVar("_Found")
_known: ContextVar[dict[tuple[str, int], tuple[Any, Any]] | None] = ContextVar("known", default=None)


@contextmanager
def asked_once() -> Iterator[None]:
    """Return a context in which what was asked of a structure is kept: start, predictor and model ask for the same.

    It is that of one fit. Functions of a user may return something else in the next one.
    """
    before = _known.set({})
    try:
        yield
    finally:
        _known.reset(before)


def once(function: Callable[[_Asked], _Found]) -> Callable[[_Asked], _Found]:
    """Return a function of a structure that computes its result once within `asked_once`."""

    @wraps(function)
    def asked(structure: _Asked) -> _Found:
        known = _known.get()
        if known is None:
            return function(structure)
        key = function.__qualname__, id(structure)
        if key not in known:
            known[key] = structure, function(structure)  # with the structure, so that its id stays its own
        found: _Found = known[key][1]
        return found

    return asked
