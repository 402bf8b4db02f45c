"""Every line of the tables of "coming from" is executed: what a newcomer types first must be there."""

import re
from pathlib import Path

import pytest
from places import DOCS
from run_page import cells

PAGE = DOCS / "coming-from.md"
ROW = re.compile(r"^\| (?P<there>.+?) \| (?P<here>.+) \|$", re.MULTILINE)
ROWS = [match.groups() for match in ROW.finditer(PAGE.read_text(encoding="utf-8")) if match["there"] != "there"]


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """Names of the hidden cell and of the process model, which the tables use, and the folder of their files."""
    known = {"__name__": "__main__"}
    hidden = [cell for cell in cells(PAGE) if "docs.code.coming_from" in cell]
    process = [cell[: cell.index("found =")] for cell in cells(PAGE) if "process =" in cell]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("newcomer"))
        for cell in (*hidden, *process):
            exec(compile(cell, PAGE.name, "exec"), known)
        return known, Path.cwd()


def test_the_tables_are_read():
    assert len(ROWS) >= 45
    assert [there for there, here in ROWS if "`" not in here] == [
        "`TuningGoal.Overshoot`, `StepTracking`",
        "`control.hinfsyn`, `mixsyn`, `lqr`, `lqe`",
    ]


@pytest.mark.parametrize(("there", "here"), ROWS, ids=[there.replace("`", "") for there, _ in ROWS])
def test_each_line_runs(there, here, names, monkeypatch):
    known, folder = names
    monkeypatch.chdir(folder)
    for code in re.findall(r"`([^`]+)`", here):
        if code.startswith("gbid ") or code in ("p", "r"):
            continue  # a command, which tests/house/test_docs.py looks up; signals
        eval(compile(code, there, "eval"), known)
