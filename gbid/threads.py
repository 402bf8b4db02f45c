"""Threads of this process: one in each BLAS library, and one at a time in the solver."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]


class _Shared:
    """What all threads of the process share: the turn of the solver, and the limit of the BLAS libraries."""

    def __init__(self) -> None:
        self.turn, self.counting = threading.RLock(), threading.Lock()
        self.users = 0
        self.limit: Any = None


_shared = _Shared()
if hasattr(os, "register_at_fork"):  # a child has none of the threads that may hold a lock
    os.register_at_fork(after_in_child=lambda: _shared.__init__())  # type: ignore[misc]


@cache
def _controller() -> Any:
    return ThreadpoolController()  # inspects every loaded library, so it is made only once


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Return a context in which the BLAS libraries of this process use one thread.

    Products of small matrices are slower with several threads. The limit is that of the process: the first thread to
    enter sets it, and the last one to leave restores what was there.
    """
    with _shared.counting:
        if _shared.users == 0:
            _shared.limit = _controller().limit(limits=1, user_api="blas")
        _shared.users += 1
    try:
        yield
    finally:
        with _shared.counting:
            _shared.users -= 1
            if _shared.users == 0:
                _shared.limit.restore_original_limits()


def one_solver() -> AbstractContextManager[Any]:
    """Return a context that one thread of the process is in at a time: MUMPS, which IPOPT uses, is not thread-safe."""
    return _shared.turn
