"""Line at the bottom of a terminal that is updated: a spinner, a bar, and what is being done."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from gbid.naming.escape import printable

_BAR = 16  # characters


class LiveLine:
    """Line that is updated on standard error, with finished lines above it. It is a context.

    Parameters
    ----------
    console : rich.console.Console, optional
        Console to write to; by default standard error. rich leaves the colours out where NO_COLOR is set.
    """

    def __init__(self, console: Any = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn
        from rich.table import Column

        self._console = console or Console(stderr=True, highlight=False)
        text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
        more = TextColumn("{task.fields[more]}", markup=False, table_column=Column(no_wrap=True))
        columns = (SpinnerColumn(), BarColumn(_BAR), more, text)
        self._progress = Progress(*columns, console=self._console, transient=True)
        self._task = self._progress.add_task("", total=None, more="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def begin(self, total: int) -> None:
        """Begin a bar of so many items; without any it only moves."""
        self._progress.update(self._task, total=total or None, completed=0, description="", more="")

    def show(self, text: str | None, done: int, more: str = "") -> None:
        """Show a text, None for the one that is there, the number of items done, and a remark beside the bar."""
        self._progress.update(self._task, completed=done)
        if text is not None:
            self._progress.update(self._task, description=printable(text), more=more)

    def say(self, text: str) -> None:
        """Print a line above."""
        self._console.print(printable(text), markup=False, soft_wrap=True)
