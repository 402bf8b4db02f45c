"""The figures of a design are the same wherever they are shown: those that the tuning stored, under its conditions."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from html import unescape

import pytest
from experiment_files import gbid as command
from experiment_files import printed_by, write_quick
from figure_cases import BlankPictures
from typer.testing import CliRunner

from gbid.cli.main import app
from gbid.control.assessment import FIGURES
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.report import write as report_file
from gbid.report.named import paper
from gbid.report.read import Results

CONDITIONS = {"sample_time_s": 1e-3, "method": "zoh"}
YAML = """\
format: 1
name: slow
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  prbs: {recordings: 0}
  stationary: {recordings: 0}
controller:
  slow:
    sample_time_s: 1e-3
    method: zoh
    operating_points: [{pressure_bar: 6, speed_rpm: 0}, {pressure_bar: 4, speed_rpm: 3000}]
    goals:
      - {goal: MaxDamping}
      - {goal: PeakSensitivity, limit: 3.0}
      - {goal: PiezoTravel, impact: {peak_n: 5.0, duration_s: 1e-3}, travel_m: 20e-6}
"""
WORDS = "half-sine impact of 5 N, 1 ms; sampled at 1 ms (zero-order hold)"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = write_quick(tmp_path_factory.mktemp("slow"), text=YAML)
    assert command("tune", path) in (0, 4)
    return path


@pytest.fixture(scope="module")
def document(made):
    """What `gbid tune --json` prints."""
    return json.loads(CliRunner().invoke(app, ["tune", str(made), "--json"]).stdout)["tuning"][0]


@pytest.fixture(scope="module")
def expected(document):
    """Row by row what each design is to be shown with."""

    def cell(design, name, figure):
        value = design["worst"][name]["value"]
        return "inf" if value is None else format(figure.factor * value, figure.format)  # JSON knows no infinity

    return {q.heading: [cell(design, name, q) for design in document["performance"]] for name, q in FIGURES.items()}


def test_the_conditions_are_those_of_the_experiment(document, expected):
    assert {key: document[key] for key in CONDITIONS} == CONDITIONS
    assert document["impact"] == {"peak_n": 5.0, "duration_s": 1e-3, "mass_kg": 2.18}
    assert [len(design["points"]) for design in document["performance"]] == [2, 2]
    assert float(expected["sampled damping"][0]) < 0 < float(expected["continuous damping"][0])


def test_terminal(made, expected, capsys):
    out = printed_by(capsys, "tune", made).out
    assert WORDS in " ".join(out.split())
    for heading, cells in expected.items():
        line = next(entry for entry in out.splitlines() if entry.startswith(heading))
        assert line.removeprefix(heading).split() == cells


def test_paper_tables(made, expected, monkeypatch):
    monkeypatch.setattr(paper(), "save_figure", lambda _figure, part, **_: part.touch())
    assert command("paper", made, "--only", "figures") == 0
    folder = made.parent / "results" / "slow" / "figures"
    lines = [line for line in (folder / "designs.csv").read_text().splitlines() if not line.startswith("#")]
    rows = {row[0]: row[1:] for row in csv.reader(lines)}
    for figure, cells in zip(FIGURES.values(), expected.values(), strict=True):
        assert [format(float(cell), figure.format) for cell in rows[figure.heading]] == cells
    text = (folder / "designs.md").read_text()
    assert WORDS in text
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    rows = {row[0]: row[1:] for row in lines}
    assert {heading: rows[heading] for heading in expected} == expected


def test_report(made, expected, monkeypatch):
    monkeypatch.setattr(report_file, "Pictures", BlankPictures)
    command("report", made)
    page = unescape((made.parent / "results" / "slow" / "report.html").read_text(encoding="utf-8"))
    section = page[page.index('id="controller"') :]
    assert WORDS in section
    rows = re.findall(r"<tr>(.*?)</tr>", section, re.DOTALL)
    cells = [re.findall(r"<t[hd][^>]*>\s*(.*?)\s*</t[hd]>", row, re.DOTALL) for row in rows]
    results = {row[0]: row[1:] for row in cells if row}
    for heading, values in expected.items():
        assert results[heading] == values
    top = page[page.index('id="summary"') : page.index('id="controller"')]
    assert "controller slow: sampled loop not stable at every point, sampled at 1 ms (zero-order hold)" in top
    assert "an impact of 5 N along x" in page


def test_the_cap_and_the_travel_are_those_of_the_experiment(made):
    slow, published = Results(Job(load_experiment(made))).assessed
    assert (slow.name, published.name, slow.cap) == ("slow", "published", 3.0)
    assert not any("above 2.6" in text for text in slow.warnings())
    peak = slow.figures.worst["peak_output"][0]
    tight = replace(slow, cap=peak - 0.01)
    words = f"peak of S_o {peak:.3f}, above {tight.cap:g}"
    assert words in tight.warnings()
    assert words not in replace(tight, for_sampling=True).warnings()  # its cap is on the sampled loop
    stack = slow.figures.worst["stack_travel_m"][0]
    assert slow.figures.exceeds_travel.any() == (stack > 10e-6)


def test_without_designs_the_published_one_is_sampled_as_the_rig_is(tmp_path):
    text = YAML[: YAML.index("controller:")].replace("rig:\n", "rig:\n  sample_time_s: 1e-3\n")
    text = text.replace("prbs: {recordings: 0}", "prbs: {recordings: 1}")
    (published,) = Results(Job(load_experiment(write_quick(tmp_path, text=text)))).assessed
    assert published.sample_time == 1e-3
    assert published.warnings()[0].startswith("sampled, its smallest damping factor is")
