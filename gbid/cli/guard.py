"""Errors and interruptions of a verb: one line on standard error and an exit code."""

from __future__ import annotations

import _thread
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType

import typer

from gbid.cli.printing import print_json, tell, tell_error
from gbid.core.errors import GbidError, UsageError, from_interrupt

INTERRUPTED = 130
_SOON_S = 0.2
_INTERRUPTED = ["interrupted; complete results are kept"]


@contextmanager
def guarded(as_json: bool = False, debug: bool = False) -> Iterator[None]:
    """Return a context for the body of a verb that turns errors into messages and exit codes.

    Parameters
    ----------
    as_json : bool
        Whether an error is also printed as the JSON document on standard output.
    debug : bool
        Whether the traceback is shown.
    """
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # without a home folder it would tell where its cache is
    try:
        with _interruptible():
            yield
    except typer.Exit:
        raise
    except SystemExit as error:
        text = (
            f"a Python file of the experiment, or a package, ended gbid by sys.exit({error.code!r}); remove that call"
        )
        _end([text], UsageError.exit_code, "error: ", as_json, debug)
    except BrokenPipeError as error:  # the reader of standard output has enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit from error
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, KeyboardInterrupt) or from_interrupt(error):
            _end(_INTERRUPTED, INTERRUPTED, "", as_json, debug)
        if isinstance(error, GbidError):
            _end(str(error).splitlines(), error.exit_code, "error: ", as_json, debug)
        text = f"{type(error).__name__}: {error} (a defect of gbid, not of your input; please report it"
        hint = ")" if debug else " with what --debug shows)"
        _end([" ".join((text + hint).split())], 1, "defect: ", as_json, debug)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Return a context in which Ctrl-C, SIGTERM and SIGHUP stop the workers and keep complete results.

    Signals that the process ignores (nohup) stay ignored. A signal raises KeyboardInterrupt wherever Python is. In some
    places exceptions are forgotten: in finalisers, in callbacks of weak references, and within CasADi while it tries
    the types of arguments. So the signal comes again until its exception is being handled. A library may also clear the
    exception and fail with one of its own, as matplotlib does while it converts arrays: until the signal is heard, a
    failure counts as its consequence.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers: dict[int, Callable[[int, FrameType | None], None]] = {}
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        handlers[signal.SIGINT] = _interrupt
    for name, handler in (("SIGTERM", _terminate), ("SIGHUP", _terminate), ("SIGALRM", _again)):
        number = getattr(signal, name, None)  # Windows has not all of them
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:
            handlers[number] = handler
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    hook, sys.unraisablehook = sys.unraisablehook, partial(_forgotten, sys.unraisablehook)
    try:
        yield
    except typer.Exit:
        raise
    except Exception as error:
        if _is_reminding():
            raise KeyboardInterrupt from error
        raise
    finally:
        _remind(0.0)
        sys.unraisablehook = hook
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    _remind(_SOON_S)
    raise KeyboardInterrupt


def _terminate(_number: int, _frame: FrameType | None) -> None:
    _remind(_SOON_S)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as in a process that a shell runs in the background
        raise KeyboardInterrupt
    signal.raise_signal(signal.SIGINT)  # whose handler is another one while a solver runs


def _again(number: int, frame: FrameType | None) -> None:
    handled = sys.exception()
    if handled is None or not from_interrupt(handled):
        _terminate(number, frame)


def _forgotten(before: Callable[[sys.UnraisableHookArgs], object], ignored: sys.UnraisableHookArgs) -> None:
    """Repeat an interruption that Python ignored because it came in a destructor or callback."""
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        _remind(_SOON_S)
        if not hasattr(signal, "setitimer"):  # Windows
            again = threading.Timer(_SOON_S, _thread.interrupt_main)
            again.daemon = True
            again.start()
    else:
        before(ignored)


def _remind(seconds: float) -> None:
    """Schedule SIGALRM repeatedly with an interval [s]; 0 stops it."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds, seconds)


def _is_reminding() -> bool:
    return hasattr(signal, "getitimer") and signal.getitimer(signal.ITIMER_REAL)[0] > 0


def _end(lines: list[str], code: int, word: str, as_json: bool, debug: bool) -> None:
    if debug:
        tell(traceback.format_exc().rstrip())
    for line in lines:
        tell_error(line, word)
    if as_json:
        print_json({"error": {"exit_code": code, "messages": lines}})
    raise typer.Exit(code)
