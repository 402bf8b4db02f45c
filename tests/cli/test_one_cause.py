"""One cause, one line: what could not be made because of it is counted, and the last line is the cause."""

import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import typer

from gbid.cli.progress import ProgressReporter, reporting
from gbid.cli.stages import finish
from gbid.core import compiled
from gbid.experiment.fields import Item
from gbid.experiment.run import Outcome


def failed(stage, item, text, cause="data", before=False):
    return Outcome(Item(stage, item), Path(f"{item}.h5"), "failed", text, cause=cause, before=before)


IMPORTS = [failed("import", f"run{i}", f"run{i}.csv: bad; repair it") for i in range(1, 7)]
FITS = [failed("fit", f"spring/run{i}", "its input is missing", "input") for i in range(1, 7)]
PAIRS = [failed("crossval", f"spring/run{i} on run1", "file is missing", "input") for i in range(2, 7)]
TABLE = Outcome(Item("table", "table.h5"), Path("table.h5"), "made")


def end_of(outcomes, capsys):
    """Lines and exit code at the end of a verb."""
    code = 0
    try:
        finish(outcomes)
    except typer.Exit as end:
        code = end.exit_code
    return capsys.readouterr().err.splitlines(), code


def test_the_last_line_is_the_first_cause(capsys):
    lines, code = end_of([*IMPORTS, *FITS, TABLE, *PAIRS], capsys)
    assert code == 3
    assert lines[-1] == "gbid: error: import run1: run1.csv: bad; repair it"
    assert len(lines) == 6


@pytest.mark.parametrize(
    ("cause", "word", "code"), [("usage", "error", 2), ("defect", "defect", 1), ("crash", "error", 3)]
)
def test_the_exit_code_is_that_of_the_last_line(cause, word, code, capsys):
    lines, computed = end_of(
        [IMPORTS[0], *FITS, failed("fit", "x", "why", cause), failed("fit", "y", "so", cause)], capsys
    )
    assert computed == code
    assert lines[-1] == (
        f"gbid: {word}: fit x: why" if code < 3 else "gbid: error: import run1: run1.csv: bad; repair it"
    )


def test_inputs_that_were_missing_before_have_a_line_for_each_stage(capsys):
    lines, code = end_of([*FITS, *PAIRS], capsys)
    assert code == 3
    assert lines == [
        "gbid: error: crossval: 5 results not made: file is missing",
        "gbid: error: fit: 6 models not made: its input is missing",
    ]


def test_a_long_compilation_is_told_before_it_begins(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "compile_source", lambda *_: sys.stderr.write("compiler\n"))
    source = " " * 20_000
    for said in (reporting(), nullcontext()):
        with said, pytest.raises(OSError, match=r"a\.so"):
            compiled._built(compiled.Compiler(("cc",), ""), (), source, tmp_path / "a.so")
    first, *rest = capsys.readouterr().err.splitlines()
    assert first.endswith("compiling, once for this model and machine (20 kB of C, some seconds)")
    assert rest == ["compiler", "compiler"]


def test_a_lost_worker_is_told_with_its_items(capsys):
    reporter = ProgressReporter()
    reporter.lose([Item("fit", f"s{i}") for i in range(12)], 2)
    line = "2 Dask workers were lost; tried again: fit s0, fit s1, "
    assert line in (told := capsys.readouterr().err)
    assert told.rstrip().endswith("fit s9 and 2 more")


def test_progress_counts_what_could_not_be_made_once_for_each_stage(capsys):
    reporter = ProgressReporter()
    for stage, outcomes in (("import", IMPORTS), ("fit", FITS), ("table", [TABLE]), ("crossval", PAIRS)):
        reporter.expect(stage, 0, 0, 0)
        for outcome in outcomes:
            reporter.end(outcome)
    reporter.close()
    assert capsys.readouterr().err.splitlines()[6:] == [
        "fit: 6 models not made: import of 6 recordings failed",
        "table table.h5: made (0.0 s)",
        "crossval: 5 results not made: import of 6 recordings failed",
    ]


def test_what_is_left_out_for_lack_of_input_is_not_counted_as_failed(capsys):
    reporter = ProgressReporter()
    figures = [failed("figure", f"fig{i}", "no section 'lpv'; add one", "input") for i in range(14)]
    figures[0] = failed("figure", "fig0", "no data")
    reporter.expect("figure", len(figures), 0, 0)
    for outcome in figures:
        reporter.begin(outcome.item)
        reporter.end(outcome)
    reporter.close()
    assert "figure: 14 of 14 done, 1 failed," in capsys.readouterr().err
