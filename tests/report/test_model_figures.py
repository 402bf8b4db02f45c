"""Figures of a model with its uncertainty."""

import numpy as np
import pytest
from experiment_files import SPRING, gbid, write_spring
from fit_cases import MODE, MODE_AT, levels, simulated
from matplotlib.figure import Figure

from gbid import report
from gbid.errors import UsageError
from gbid.identify import fit, measured_response
from gbid.structure import LinearModel, evaluate


@pytest.fixture(scope="module")
def rec():
    return simulated(MODE, MODE_AT, levels(600, hold=2), noise=0.3)


@pytest.fixture(scope="module")
def result(rec):
    return fit(MODE, rec, focus="simulation")


def test_bode_diagram_of_a_fit_a_model_and_a_measurement(rec, result):
    truth = evaluate(MODE, MODE_AT)
    axes = report.plot_bode({"fit": result, "truth": truth}, measured=measured_response(rec, "u", "y"))
    assert axes.shape == (3, 1)
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["magnitude", "phase [°]", "coherence"]
    figure = axes[0, 0].figure
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["fit", "95 %", "truth", "measured"]
    assert len(axes[0, 0].collections) == 1  # a band for the fit, none for the plain model
    line = axes[0, 0].lines[0]
    data = report.bode_data(result, line.get_xdata())["mode"]
    np.testing.assert_array_equal(line.get_ydata(), data.magnitude[:, 0, 0])
    low, high = data.magnitude_band()
    vertices = axes[0, 0].collections[0].get_paths()[0].vertices[:, 1]
    assert vertices.min() == pytest.approx(low.min())
    assert vertices.max() == pytest.approx(high.max())


def test_bode_diagram_in_axes_of_ones_own(result):
    figure = Figure()
    own = figure.subplots(2, 1)
    axes = report.plot_bode(result, own, frequency_hz=[0.5, 1.0])
    assert axes[0, 0] is own[0]
    with pytest.raises(UsageError, match="1 axes for 2 panels"):
        report.plot_bode(result, own[0])


def test_models_of_a_figure_need_the_same_channels(rec, result):
    wide = LinearModel(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), name="wide")
    with pytest.raises(UsageError, match="mode 1 x 1, wide 2 x 2"):
        report.plot_bode([result, wide])
    with pytest.raises(UsageError, match="1 x 1 outputs and inputs, the models have 2 x 2"):
        report.plot_bode(wide, measured=measured_response(rec, "u", "y"))
    with pytest.raises(UsageError, match="at least one"):
        report.plot_bode([])
    with pytest.raises(UsageError, match="str has no linear model"):
        report.plot_bode({"a": "model"})
    assert set(report.bode_data([result, result.model])) == {"mode (1)", "mode (2)"}


def test_the_figures_section_draws_bode_diagrams_with_their_numbers(tmp_path):
    assert "crossval" in SPRING
    path = write_spring(tmp_path, ("crossval:", "figures:\n  spring: {bode: true}\ncrossval:"))
    assert gbid("run", path) == 0
    folder = tmp_path / "results" / "spring" / "figures"
    made = {file.name for file in folder.iterdir()}
    names = [f"spring_{a}_on_{b}_bode" for a, b in (("run1", "run2"), ("run2", "run1"))]
    assert {f"{name}.{kind}" for name in names for kind in ("png", "pdf", "csv")} <= made
    lines = (folder / f"{names[0]}.csv").read_text().splitlines()
    assert lines[2].startswith("output,input,frequency_hz,magnitude,magnitude_std")
    assert gbid("run", path) == 0  # kept: the key in the text is found again
