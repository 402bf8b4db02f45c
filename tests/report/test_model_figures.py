"""Figures of a model with its uncertainty."""

import sys
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
from experiment_files import gbid, write_spring
from figure_cases import BlankPictures
from fit_cases import MODE, MODE_AT, levels, simulated
from matplotlib.figure import Figure

from gbid import load, report
from gbid.control import p_controller, sensitivities, sensitivity_zones
from gbid.control.loop.sensitivity import iso_zone
from gbid.core.errors import UsageError
from gbid.identify import bode, fit, measured_response
from gbid.lpv import load_model
from gbid.lpv.model import Domain
from gbid.recording import Recording, load_recording
from gbid.report.model_pictures import bode_data, campbell_data, orbit_data, pole_data, response_data
from gbid.structure import LinearModel, PiezoPair, evaluate
from gbid.validate import cross_validate


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
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["magnitude [output/input]", "phase [°]", "coherence [-]"]
    figure = axes[0, 0].figure
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["fit", "95 %", "truth", "measured"]
    assert len(axes[0, 0].collections) == 1  # a band for the fit, none for the plain model
    line = axes[0, 0].lines[0]
    data = bode_data(result, line.get_xdata())["mode"]
    np.testing.assert_array_equal(line.get_ydata(), data.magnitude[:, 0, 0])
    low, high = data.magnitude_band()
    vertices = axes[0, 0].collections[0].get_paths()[0].vertices[:, 1]
    assert vertices.min() == pytest.approx(low.min())
    assert vertices.max() == pytest.approx(high.max())


def test_two_fits_have_one_entry_for_their_bands_and_units_as_given(result):
    axes = report.plot_bode({"a": result, "b": result}, units={"u": "V", "y": "m"})
    figure = axes[0, 0].figure
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "95 %"]
    assert axes[0, 0].get_ylabel() == "magnitude [m/V]"
    step = report.plot_step({"a": result, "b": result})
    assert [text.get_text() for text in step[0, 0].figure.legends[0].get_texts()] == ["a", "b", "95 %"]
    assert step[0, 0].get_ylabel() == "step response\n[output/input]"
    assert report.plot_impulse(result, units={"u": "V", "y": "m"})[0, 0].get_ylabel() == "impulse response\n[m/(V s)]"


def test_a_bode_diagram_ends_at_half_the_rate_of_the_data_and_begins_below_the_modes(result):
    frequency = result.bode().frequency_hz
    assert frequency[-1] == 0.5 / result.sample_time
    assert frequency[0] > 0.01 * min(mode for mode, _ in result.model.modes())
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    A = turned @ np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 5.0], [0.0, 0.0, -1e3]]) @ turned.T
    servo = LinearModel(A, np.ones((3, 1)), np.ones((1, 3)), np.zeros((1, 1)))
    assert 0 < np.abs(servo.poles()).min() < 1e-9  # an integrator that is no zero: rounding
    assert bode(servo).frequency_hz[0] == pytest.approx(2 / (2 * np.pi) / 30)


def test_a_machine_with_one_speed_has_curves_in_place_of_surfaces_and_maps():
    model = load_model("theisen2016")
    model = replace(model, domain=Domain((4.0, 7.0), (4200.0, 4200.0)))
    (panel,) = report.plot_surfaces(report.surfaces_data(model, ["k_xx"], n=5))
    line = panel.lines[0]
    np.testing.assert_allclose(line.get_xdata(), np.linspace(4, 7, 5))
    expected = [1e-3 * model.key_parameters(bar, 4200.0)["k_xx"] for bar in line.get_xdata()]
    np.testing.assert_allclose(line.get_ydata(), expected)
    points = np.array([[5.0, 4200.0], [6.0, 4200.0]])
    data = report.damping_map_data(model, lambda *_: p_controller(0.5, 0.5), n=4, points=points, title="P")
    panel = report.plot_damping_map(data)
    curve, marks = panel.lines
    np.testing.assert_array_equal(curve.get_ydata(), data.damping[:, 0])
    np.testing.assert_array_equal(marks.get_xdata(), [5.0, 6.0])
    assert panel.get_title(loc="left") == "P, 4200 rpm"


