"""What results say of themselves in a Python shell: few lines, with what a reader asks for first."""

import subprocess
import sys
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import import_module
from pkgutil import walk_packages
from xml.etree import ElementTree

import numpy as np
import pytest
from campaign_files import write_springs
from experiment_files import gbid as run_gbid

import gbid
from gbid.control.assessment import assess
from gbid.control.tuning.result import GainResult, GainStatus, WorstMode
from gbid.core.brief import WIDTH, Brief, brief, counted, in_words
from gbid.validate.crossval import summarise

LINES = 20


@dataclass(frozen=True)
class Numbers:
    values: np.ndarray
    about: str = "nothing"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results of a campaign of three fits, of which one could not be made."""

    def bad(columns):
        columns["position [um]"][7] = np.inf

    path = write_springs(tmp_path_factory.mktemp("springs"), 3, damage={2: bad})
    assert run_gbid("batch", path, "--engine", "serial") == 3
    return path.parent / "results" / "springs"


@pytest.fixture(scope="module")
def machine():
    return gbid.load_model("theisen2016")


def lines_of(value):
    lines = repr(value).splitlines()
    assert 1 <= len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH
    assert "\u00a0" not in repr(value)
    return lines


def test_table(folder):
    table = gbid.load(folder / "table.h5")
    lines = lines_of(table)
    assert lines[0] == "FitTable: 3 fits, 2 converged"
    assert lines[1].split() == ["fit", "3", "spring"]
    assert str(table) == repr(table)
    assert "also: model," in repr(table)
    assert {"parameter_names", "fit_percent"} < set(table._brief().rows)
    assert lines_of(table.select(fit="spring", success=True))[0] == "FitTable: 2 fits, 2 converged"


def test_fit(folder):
    result = gbid.load(folder / "fits" / "spring" / "run1.h5")
    lines = lines_of(result)
    assert lines[0] == f"FitResult: {result.structure}, {result.status}"
    (frequency, _), *_ = result.model.modes()
    assert f"k = {result.parameters['k']:.5g} +- {result.std['k']:.2g}" in repr(result)
    assert f"{frequency:.2f} +- " in repr(result)
    assert lines_of(result.model)[0].endswith("2 states, continuous time")
    assert lines_of(result.changed(notes=("a long note " * 30,) * 2))


def test_recording(folder):
    rec = gbid.load_recording(folder / "recordings" / "run1.h5")
    assert lines_of(rec)[0] == f"Recording: run1, {rec.n_samples} samples of {rec.sample_time:g} s, {rec.duration:g} s"
    assert "pressure_bar = 4" in repr(rec)
    odd = gbid.Recording({"about": np.zeros((5, 1)), "owner": np.ones((5, 1))}, 1.0)
    assert any(line.split()[0] == "owner" for line in lines_of(odd)[1:])


def test_models_and_loops(machine):
    assert lines_of(machine)[0].startswith("LPVModel: ")
    assert "pressure_bar 3 to 7, speed_rpm 0 to 6000" in repr(machine)
    assert "a doubt" in replace(machine, notes=("a doubt",))._repr_html_()
    plant = machine.plant_at(6, 0)
    loop = gbid.sensitivities(plant, gbid.LinearModel([[-1.0]], [[0.0, 0.0]], [[0.0], [0.0]], 0.1 * np.eye(2)))
    assert len(lines_of(loop)) == 3
    assert lines_of(gbid.LinearModel(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]]))


def test_designs(machine):
    assessment = assess(machine, "P", {"kappa_x": 0.1, "kappa_y": 0.1}, [(6.0, 0.0), (5.0, 0.0)])
    assert lines_of(assessment)[0] == "Assessment: P, 2 operating points, sampled loop stable, continuous loop stable"
    assert repr(gbid.compare_designs([assessment])) == str(gbid.compare_designs([assessment]))
    gains = GainResult(
        {"kappa_x": 0.5}, 0.3, "damping", GainStatus.OPTIMAL, 0.0, "loops", WorstMode("6 bar", 90.0, 0.3)
    )
    lines = lines_of(gains)
    assert lines[0] == "GainResult: damping 0.3, optimal"
    assert lines[1].split() == ["gains", "kappa_x", "=", "0.5"]
    assert "peak_sensitivity" not in "\n".join(lines).partition("also: ")[0]
    front = gbid.control.ParetoFront((2.0, 2.6), (gains, gains))
    assert [line.split()[1] for line in lines_of(front)[1:3]] == ["2", "2.6"]


def test_validation():
    scores = gbid.validate.ValidationScores(
        ("run1", "run1"),
        ("run1", "run3"),
        np.full(2, 4.0),
        np.zeros(2),
        ("y",),
        ("m",),
        np.full((2, 1), 98.0),
        np.ones((2, 1)),
    )
    assert lines_of(scores)[0] == "ValidationScores: 2 pairs of model and recording"
    assert "98.00 +- 0.00 %" in repr(summarise(scores))
    assert len(lines_of(summarise(scores))) <= 5


def test_what_is_long_is_cut():
    many = Numbers(np.arange(1e5))
    assert (
        brief(many, "x", values=many.values).text() == "Numbers: x\n  values  100000 numbers, 0 to 99999\n  also: about"
    )
    assert "... 2 more" in brief(many, "x", values={f"n{i}": 0.1 * i for i in range(8)}).text()
    assert in_words(np.array([1.0, np.nan] * 9)) == "18 numbers, 1 to 1, 9 without a value"
    assert in_words(np.full(9, np.nan)) == "9 numbers, 9 without a value"
    assert in_words(np.array([[1.0, 2.5]])) == "[[1. 2.5]]"
    assert counted(["b", "a", "b"]).split(",")[0].split("\u00a0") == ["2", "b"]


def exported():
    """Dataclasses that a package of gbid exports."""
    for package in walk_packages(gbid.__path__, "gbid."):
        if package.ispkg and package.name.count(".") < 3 and package.name not in ("gbid.cli", "gbid.experiment"):
            module = import_module(package.name)
            for name in getattr(module, "__all__", ()):
                value = getattr(module, name)
                if is_dataclass(value):
                    yield value


def test_values_with_arrays_are_brief():
    """The repr that `@dataclass` writes would print the arrays: 43 000 characters for a validation."""
    long = {kind for kind in exported() if any("Array" in str(f.type) for f in fields(kind))}
    assert len(long) > 20
    assert {kind.__name__ for kind in long if kind.__repr__ is not Brief.__repr__} == set()


def test_packages_are_there_as_written():
    """In a process that has imported nothing else."""
    code = """
import sys, gbid
light = {"gbid._version", "gbid.core", "gbid.core.figures", "gbid.core.public"}
assert not [name for name in sys.modules if name.startswith("gbid.") and name not in light]
assert gbid.control.tune and gbid.report and gbid.rig.rig_effects and gbid.core.errors
assert "control" in dir(gbid)
try:
    gbid.contrl
except AttributeError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "No gbid attribute contrl\n"


def test_notebooks_show_a_table(folder):
    result = gbid.load(folder / "fits" / "spring" / "run1.h5")
    html = result._repr_html_()
    assert all(name in html for name in result._brief().rows if name != "parameters")
    assert ElementTree.fromstring(f"<div>{html}</div>").find(".//table") is not None
    assert f"<strong>FitResult: {result.structure}, {result.status}</strong>" in html
    assert '<th scope="row">k</th>' in html
    odd = gbid.Recording({"u": np.zeros((5, 1))}, 1.0, name="a <b> & c")
    assert "a &lt;b&gt; &amp; c" in odd._repr_html_()
