"""Lines for people on standard error; what a terminal would act on is shown as its code."""

from __future__ import annotations

import sys

from gbid.naming.escape import printable


def tell(text: str) -> None:
    """Print lines on standard error.

    Parameters
    ----------
    text : str
        One or several lines.
    """
    for line in text.split("\n"):
        print(printable(line), file=sys.stderr, flush=True)  # noqa: T201
