"""Figures of the report: every one is drawn, its words are readable and carry units, its numbers are the model's."""

from __future__ import annotations

import inspect
import io
import re
from itertools import combinations

import matplotlib as mpl
import numpy as np
import pytest
from figure_cases import FIGURES, grid_points, loop, machine, piezo_staircases
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from gbid import report
from gbid.control import p_controller, sensitivity_data
from gbid.core.errors import UsageError
from gbid.report.canvas import SERIES, figure_of
from gbid.report.impact_pictures import ImpactCurves
from gbid.report.loop_pictures import ParetoCurves

DIAGRAMS = ("differential_pairing", "identification_flow", "rotor_bearing_model", "closed_loop")
_UNIT = re.compile(r"\[[^\]]+\]")
_COUNTS = ("pairs", "recording", "magnitude", "coherence", "step response", "impulse response")  # or any unit


@pytest.fixture(scope="module")
def drawn():
    """Each figure, drawn once."""
    made = {}

    def give(name):
        if name not in made:
            made[name] = figure_of(FIGURES[name]())
            FigureCanvasAgg(made[name]).draw()
        return made[name]

    return give


def ticks_in_view(figure):
    """Tick labels that matplotlib keeps but does not draw, because their ticks are out of view."""
    hidden = set()
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis, *([ax.zaxis] if hasattr(ax, "zaxis") else [])):
            low, high = sorted(axis.get_view_interval())
            margin = 1e-9 * (high - low if axis.get_scale() == "linear" else low)
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                if not low - margin <= tick.get_loc() <= high + margin:
                    hidden |= {id(tick.label1), id(tick.label2)}
    return hidden


@pytest.mark.parametrize("name", FIGURES)
def test_words_lie_inside_the_figure_and_apart(name, drawn):
    figure = drawn(name)
    hidden = ticks_in_view(figure)
    edge = figure.bbox
    boxes = []
    for text in figure.findobj(lambda artist: isinstance(artist, Text)):
        if not text.get_visible() or not text.get_text().strip() or id(text) in hidden:
            continue
        box = text.get_window_extent()
        if box.width == 0:
            continue
        inside = edge.x0 - 1 <= box.x0 and box.x1 <= edge.x1 + 1 and edge.y0 - 1 <= box.y0 and box.y1 <= edge.y1 + 1
        assert inside, f"{text.get_text()!r} is cut"
        boxes.append((text.get_text(), box.shrunk(0.9, 0.7)))
    if any(hasattr(ax, "get_zlim") for ax in figure.axes):
        return  # ticks of a three-dimensional panel stand in perspective
    for (one, a), (other, b) in combinations(boxes, 2):
        assert not a.overlaps(b), f"{one!r} over {other!r}"


@pytest.mark.parametrize("name", [name for name in FIGURES if name not in DIAGRAMS])
def test_labels_carry_units(name, drawn):
    for ax in drawn(name).axes:
        labels = [ax.get_xlabel(), ax.get_ylabel()]
        if hasattr(ax, "get_zlim"):
            labels.append(ax.get_title())
        for label in labels:
            assert not label or _UNIT.search(label) or label in _COUNTS, label


@pytest.mark.parametrize("name", DIAGRAMS)
def test_diagrams_are_vectors_and_keep_their_words_in_blocks(name, drawn):
    figure = drawn(name)
    out = io.BytesIO()
    figure.savefig(out, format="pdf")
    assert b"/Subtype /Image" not in out.getvalue()
    assert len(out.getvalue()) < 100_000


@pytest.mark.parametrize("name", DIAGRAMS)
def test_diagrams_draw_into_axes_of_ones_own_and_leave_settings_alone(name):
    before = dict(mpl.rcParams)
    figure = Figure()
    ax = figure.subplots()
    assert FIGURES[name](ax) is ax
    assert ax.texts
    assert dict(mpl.rcParams) == before


