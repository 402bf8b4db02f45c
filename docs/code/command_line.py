"""Command lines in the process of a page, as a reader would type them."""

import io
import re
from contextlib import redirect_stderr, redirect_stdout

import rich.console

from gbid.cli.main import app

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
