"""One BLAS thread where many small matrices are multiplied."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]


@cache
def _controller() -> Any:
    return ThreadpoolController()  # looks at every loaded library: once


def one_blas_thread() -> AbstractContextManager[Any]:
    """Hold the BLAS libraries of this process to one thread while the context is open."""
    limit: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limit