def test_too_few_axes_are_refused():
    data = report.over_pressure_data(machine(), "frequency")
    with pytest.raises(UsageError, match="1 axes for 2 panels; give one for each"):
        report.plot_over_pressure(data, [Figure().subplots()])
    figure = Figure()
    axes = list(figure.subplots(1, 2))
    assert report.plot_over_pressure(data, axes).tolist() == axes
    with pytest.raises(UsageError, match="projection='3d'"):
        report.plot_surfaces(report.surfaces_data(machine(), ("k_xx",)), [Figure().subplots()])
    parts = Figure().subfigures(1, 2)
    one = parts[0].subplots()
    assert report.plot_pareto(ParetoCurves({"P": [(1.5, 0.2)]}), one) is one
    assert figure_of(one) is parts[0].figure


@pytest.mark.parametrize("name", [name for name in dir(report) if name.startswith("plot_")])
def test_picture_functions_have_one_signature(name):
    signature = inspect.signature(getattr(report, name))
    order = list(signature.parameters)
    assert signature.parameters["ax"].default is None
    assert order.index("ax") <= 1
    assert all(signature.parameters[other].kind is inspect.Parameter.KEYWORD_ONLY for other in order[2:])
    assert signature.return_annotation in ("Axes", "npt.NDArray[np.object_]")


def test_series_are_told_apart_in_grey():
    assert len({style["marker"] for style in SERIES}) == len(SERIES)
    assert len({str(style["linestyle"]) for style in SERIES}) == len(SERIES)
    luminance = [float(np.dot((0.2126, 0.7152, 0.0722), to_rgb(style["color"]))) for style in SERIES]
    assert all(value < 0.75 for value in luminance)  # seen on white paper


# --- the numbers


def test_surface_values_and_stems_are_the_models():
    points = np.array([[4.0, 4000.0], [7.0, 0.0]])
    (surface,) = report.surfaces_data(machine(), ("b_xy",), points=points, estimates={"b_xy": [1.0, 2.0]}, n=5)
    c = machine().coefficients["b_xy"]
    P, W = surface.pressure_bar[3], surface.speed_rpm[1]
    expected = c[0] + c[1] * P + c[2] * W + c[3] * W * P + c[4] * P**2 + c[5] * W**2
    assert surface.values[3, 1] == pytest.approx(expected, rel=1e-12)
    P, W = points[0]
    assert surface.at_points[0] == pytest.approx(
        c[0] + c[1] * P + c[2] * W + c[3] * W * P + c[4] * P**2 + c[5] * W**2, rel=1e-12
    )
    assert surface.unit == "N/(kg m)"
    with pytest.raises(UsageError, match="no key parameter 'k_zz'"):
        report.surfaces_data(machine(), ("k_zz",))
    with pytest.raises(UsageError, match="b_xy: 1 estimates for 2 points"):
        report.surfaces_data(machine(), ("b_xy",), points=points, estimates={"b_xy": [1.0]})


def test_curves_over_pressure_are_the_papers_at_6_bar():
    """Table 3: 126.6 and 132.1 Hz, 0.035 and 0.029 at 6 bar, 0 rpm; delays by hand from the coefficients."""
    for what, expected in (("frequency", (126.590, 132.110)), ("damping", (0.03523, 0.02914))):
        for panel, value in zip(report.over_pressure_data(machine(), what, speeds_rpm=(0.0,)), expected, strict=True):
            k = int(np.argmin(np.abs(panel.pressure_bar - 6.0)))
            assert panel.pressure_bar[k] == pytest.approx(6.0)
            assert panel.values[0, k] == pytest.approx(value, rel=1e-4)
    c = machine().coefficients["tau_y"]
    panel = report.over_pressure_data(machine(), "delay", speeds_rpm=(6000.0,))[1]
    expected = c[0] + c[1] * 3 + c[2] * 6000 + c[3] * 18000 + c[4] * 9 + c[5] * 3.6e7
    assert panel.values[0, 0] == pytest.approx(expected / 2e-4, rel=1e-10)
    gains = report.over_pressure_data(machine(), "gain", speeds_rpm=(4000.0,))
    model = machine().at(3.0, 4000.0)
    np.testing.assert_allclose(
        [p.values[0, 0] for p in gains], model.frequency_response([0.0])[0].real.ravel(), rtol=1e-9
    )


def test_estimates_are_drawn_at_their_pressures(drawn):
    ax = drawn("modes").axes[0]
    marks = [line for line in ax.get_lines() if line.get_linestyle() == "None"]
    assert [line.get_label() for line in marks] == [f"estimates, {rpm} rpm" for rpm in (0, 4000, 6000)]
    for line in marks:
        np.testing.assert_array_equal(line.get_xdata(), [3, 4, 5, 6, 7])
    assert len(grid_points()) == sum(len(line.get_xdata()) for line in marks)


