from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

import gbid
from gbid.core.errors import UsageError
from gbid.core.tables import engineering, exponent_of
from gbid.report import plot_residuals, plot_response, save_figure
from gbid.report.canvas import STYLE
from gbid.report.sections import trace
from gbid.validate import ResidualTest, Validation


@pytest.fixture
def validation():
    time = 2e-4 * np.arange(10000)
    measured = 1e-6 * np.column_stack([np.sin(700 * time), 2 * np.cos(700 * time)])
    return Validation(
        recording="two",
        fitted_to=("one",),
        fit_percent=np.array([91.23, 88.0]),
        infinity_norm=np.array([1e-7, 2e-7]),
        measured=measured,
        simulated=0.9 * measured,
        inputs=5e-6 * np.sign(np.column_stack([np.sin(20 * time), np.cos(20 * time)])),
        time=time,
        initial_state=np.zeros(4),
        input_names=("u_x", "u_y"),
        output_names=("p_x", "p_y"),
        input_units=("m", "m"),
        output_units=("m", "m"),
        conditions={"pressure_bar": 5.0, "speed_rpm": 6000.0},
    )


def test_figure_shows_what_it_should(validation):
    figure = plot_response(validation, from_s=1.2, to_s=1.4)[0].figure
    assert figure.get_suptitle() == "5 bar, 6000 rpm: model of one on two"
    first, second, third = figure.axes
    assert [ax.get_ylabel() for ax in figure.axes] == ["$p_{x}$ [µm]", "$p_{y}$ [µm]", "$u_{x}$, $u_{y}$ [µm]"]
    assert third.get_xlabel() == "time [s]"
    assert second.get_title(loc="right") == "fit 88.0 %"
    measured, simulated = first.get_lines()
    assert [line.get_label() for line in (measured, simulated)] == ["measured", "simulated"]
    time = measured.get_xdata()
    assert (time[0], time[-1]) == (pytest.approx(1.2), pytest.approx(1.4))
    np.testing.assert_allclose(measured.get_ydata(), np.sin(700 * time), atol=1e-9)
    np.testing.assert_allclose(simulated.get_ydata(), 0.9 * np.sin(700 * time), atol=1e-9)
    for line in third.get_lines():
        np.testing.assert_allclose(np.abs(line.get_ydata()), 5.0)
    styles = [line.get_linestyle() for line in (measured, simulated)]
    assert styles[0] != styles[1]  # told apart in grey


def test_legends_cover_no_curve(validation):
    figure = plot_response(validation)[0].figure
    figure.draw_without_rendering()
    legends = [(ax, ax.get_legend()) for ax in figure.axes if ax.get_legend()]
    assert len(legends) == 2
    for ax, legend in legends:
        assert legend.get_window_extent().y0 >= ax.get_window_extent().y1 - 1
        titles = [t.get_window_extent() for t in (ax._left_title, ax._right_title) if t.get_text()]
        assert not any(legend.get_window_extent().overlaps(box) for box in titles)


def test_other_units_and_one_input(validation):
    other = replace(
        validation,
        inputs=validation.inputs[:, :1],
        input_names=("drive",),
        input_units=("",),
        output_units=("V", "m"),
        output_names=("y", "p_long_name"),
        fitted_to=("two",),
        conditions={},
    )
    figure = plot_response(other)[0].figure
    assert [ax.get_ylabel() for ax in figure.axes] == ["$y$ [V]", "p_long_name [µm]", "drive [-]"]
    assert figure.get_suptitle() == "model of two on its own recording"
    assert figure.axes[2].get_legend() is None
    assert np.abs(figure.axes[0].get_lines()[0].get_ydata()).max() == pytest.approx(1e-6, rel=1e-3)