def test_a_pair_without_effect_says_so_and_warns_of_nothing(recwarn):
    poles = {
        f"{name}_{axis}": value for axis in "xy" for name, value in {"p1": 500.0, "p2": 2000.0, "kappa": 1.0}.items()
    }
    axes = report.plot_bode(evaluate(PiezoPair(), poles))
    axes[0, 0].figure.canvas.draw()
    assert [text.get_text() for text in axes[0, 1].texts] == ["no effect"]
    assert not axes[0, 0].texts
    assert not [warning for warning in recwarn if "positive values" in str(warning.message)]


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
    with pytest.raises(UsageError, match=r"sources.*'model'.*; give LinearModel"):
        report.plot_bode({"a": "model"})
    assert set(bode_data([result, result.model])) == {"mode (1)", "mode (2)"}


def test_the_figures_section_draws_bode_diagrams_with_their_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr("gbid.report.write.Pictures", BlankPictures)
    path = write_spring(
        tmp_path,
        ("crossval:", "figures:\n  spring: {bode: true, formats: [pdf]}\ncrossval:"),
        ("focus: simulation", "recordings: run1, focus: simulation"),
        ("on: cyclic", "on: [run2]"),
    )
    assert gbid("run", path) == 0
    folder = tmp_path / "results" / "spring" / "figures"
    made = {file.name for file in folder.iterdir()}
    assert {f"spring_run1_on_run2_bode.{kind}" for kind in ("pdf", "csv")} <= made
    assert not any(name.endswith(".png") for name in made)  # one format unless more are asked for
    lines = [line for line in (folder / "spring_run1_on_run2_bode.csv").read_text().splitlines() if line[0] != "#"]
    assert lines[0].startswith("output,input,frequency_hz,magnitude,magnitude_std")
    assert gbid("run", path) == 0  # kept: the key in the text is found again


