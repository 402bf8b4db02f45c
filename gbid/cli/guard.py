"""End of a verb: each error is one line on standard error, with an exit code."""

from __future__ import annotations

import logging
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import typer

from gbid.cli.printing import print_json
from gbid.cli.telling import tell
from gbid.errors import GbidError, from_interrupt

INTERRUPTED = 130
_SOON_S = 0.05
_INTERRUPTED = ["interrupted; complete results are kept"]


@contextmanager
def guarded(as_json: bool = False, debug: bool = False) -> Iterator[None]:
    """Return a context for the body of a verb, which turns errors into messages and exit codes.

    Parameters
    ----------
    as_json : bool
        Whether an error is also printed as the JSON document on standard output.
    debug : bool
        Whether the traceback is shown.
    """
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # without a home folder it would tell where its cache is
    try:
        with _interrupted_by_termination(), _heard_again():
            yield
    except typer.Exit:
        raise
    except KeyboardInterrupt:
        _end(_INTERRUPTED, INTERRUPTED, "", as_json, debug)
    except Exception as error:
        if from_interrupt(error):
            _end(_INTERRUPTED, INTERRUPTED, "", as_json, debug)
        if isinstance(error, GbidError):
            _end(str(error).splitlines(), error.exit_code, "error: ", as_json, debug)
        text = f"{type(error).__name__}: {error} (a defect of gbid, not of your input; please report it"
        hint = ")" if debug else " with what --debug shows)"
        _end([" ".join((text + hint).split())], 1, "defect: ", as_json, debug)


@contextmanager
def _interrupted_by_termination() -> Iterator[None]:
    """Return a context in which SIGTERM and SIGHUP act as Ctrl-C does: workers end and complete results are kept.

    Signals that the process ignores (nohup) stay ignored.
    """
    ours = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    changed = [number for number in ours if signal.getsignal(number) == signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():
        changed = []
    for number in changed:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def _heard_again() -> Iterator[None]:
    """Return a context in which an interruption that Python ignores comes again.

    Python prints and forgets what is raised in the callbacks of weak references and in finalisers, also Ctrl-C.
    """
    before = sys.unraisablehook

    def hook(ignored: sys.UnraisableHookArgs) -> None:
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            threading.Timer(_SOON_S, signal.raise_signal, (signal.SIGINT,)).start()
        else:
            before(ignored)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as in a process that a shell runs in the background
        raise KeyboardInterrupt
    signal.raise_signal(signal.SIGINT)


def _end(lines: list[str], code: int, word: str, as_json: bool, debug: bool) -> None:
    if debug:
        tell(traceback.format_exc().rstrip())
    for line in lines:
        tell(f"gbid: {word}{line}")
    if as_json:
        print_json({"error": {"exit_code": code, "messages": lines}})
    raise typer.Exit(code)