def test_magnitudes_are_drawn_by_their_definition():
    """In decibels, a panel for each pair: S_o = (I - G K)^-1 by hand, at 126.6 Hz."""
    plant, controller = loop()
    frequency = np.array([10.0, 126.6, 400.0])
    G, K = plant.frequency_response(frequency), controller.frequency_response(frequency)
    S = np.linalg.inv(np.eye(2) - G @ K)
    data = sensitivity_data(plant, controller, frequency)
    for curves, responses in (("sensitivity", (S, K @ S)), ("bode", (G, S @ G))):
        axes = report.plot_magnitudes(data, curves=curves)
        for panel, (i, j) in zip(axes.ravel(), ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
            lines = panel.get_lines()[1:]  # after the line at 0 dB
            for line, response in zip(lines, responses, strict=True):
                np.testing.assert_allclose(line.get_ydata(), 20 * np.log10(np.abs(response[:, i, j])), rtol=1e-6)


def test_damping_map_and_root_locus_are_the_loops():
    controller = p_controller(1.125, 0.99)
    data = report.damping_map_data(machine(), controller, n=5)
    i, j = 3, 0
    assert (data.pressure_bar[i], data.speed_rpm[j]) == (6.0, 0.0)
    assert data.damping[i, j] == pytest.approx(0.3184, abs=1e-4)  # the paper's 0.318
    unstable = report.damping_map_data(machine(), p_controller(6.0, 6.0), n=2)
    assert (unstable.damping < 0).all()
    report.plot_damping_map(unstable)
    plant = loop()[0]
    locus = report.root_locus_data(plant, lambda f: p_controller(f * 1.125, f * 0.99), [0.0, 1.0])
    assert locus.poles.shape == (2, plant.n_states + 2)
    computed = locus.poles[1][np.abs(locus.poles[1].imag) > 1]
    damping = sorted(-computed.real / np.abs(computed))
    assert damping[0] == pytest.approx(0.31841, abs=1e-5)
    open_loop = np.sort_complex(np.append(plant.poles(), [-2000 * np.pi] * 2))
    np.testing.assert_allclose(np.sort_complex(locus.poles[0]), open_loop, rtol=1e-6)


def test_piezo_steps_and_plateaus():
    for staircase in piezo_staircases():
        curve = staircase.curve
        panel, _ = report.plot_piezo_hysteresis([staircase])
        way, rising, falling = panel.get_lines()
        np.testing.assert_allclose(way.get_ydata(), 1e6 * curve.position)
        assert [len(marked.get_xdata()) for marked in (rising, falling)] == [11, 10]
        over_steps, over_time = report.plot_piezo_staircase([staircase])
        steps = np.array([line.get_ydata() for line in over_steps.get_lines()])
        np.testing.assert_allclose(steps, 1e6 * np.where(curve.step > 0, curve.responses, -curve.responses).T)
        assert (steps[:, -1] > 0).all()  # falling steps are mirrored
        assert [line.get_linestyle() == "--" for line in over_steps.get_lines()] == curve.saturated.tolist()
        assert over_steps.get_xscale() == "log"  # rise and creep
        np.testing.assert_array_equal(over_time.get_lines()[0].get_xdata(), staircase.time)


def test_impact_curves_must_fit_their_time():
    with pytest.raises(UsageError, match=r"curve 'open' has shape \(3,\), the time \(4,\)"):
        report.plot_impact(ImpactCurves(np.arange(4.0), {"open": np.zeros(3)}))
    (ax,) = report.plot_impact(ImpactCurves(np.arange(4.0), {"open": np.ones(4)}, axis="y"))
    assert ax.get_ylabel() == "$p_y$ [µm]"
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), 1e6)


def test_nominal_and_outliers_are_marked(drawn):
    ax = drawn("actuators").axes[2]
    by_label = {line.get_label(): line for line in ax.get_lines()}
    assert list(by_label["nominal, no. 39"].get_xdata()) == [39]
    assert len(by_label["estimates"].get_xdata()) + len(by_label["outliers"].get_xdata()) == 86
