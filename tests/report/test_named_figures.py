"""A figure is one file: its name, what it needs and how it is drawn; verbs, page and docs find it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from experiment_files import QUICK, write_quick
from experiment_files import gbid as command
from figure_cases import BlankPictures

from gbid import report as figures
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.report import write as report_file
from gbid.report.named import named_figures, paper

ONE_FILE = """\
from matplotlib.figure import Figure

from gbid.report.canvas import panels, styled
from gbid.report.named import NamedFigure


@styled
def plot_poles(poles, ax=None) -> Figure:
    figure, (panel, *_) = panels(ax, size=(4.6, 3.1))
    panel.plot(poles.real, poles.imag, "x")
    return figure


FIGURES = (
    NamedFigure(
        "poles_of_the_machine",
        lambda results: plot_poles(results.machine.plant_at(6, 0).poles()),
        words="Poles of the machine behind the rig at 6 bar, 0 rpm",
        section="controller",
    ),
)
"""


@pytest.fixture
def one_file(tmp_path, monkeypatch):
    """A file more in the package of figures."""
    folder = tmp_path / "more"
    folder.mkdir()
    (folder / "poles.py").write_text(ONE_FILE)
    monkeypatch.setattr(figures, "__path__", [*figures.__path__, str(folder)])
    yield
    sys.modules.pop("gbid.report.poles", None)


@pytest.mark.parametrize("module", ["theisen2016_impacts", "theisen2016_comparison", "theisen2016_paper"])
def test_a_new_worker_finds_each_module_beside_the_experiment(module, tmp_path):
    """A worker that is spawned has loaded none of them; their functions get the job and the file."""
    task = f"from gbid.report.named import write_shipped; write_shipped(1, 2, module={module!r}, function='__name__')"
    run = subprocess.run([sys.executable, "-c", task], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "'str' object is not callable" in run.stderr  # loaded, and its name is no function


def test_each_figure_of_the_paper_has_a_name():
    names = list(named_figures())
    assert names == sorted(names)
    numbers = {name[3:5] for name in names if name.startswith("fig") and name[3:5].isdigit()}
    assert numbers == {f"{n:02d}" for n in range(3, 28)}
    assert {"figA28_piezo_hysteresis", "figA29_piezo_staircase", "designs_pareto"} < set(names)


def test_a_file_is_enough_for_verb_and_page(tmp_path, one_file, monkeypatch):
    assert "poles_of_the_machine" in named_figures()
    path = write_quick(tmp_path, text=QUICK)
    results = {name: figure for name, figure in named_figures().items() if name == "poles_of_the_machine"}
    monkeypatch.setattr(paper(), "named_figures", lambda: results)  # the others take their time
    monkeypatch.setattr(report_file, "Pictures", BlankPictures)
    assert command("paper", path, "--only", "figures") == 0
    assert (tmp_path / "results" / "quick" / "figures" / "poles_of_the_machine.pdf").is_file()
    page = report_file.write_report(Job(load_experiment(path))).path.read_text(encoding="utf-8")
    assert "Poles of the machine behind the rig at 6 bar, 0 rpm" in page[page.index('id="controller"') :]
