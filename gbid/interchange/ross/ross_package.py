"""Import of ROSS without the messages of the packages that it loads."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gbid.extras import extra_package


def ross_package(what: str) -> Any:
    """Return the package `ross`.

    Its dependencies print on their import that fluid libraries are not installed, which no rotor needs.

    Parameters
    ----------
    what : str
        What needs it, for the message.

    Raises
    ------
    UsageError
        When ROSS is not installed, or when it fails on its import.
    """
    if "ross" in sys.modules:
        return extra_package("ross", "ross", what)
    with warnings.catch_warnings(), _silence():
        warnings.simplefilter("ignore")
        return extra_package("ross", "ross", what)


@contextmanager
def _silence() -> Iterator[None]:
    """Send what the process prints nowhere: compiled libraries print past `sys.stdout`."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for target, source in enumerate(kept, start=1):
            os.dup2(source, target)
            os.close(source)
        os.close(nowhere)
