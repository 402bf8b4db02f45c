"""Tuned designs in figures, tables, the reproduction and the report: beside the published one, faults on top."""

from __future__ import annotations

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from experiment_files import STAIRS, json_of, printed_by, write_quick
from experiment_files import gbid as command
from figure_cases import BlankPictures

import gbid
from gbid import load, report
from gbid.control import GainStatus
from gbid.control.assessment import TunedDesign
from gbid.core.errors import DataError
from gbid.core.tables import engineering, value_of
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.report import write as report_file
from gbid.report.control_sections import held_back
from gbid.report.loop_pictures import comparable_designs
from gbid.report.named import comparison, paper
from gbid.report.sections import static_section
from gbid.report.write import write_report

YAML = """\
format: 1
name: designs
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  prbs: {recordings: 0}
  stationary: {recordings: 0}
controller:
  feedback: {peak_sensitivity: 2.0, starts: 1, pareto: [1.6, 2.6], operating_points: [{pressure_bar: 6, speed_rpm: 0}]}
  held: {bounds: {kappa_x: [0, 0.3]}, starts: 1, operating_points: [{pressure_bar: 6, speed_rpm: 0}]}
  elsewhere: {starts: 1, operating_points: [{pressure_bar: 7, speed_rpm: 0}]}
impacts:
  beside: {tuned: "tuned:feedback"}
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  repeats: 2
  spacing_s: 0.25
  lags: 1
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = write_quick(tmp_path_factory.mktemp("designs"), text=YAML)
    for verb in ("tune", "impact"):
        assert command(verb, path) == 0
    return path


@pytest.fixture(scope="module")
def results(made):
    return paper().PaperResults(Job(load_experiment(made)))


@pytest.fixture(scope="module")
def page(made):
    job = Job(load_experiment(made))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_file, "Pictures", BlankPictures)
        return write_report(job).path.read_text(encoding="utf-8")


def test_front_has_the_design_and_those_under_other_caps(results) -> None:
    data = report.designs_pareto_data(results.tuned)
    assert set(data.fronts) == {"P", "held"}  # the third was tuned for another point
    peaks, dampings = np.array(data.fronts["P"]).T
    np.testing.assert_allclose(peaks, [1.6, 2.0, 2.6], rtol=1e-6)
    assert (np.diff(dampings) > 0).all()
    model, (peak, damping) = gbid.load_model("theisen2016"), data.designs["published"]
    controller = gbid.control.p_controller(1.125, 0.99)
    assert peak == pytest.approx(gbid.sensitivities(model.plant_at(6, 0), controller).peak("output").value)
    assert damping == pytest.approx(0.318, abs=5e-4)
    with pytest.raises(DataError, match="gbid tune"):
        report.designs_pareto_data({})


def test_only_designs_on_the_same_terms_are_compared(results) -> None:
    designs = results.tuned
    assert list(comparable_designs(designs)) == ["feedback", "held"]
    decay = replace(designs["held"], result=replace(designs["held"].result, objective="decay"))
    assert list(comparable_designs({**designs, "held": decay})) == ["feedback"]


def test_table_of_designs_has_what_the_tuning_stored(made, results) -> None:
    table = paper().TABLES["designs"](results)
    assert tuple(column.heading for column in table.columns) == ("figure", "feedback", "held", "published")
    stored = load(made.parent / "results" / "designs" / "controller" / "feedback.h5", TunedDesign)
    rows = {row[0]: [value_of(cell) for cell in row[1:]] for row in table.rows}
    assert rows["continuous damping"][0] == pytest.approx(stored.performance[0].worst["damping"][0], abs=5e-4)
    assert rows["stack [µm]"][2] == pytest.approx(1e6 * stored.performance[1].worst["stack_travel_m"][0], abs=5e-3)


def test_impacts_of_each_loop_stand_beside(results) -> None:
    loops = results.beside_at(False)
    assert list(loops) == ["open loop", "published gains", "tuned"]
    with pytest.raises(DataError, match="no impacts with a turning shaft"):
        results.beside_at(True)
    table = paper().TABLES["designs_impacts"](results)
    assert [row[1:3] for row in table.rows] == [(label, axis) for label in loops for axis in "xy"]
    column = [column.heading for column in table.columns].index("disc [µm]")
    assert table.rows[0][column] == pytest.approx(1e6 * loops["open loop"].figures[0].peak_m)


def test_reproduction_ends_with_what_the_paper_has_no_figures_for(made, monkeypatch, capsys) -> None:
    monkeypatch.setattr(
        sys.modules[comparison().recorded_again.__module__], "_REPEATS", 2
    )  # twenty sets of impacts take long
    monkeypatch.setattr(paper(), "_PAST", paper()._PAST[:3])
    document = json_of(capsys, "paper", made, "--only", "comparison")
    titles = [table["title"] for table in document["past_the_paper"]]
    assert [title.split(" ")[0] for title in titles] == ["the", "modes", "readings", "Designs", "The"]
    out = printed_by(capsys, "paper", made, "--only", "comparison").out
    assert "stack [µm]" in out
    text = paper().reproduction_markdown(document)
    for table in document["past_the_paper"]:
        lines = text[text.index(table["title"]) :].split("\n\n")[1].splitlines()
        assert len({line.count("|") for line in lines}) == 1
        assert len(lines) == 2 + len(table["rows"])


def test_report_shows_designs_front_and_loops(page) -> None:
    for words in (
        "What the tuning found",
        "limited by",
        "Smallest damping factor over the peak of the output sensitivity: P 0.",
        "Pictures of feedback",
        "after the same impact along x and along y: open loop, published gains, tuned",
        "disc up to [µm]",
    ):
        assert words in page, words
    assert len(page) < 10e6


def test_faults_of_designs_stand_on_top(page, results) -> None:
    held = results.tuned["held"]
    assert held_back(held) == ["limited by kappa_x at its upper bound; wider bounds may damp more"]
    top = page[page.index('id="summary"') : page.index('id="controller"')]
    assert "controller held: limited by kappa_x at its upper bound" in top
    assert not re.search("controller feedback: (held|peak)", top)  # 2.0, well below the cap
    lost = replace(held, result=replace(held.result, status=GainStatus.LIMITS_CONTRADICT, violation=0.1))
    assert held_back(lost)[0] == "infeasible, limits exceeded by 10 %"


def test_designs_of_other_settings_are_not_shown_as_present(made, tmp_path) -> None:
    other = write_quick(tmp_path, ("peak_sensitivity: 2.0", "peak_sensitivity: 1.9"), text=YAML)
    computed = paper().PaperResults(Job(load_experiment(other, made.parent / "results" / "designs"))).tuned
    assert list(computed) == ["held", "elsewhere"]
    with pytest.raises(DataError, match="design feedback: not made yet; `gbid tune` makes it"):
        assert paper().PaperResults(Job(load_experiment(other, tmp_path / "out"))).tuned


def test_report_shows_the_static_characterisation(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(report_file, "Pictures", BlankPictures)
    path = write_quick(tmp_path, text=STAIRS)
    early = static_section(paper().PaperResults(Job(load_experiment(path))), BlankPictures())
    assert "static film is missing; run `gbid static`" in early.blocks[0].text
    for verb in ("rig", "static"):
        assert command(verb, path) == 0
    page = write_report(Job(load_experiment(path))).path.read_text(encoding="utf-8")
    section = page[page.index('id="static"') :].partition("</section>")[0]
    results = paper().PaperResults(Job(load_experiment(path)))
    assert engineering(results.static_map.gain[0, 0]) in section
    assert f"{1e6 * results.piezos[0][0].hysteresis:.2f} µm in open loop" in section
    assert section.count("<svg") == 3