def test_a_bode_diagram_over_a_recording_with_a_gap(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("gbid.report.write.Pictures", BlankPictures)
    monkeypatch.setattr("gbid.report.pictures.plot_bode", lambda *_, **options: drawn.append(options) or Figure())
    path = write_spring(
        tmp_path,
        ("crossval:", "figures:\n  spring: {bode: true}\ncrossval:"),
        ("focus: simulation", "recordings: run1, focus: simulation"),
        ("on: cyclic", "on: [run2]"),
    )
    head, *rows = (tmp_path / "data" / "run2.csv").read_text().splitlines()
    column = head.split(",").index("position [um]")
    values = [row.split(",") for row in rows]
    before = values[:100], [[*row[:column], "", *row[column + 1 :]] for row in values[100:160]], values[160:]
    (tmp_path / "data" / "run2.csv").write_text(
        "\n".join([head, *(",".join(row) for part in before for row in part), ""])
    )
    assert gbid("run", path) == 0
    recording = load_recording(tmp_path / "results" / "spring" / "recordings" / "run2.h5")
    validation = cross_validate(load(tmp_path / "results" / "spring" / "fits" / "spring" / "run1.h5"), recording)
    assert np.isnan(validation.measured[100:160, 0]).all()  # not the straight line that the simulation starts from
    assert np.isfinite(validation.fit_percent).all()
    position = recording.plot()[1].lines[0].get_ydata()
    np.testing.assert_array_equal(np.isnan(position), np.isnan(recording.signals["y"][:, 0]))
    expected = measured_response(recording[160:], "u", "y")  # the longer of its two parts
    np.testing.assert_array_equal(drawn[0]["measured"].response, expected.response)
    assert drawn[0]["units"] == {"u": "V", "y": "um"}
    page = (tmp_path / "results" / "spring" / "report.html").read_text(encoding="utf-8")
    assert f"{np.nanstd(recording.signals['y']):.3g}" in page  # its rms, of the samples that there are


# ---- poles, responses, loops, rotation ----


def test_poles_with_ellipses_and_several_models(result):
    axes = report.plot_poles({"fit": result, "truth": evaluate(MODE, MODE_AT)})
    computed = pole_data(result)["mode"]
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    np.testing.assert_array_equal(crosses[0].get_xdata(), computed.poles.real)
    rings = [line for line in axes.lines if len(line.get_xdata()) == 60]
    assert len(rings) == 2  # one for each pole of the fit, none for the plain model
    at = np.column_stack(rings[0].get_data()) - [computed.poles[0].real, computed.poles[0].imag]
    assert np.abs(at[:, 0]).max() == pytest.approx(
        np.sqrt(-2 * np.log(0.05) * computed.pole_covariance[0, 0, 0]), rel=0.01
    )
    assert [text.get_text() for text in axes.figure.legends[0].get_texts()] == ["fit", "truth"]


def test_pictures_beside_each_other_have_a_legend_each(result):
    """Above the figure, the legend of the second covered that of the first."""
    models = {"fit": result, "truth": evaluate(MODE, MODE_AT)}
    axes = Figure().subplots(1, 2)
    report.plot_poles(models, axes[0])
    report.plot_step(models, axes[1])
    assert axes[0].figure.legends == []
    words = [[text.get_text() for text in panel.get_legend().get_texts()] for panel in axes]
    assert words == [["fit", "truth"], ["fit", "95 %", "truth"]]


@pytest.mark.parametrize(("plot", "kind"), [(report.plot_step, "step"), (report.plot_impulse, "impulse")])
def test_responses_with_bands(result, plot, kind):
    axes = plot({"fit": result, "truth": evaluate(MODE, MODE_AT)}, duration_s=3.0)
    data = response_data({"fit": result}, kind, 3.0)["fit"]
    assert axes.shape == (1, 1)
    np.testing.assert_array_equal(axes[0, 0].lines[1].get_ydata(), data.value[:, 0, 0])
    assert len(axes[0, 0].collections) == 1
    assert axes[0, 0].get_ylabel().startswith(f"{kind} response\n[output/")


def test_responses_of_several_models_share_their_time(result):
    slow = evaluate(MODE, {**MODE_AT, "w": 0.5})
    data = response_data([result, slow])
    assert len({curve.time_s[-1] for curve in data.values()}) == 1


def test_zones_of_a_loop_are_those_of_its_peaks():
    machine = load_model("theisen2016")
    plant = machine.plant_at(6, 0)
    loop = sensitivities(plant, p_controller(1.125, 0.99))
    data = sensitivity_zones(loop)
    f = np.geomspace(0.1, 5000, 20_000)
    dense = np.abs(np.diagonal(loop.response("output", f), axis1=1, axis2=2)).max(0)
    np.testing.assert_allclose(data.peak, dense, rtol=1e-3)
    assert (data.peak <= loop.peak().value + 1e-9).all()
    assert data.zone == ("A", "A")
    axes = report.plot_iso_zones(loop)
    assert [text.get_text() for text in axes.texts] == ["A", "B", "C", "D"]
    unstable = sensitivity_zones(sensitivities(plant, p_controller(-40.0, 0.99)))
    assert not sensitivities(plant, p_controller(-40.0, 0.99)).is_stable()
    assert (unstable.zone, np.isinf(unstable.peak).all()) == (("D", "D"), True)


@pytest.mark.parametrize(("peak", "zone"), [(1.0, "A"), (3.0, "A"), (3.01, "B"), (4.5, "C"), (5.1, "D"), (np.inf, "D")])
def test_limits_of_the_zones(peak, zone):
    assert iso_zone(peak) == zone


def test_campbell_diagram(rec, result):
    faster = fit(MODE, simulated(MODE, {**MODE_AT, "w": 7.0}, levels(600, hold=2), noise=0.3), focus="simulation")
    data = campbell_data({600.0: faster, 0.0: result, 300.0: evaluate(MODE, MODE_AT)})
    assert data.speed_rpm.tolist() == [0.0, 300.0, 600.0]
    assert data.frequency_hz[0, 0] == pytest.approx(result.model.modes()[0][0])
    assert data.std_hz[2, 0] == pytest.approx(faster.modes_std[0, 0], rel=1e-9)
    assert np.isnan(data.std_hz[1, 0])
    axes = report.plot_campbell(data, orders=(1.0,))
    line = next(line for line in axes.lines if len(line.get_xdata()) == 2)
    assert line.get_ydata()[-1] == 10.0  # 600 rpm
    with pytest.raises(UsageError, match="no model"):
        report.plot_campbell({})


def two_axes(speed_rpm: float, mixed: np.ndarray) -> LinearModel:
    """x stiffens with the speed, y does not; they cross at 2 000 rpm; states in another basis at each speed."""
    w = 2 * np.pi * np.array([50 + speed_rpm / 100, 70.0])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.diag(-(w**2)), np.diag(-2 * np.array([0.01, 0.02]) * w)]])
    back = np.linalg.inv(mixed)
    B, C = np.vstack([np.zeros((2, 2)), np.eye(2)]), np.eye(2, 4)
    return LinearModel(back @ A @ mixed, back @ B, C @ mixed, np.zeros((2, 2)))


