"""Command lines in the process of a page, as a reader would type them."""

import io
import re
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import rich.console

from gbid.cli.main import app
from gbid.core import errors

rich.console._is_jupyter = lambda: False  # a notebook, too, gets tables as text, where the command prints them


def call(command: str) -> tuple[str, str, int]:
    """Run a command line; return standard output, standard error and exit code."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with redirect_stdout(out), redirect_stderr(err):
        try:
            app(command.split()[1:], prog_name="gbid")
        except SystemExit as end:
            code = int(end.code or 0)
    plain = (re.sub(r"\x1b\[[\d;]*m", "", said.getvalue()) for said in (out, err))  # a kernel of Jupyter forces colours
    return *plain, code


def run(command: str, keep: str = "", most: int = 1000) -> None:
    """Print a command line with what it prints, or with the first lines that fit a pattern."""
    out, err, code = call(command)
    lines = (out + err).rstrip().splitlines()
    shown = [line.rstrip() for line in lines if re.search(keep, line)][:most]
    print(f"$ {command}", *shown, *(["..."] if len(shown) < len(lines) else []), sep="\n")
    if code:
        print(f"[exit code {code}]")


def shorten_quickstart(folder: str) -> Path:
    """Shorten the recordings of a new experiment and leave out joint fit and figures; return its file."""
    path = Path(folder, "experiment.yaml")
    text = path.read_text(encoding="utf-8")
    shorter = text.replace("duration_s: 5.0", "duration_s: 1.5")
    assert shorter != text
    shorter = (
        shorter[: shorter.index("  joint:")] + shorter[shorter.index("  bearing:") : shorter.index("  joint: {on")]
    )
    path.write_text(shorter, encoding="utf-8")
    return path


def print_helps() -> None:
    """Help of each verb that is listed; verbs of stages have the options of run."""
    for command in app.registered_commands:
        if not command.hidden:
            run(f"gbid {command.name} --help")
            print()


def print_exit_codes() -> None:
    meanings = {
        0: "fine",
        errors.GbidError.exit_code: "a defect of gbid",
        errors.UsageError.exit_code: "wrong usage, or something wrong in the YAML or in a structure file",
        errors.DataError.exit_code: "bad data: a recording or result that cannot be used",
        errors.NotConvergedError.exit_code: "a fit did not converge; its result is written and says so",
        errors.ThresholdError.exit_code: "a validation threshold of the experiment was missed",
        130: "interrupted; complete results are kept",
    }
    for code, meaning in meanings.items():
        print(f"{code:4}  {meaning}")
