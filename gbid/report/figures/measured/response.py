"""Measured and simulated outputs, with the inputs below (paper, Fig. 7)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from gbid.arrays import BoolArray, FloatArray
from gbid.errors import DataError, UsageError
from gbid.experiment.stages.crossval.pairing import validate_pair
from gbid.experiment.stages.fit.plan import fit_models, recordings_of
from gbid.experiment.stages.fit.stage import fit_path
from gbid.report.figures.canvas import ink, panels, styled
from gbid.report.figures.named import NamedFigure
from gbid.report.figures.save import plain_label, symbol
from gbid.report.reader import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gbid.validate import Validation

# A thin dark dashed line on a thick light line: they differ also in grey.
_MEASURED: dict[str, Any] = {"color": "#9e9e9e", "linewidth": 2.6, "linestyle": "-"}
_SIMULATED: dict[str, Any] = {"color": "#0072b2", "linewidth": 1.3, "linestyle": (0, (4, 1.5))}
_INPUTS: tuple[dict[str, Any], ...] = (
    {"linestyle": "-"},
    {"color": "#d55e00", "linestyle": (0, (5, 1.5))},
    {"color": "#009e73", "linestyle": (0, (1, 1))},
    {"color": "#cc79a7", "linestyle": "-."},
)
_PANEL_INCHES, _FRAME_INCHES = 1.35, 0.95


def response_figure(
    validation: Validation, *, from_s: float | None = None, to_s: float | None = None, title: str | None = None
) -> Figure:
    """Draw measured and simulated outputs, with the inputs below (Fig. 7).

    Parameters
    ----------
    validation : Validation
        Result of `gbid.cross_validate`.
    from_s, to_s : float, optional
        Start and end of the part shown [s]; the whole recording when left out.
    title : str, optional
        Title of the figure; operating point and names of the recordings when left out.

    Returns
    -------
    matplotlib.figure.Figure
        Figure with a panel for each output and one for the inputs.

    Raises
    ------
    UsageError
        When the part shown has fewer than two samples.
    """
    axes = plot_response(validation, from_s=from_s, to_s=to_s)
    figure: Figure = axes[0].figure
    figure.suptitle(_title(validation) if title is None else title, fontsize=10)
    figure.align_ylabels(list(axes))
    return figure


@styled
def plot_response(
    validation: Validation,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
) -> npt.NDArray[np.object_]:
    """Draw measured and simulated outputs, with the inputs below.

    Parameters
    ----------
    validation : Validation
        Result of `gbid.cross_validate`.
    ax : array of matplotlib Axes, optional
        Axes for each output. Further axes, if given, show the inputs. A new figure when left out.
    from_s, to_s : float, optional
        Start and end of the part shown [s]; the whole recording when left out.

    Returns
    -------
    (n_panels,) array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.

    Raises
    ------
    UsageError
        When the part shown has fewer than two samples, or when there are too few axes.
    """
    shown = _part(validation.time, from_s, to_s)
    time = validation.time[shown]
    n_outputs = len(validation.output_names)
    if ax is None:
        n_panels = n_outputs + (1 if validation.input_names else 0)
        size = (mpl.rcParams["figure.figsize"][0], _FRAME_INCHES + _PANEL_INCHES * n_panels)
        _, axes = panels(None, n_panels, 1, size=size, sharex=True)
    else:
        axes = list(np.ravel(np.array(ax, dtype=object)))
    if len(axes) < n_outputs:
        raise UsageError(f"{len(axes)} axes for {n_outputs} outputs; give one for each, and one for the inputs")
    for i, (name, unit) in enumerate(zip(validation.output_names, validation.output_units, strict=True)):
        scale, label = _shown_unit(unit)
        axes[i].plot(time, scale * validation.measured[shown, i], label="measured", **_MEASURED)
        axes[i].plot(time, scale * validation.simulated[shown, i], label="simulated", **_SIMULATED)
        axes[i].set_ylabel(f"{symbol(name)} [{label}]")
        axes[i].set_title(f"fit {validation.fit_percent[i]:.1f} %", loc="right", pad=3)
    if len(axes) > n_outputs and validation.input_names:
        _plot_inputs(validation, axes[n_outputs], shown)
    for ax, letter in zip(axes, "abcdefgh", strict=False):
        ax.set_title(f"{letter})", loc="left", pad=3)
    _legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(time[0], time[-1])
    return np.array(axes, dtype=object)


def _plot_inputs(validation: Validation, ax: Axes, shown: BoolArray) -> None:
    scale, label = _shown_unit(validation.input_units[0])
    for i, name in enumerate(validation.input_names):
        style = {"color": ink(), **_INPUTS[i % len(_INPUTS)]}
        ax.plot(validation.time[shown], scale * validation.inputs[shown, i], label=symbol(name), **style)
    if len(validation.input_names) > 1:
        _legend_above(ax)
    ax.set_ylabel(f"{', '.join(symbol(name) for name in validation.input_names)} [{label}]")


def _legend_above(ax: Axes) -> None:
    """Draw the legend above the panel, between its two titles, so that it covers no curve."""
    ax.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, borderaxespad=0.0, borderpad=0.2, handlelength=2.6
    )


def _part(time: FloatArray, from_s: float | None, to_s: float | None) -> BoolArray:
    begin, end = time[0] if from_s is None else from_s, time[-1] if to_s is None else to_s
    step = (time[-1] - time[0]) / max(len(time) - 1, 1)
    shown = (time >= begin - 1e-6 * step) & (time <= end + 1e-6 * step)
    if shown.sum() < 2:
        raise UsageError(
            f"from {begin:g} s to {end:g} s the recording has {shown.sum()} samples; "
            f"choose a part of its {time[-1]:g} s"
        )
    return np.asarray(shown)


def _shown_unit(unit: str) -> tuple[float, str]:
    """Return factor and label of a unit: micrometres for positions, other units unchanged."""
    return (1e6, "µm") if unit == "m" else (1.0, plain_label(unit or "-"))


def _title(validation: Validation) -> str:
    units = {"pressure_bar": "bar", "speed_rpm": "rpm"}
    point = ", ".join(
        f"{validation.conditions[key]:g} {unit}" for key, unit in units.items() if key in validation.conditions
    )
    model = validation.fitted_to[0] if len(validation.fitted_to) == 1 else f"{len(validation.fitted_to)} recordings"
    on = f"model of {plain_label(model)} on {plain_label(validation.recording)}"
    if validation.fitted_to == (validation.recording,):
        on = f"model of {model} on its own recording"
    return f"{point}: {on}" if point else on


_ZOOM = (1.2, 1.4)  # part of the recording that Fig. 7 shows [s]


def _shown(results: Results) -> Validation:
    """Return the validation of a bearing model on its own recording, at the paper's operating point or the first."""
    name = results.fit_with("rotor_bearing")
    there = [model for model in fit_models(results.experiment, name) if fit_path(results.job, name, model).is_file()]
    if not there:
        raise DataError(f"no model of fit {name!r} is there; run `gbid fit` or `gbid run`")
    model = next((m for m in there if m.startswith("p5_n6000_")), there[0])
    return validate_pair(results.job, name, model, recordings_of(results.experiment, name, model)[0])


def _zoomed(validation: Validation) -> Figure:
    from_s, to_s = _ZOOM if validation.time[-1] >= _ZOOM[1] else (None, None)
    return response_figure(validation, from_s=from_s, to_s=to_s)


FIGURES = (NamedFigure("fig07_identification", _shown, _zoomed),)
