"""Limit of the BLAS libraries to one thread."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]


@cache
def _controller() -> Any:
    return ThreadpoolController()  # inspects every loaded library, so it is made only once


def one_blas_thread() -> AbstractContextManager[Any]:
    """Return a context in which the BLAS libraries of this process use one thread.

    Products of small matrices are slower with several threads.
    """
    limit: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limit