def test_many_inputs_have_panels_of_one_unit_and_at_most_four(validation):
    names = (*(f"f_{k}" for k in range(6)), "i")
    inputs = np.hstack([validation.inputs[:, :1]] * 7)
    many = replace(validation, inputs=inputs, input_names=names, input_units=(*("N",) * 6, "A"))
    figure = plot_response(many)[0].figure
    below = figure.axes[len(validation.output_names) :]
    assert [len(ax.get_lines()) for ax in below] == [4, 2, 1]
    assert [ax.get_ylabel() for ax in below] == ["inputs [N]", "$f_{4}$, $f_{5}$ [N]", "$i$ [A]"]
    for ax in below:
        styles = {(line.get_color(), str(line.get_linestyle())) for line in ax.get_lines()}
        assert len(styles) == len(ax.get_lines())


def test_a_part_outside_is_refused(validation):
    with pytest.raises(UsageError, match="has 0 samples"):
        plot_response(validation, from_s=3.0, to_s=4.0)
    with pytest.raises(UsageError, match="1 axes for 2 panels"):
        plot_response(validation, [Figure().subplots()])


@pytest.mark.parametrize(("kind", "begins"), [("png", b"\x89PNG"), ("pdf", b"%PDF-"), ("svg", b"<?xml")])
def test_files_are_the_same_each_time(tmp_path, kind, begins):
    key = "content_key: " + 64 * "a"
    for name in ("a", "b"):
        figure = Figure(figsize=(2, 2))
        figure.subplots().plot([0.0, 1.0], label="$p_x$")
        figure.legend()
        save_figure(figure, tmp_path / f"{name}.{kind}", note=key)
    one, two = ((tmp_path / f"{name}.{kind}").read_bytes() for name in ("a", "b"))
    assert one == two
    assert one.startswith(begins)
    assert key.encode() in one


@pytest.mark.parametrize("paper", ["auto", "black"])
def test_a_figure_is_drawn_once_and_looks_as_that_of_matplotlib(tmp_path, monkeypatch, paper):
    monkeypatch.setitem(mpl.rcParams, "savefig.facecolor", paper)
    figure = Figure(figsize=(2, 2), layout="constrained")
    figure.subplots().set(xlabel="time [s]", title="a figure")
    draw, drawn = Figure.draw, []
    monkeypatch.setattr(Figure, "draw", lambda *arguments: [drawn.append(arguments), draw(*arguments)])
    before = figure.canvas, figure.dpi, figure.get_facecolor(), figure.get_layout_engine()
    save_figure(figure, tmp_path / "a.png")
    assert len(drawn) == 1
    assert (figure.canvas, figure.dpi, figure.get_facecolor(), figure.get_layout_engine()) == before
    with mpl.rc_context(fname=STYLE):
        figure.savefig(tmp_path / "b.png", metadata={"Comment": ""})
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_no_global_state(validation):
    before = dict(mpl.rcParams)
    plot_response(validation)
    assert dict(mpl.rcParams) == before


@pytest.fixture
def residual_test():
    """White residuals, but for one output that follows an input two samples late."""
    random, lags, cross = np.random.default_rng(3), np.arange(21), np.arange(-20, 21)
    crosscorrelation = 0.01 * random.standard_normal((2, 2, 41))
    crosscorrelation[1, 0, 22] = 0.4
    ones, two = np.ones(2), np.ones((2, 2))
    return ResidualTest(
        recording="two", lags=lags, time=1e-3 * lags, autocorrelation=0.01 * random.standard_normal((2, 21)), band=0.04,
        cross_lags=cross, crosscorrelation=crosscorrelation, cross_band=0.05 * two, p_white=0.3 * ones,
        p_independent=np.array([[0.5, 0.6], [1e-9, 0.7]]), outside=0 * two, infinity_norm=ones, rms=ones,
        fit_percent=ones, input_names=("u_x", "u_y"), output_names=("p_x", "p_y"),
    )  # fmt: skip


def test_residual_panels_are_the_correlations(residual_test):
    axes = plot_residuals(residual_test)
    for j, panels in enumerate(axes):
        correlations = [residual_test.autocorrelation[j, 1:], *residual_test.crosscorrelation[j]]  # at 0 it is one
        for i, (panel, expected) in enumerate(zip(panels, correlations, strict=True)):
            inside, outside = (bars.get_segments() for bars in panel.collections)
            bars = sorted([*inside, *outside], key=lambda bar: bar[0, 0])
            np.testing.assert_array_equal([bar[0, 0] for bar in bars], residual_test.cross_lags[-len(bars) :])
            np.testing.assert_array_equal([bar[1, 1] for bar in bars], expected)
            assert [bar[0, 0] for bar in outside] == ([2] if (j, i) == (1, 1) else [])