@pytest.mark.parametrize("step", [1000.0, 1900.0, 4000.0])
def test_modes_of_a_campbell_diagram_are_followed_through_a_crossing(step):
    random = np.random.default_rng(4)
    speeds = np.arange(0.0, 4001.0, step)
    models = {float(v): two_axes(v, np.eye(4) + 0.3 * random.normal(size=(4, 4))) for v in speeds}
    data = campbell_data(models)
    np.testing.assert_allclose(data.frequency_hz, np.column_stack([50 + speeds / 100, np.full(len(speeds), 70.0)]))
    np.testing.assert_allclose(data.damping, np.tile([0.01, 0.02], (len(speeds), 1)), rtol=1e-6)


def test_a_mode_that_only_some_speeds_have_gets_a_column():
    whole = two_axes(0.0, np.eye(4))
    part = LinearModel(whole.A[1::2, 1::2], whole.B[1::2], whole.C[:, 1::2], whole.D)
    hz = campbell_data({0.0: part, 1.0: whole, 2.0: part}).frequency_hz
    np.testing.assert_allclose(hz, [[70, np.nan], [70, 50], [70, np.nan]])


def test_orbit_and_its_mean_over_the_revolutions():
    t = 1e-3 * np.arange(4000)
    phi = 2 * np.pi * 7.3 * t
    random = np.random.default_rng(0)
    p = 1e-6 * np.column_stack([3 * np.cos(phi), 2 * np.sin(phi)]) + 4e-5 + 2e-7 * random.normal(size=(4000, 2))
    rec = Recording({"p": p, "phi": np.mod(phi, 2 * np.pi)[:, None]}, 1e-3, units={"p": "m", "phi": "rad"})
    data = orbit_data(rec)
    assert np.abs(data.mean[:, 0]).max() == pytest.approx(3e-6, rel=0.05)
    assert np.abs(data.mean[:, 1]).max() == pytest.approx(2e-6, rel=0.05)
    axes = report.plot_orbit(rec)
    assert axes.get_xlabel() == "$p_{x}$ [µm]"
    still = Recording({"p": p}, 1e-3, units={"p": "m"})
    assert len(orbit_data(still, from_s=1.0, to_s=2.0).mean) == 0
    assert len(orbit_data(still, from_s=1.0, to_s=2.0).xy) == 1000
    with pytest.raises(UsageError, match="no samples"):
        orbit_data(still, from_s=9.0)
    with pytest.raises(UsageError, match="two channels"):
        orbit_data(rec, "phi")


def test_a_picture_without_axes_belongs_to_pyplot_where_that_is_used(monkeypatch):
    model = load_model("theisen2016").at(6, 0)
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "matplotlib.pyplot", raising=False)
        report.plot_poles(model)
        assert "matplotlib.pyplot" not in sys.modules
    from matplotlib import pyplot

    pyplot.close("all")
    drawn = report.plot_poles(model)
    assert pyplot.gcf() is drawn.figure
    report.plot_poles(model, drawn)
    worker = Thread(target=report.plot_poles, args=(model,))
    worker.start()
    worker.join()
    with pytest.raises(UsageError):
        report.plot_poles(())
    assert len(pyplot.get_fignums()) == 1
    pyplot.close("all")