def test_residual_figure_shows_what_it_should(residual_test):
    axes = plot_residuals(residual_test)
    figure = axes[0, 0].figure
    assert figure.get_suptitle() == "residuals on two"
    assert [ax.get_title() for ax in axes[0]] == [
        "autocorrelation",
        "correlation with $u_{x}$",
        "correlation with $u_{y}$",
    ]
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["$p_{x}$", "$p_{y}$"]
    assert {ax.get_xlabel() for ax in axes[1]} == {"lag [samples]"}
    said = [[ax.texts[0].get_text().split(",")[0] for ax in row] for row in axes]
    assert said[0] == ["white", "independent", "independent"]
    assert said[1][1:] == ["follow", "independent"]
    figure.draw_without_rendering()
    for ax in axes.flat:  # what is said lies within its panel
        box, inside = ax.texts[0].get_window_extent(), ax.get_window_extent()
        assert inside.x0 <= box.x0
        assert box.x1 <= inside.x1
        assert box.y1 <= inside.y1
    above = axes[0, 1].child_axes[0]
    assert above.get_xlabel() == "lag [ms]"
    lag, time = axes[0, 1].get_xlim()[1], above.get_xlim()[1]
    assert time == pytest.approx(1e3 * 1e-3 * lag)
    with pytest.raises(UsageError, match="1 axes for 6 panels"):
        plot_residuals(residual_test, [[Figure().subplots()]])


@pytest.mark.parametrize("n_inputs", [0, 1, 2])
def test_the_words_below_a_residual_figure_fit_into_it(residual_test, n_inputs):
    by_input = ("crosscorrelation", "cross_band", "p_independent")
    fewer = {name: getattr(residual_test, name)[:, :n_inputs] for name in by_input}
    test = replace(residual_test, input_names=residual_test.input_names[:n_inputs], **fewer)
    figure = plot_residuals(test)[0, 0].figure
    figure.draw_without_rendering()
    box = next(text for text in figure.texts if "shaded" in text.get_text()).get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.x1


@pytest.mark.parametrize(("size", "unit"), [(9e-6, "µm"), (9e-3, "µm"), (4e-2, "mm")])
def test_curves_of_long_ways_are_in_millimetres(validation, size, unit):
    measured = validation.measured.copy()
    measured[:, 0] *= size / np.abs(measured[:, 0]).max()
    measured[5, 0] = np.nan
    axes = plot_response(replace(validation, measured=measured))
    assert axes[0].get_ylabel().endswith(f"[{unit}]")
    assert np.nanmax(np.abs(axes[0].lines[0].get_ydata())) == pytest.approx(
        size * {"µm": 1e6, "mm": 1e3}[unit], rel=0.05
    )
    output = trace(replace(validation, measured=measured))["outputs"][0]
    assert output["unit"] == unit


def test_engineering_numbers_read_back():
    for exponent in range(-12, 13):
        for mantissa in (1.0, 2.34567, 9.9999, -5.5):
            value = mantissa * 10.0**exponent
            assert float(engineering(value)) == pytest.approx(value, rel=1e-4)
            assert exponent_of(value) % 3 == 0
    texts = [engineering(value) for value in (999999.9, 50.3, 0.0, None, float("nan"))]
    assert texts == ["1.0000e6", "50.300", "0", "-", "-"]


def test_eight_axes_have_wide_figures_and_eight_styles():
    from gbid.report import plot_step
    from gbid.report.canvas import series

    model = gbid.LinearModel(-np.eye(8), np.eye(8), np.eye(8), np.zeros((8, 8)))
    figure = plot_step(model)[0, 0].figure
    assert figure.get_size_inches()[0] > 8 * 2
    looks = [series(k, marker=None) for k in range(8)]
    assert all(one != other for i, one in enumerate(looks) for other in looks[:i])
