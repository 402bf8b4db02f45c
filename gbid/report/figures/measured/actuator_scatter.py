"""Gains and poles of the actuators over the recordings (paper, Fig. 8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import BoolArray, FloatArray
from gbid.brief import Brief
from gbid.report.figures.canvas import (
    BLUE,
    GREY,
    RED,
    TWO_COLUMNS,
    ink,
    legend_above,
    letter,
    panels,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.validate import NominalActuator

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ROWS = (("kappa", "\\kappa_{a,%s}", "m/m", 1.0), ("p1", "p_{1,%s}", "rad/s", 1.0), ("p2", "p_{2,%s}", "krad/s", 1e-3))


@dataclass(frozen=True, eq=False)
class ActuatorParameters(Brief):
    """Parameters of the actuators for each recording.

    Attributes
    ----------
    values : dict of str to (n,) array
        Values by name (``kappa_x``, ``p1_x``, ``p2_x``, ``kappa_y``, ...), in SI units.
    outliers : dict of str to (n,) boolean array
        Masks of the outliers by name; a missing name has none.
    nominal : int, optional
        Index of the recording of the nominal model.
    """

    values: Mapping[str, FloatArray]
    outliers: Mapping[str, BoolArray]
    nominal: int | None = None


@styled
def plot_actuator_parameters(data: ActuatorParameters, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw gains and poles of the actuators over the recordings, with marks for outliers and nominal model (Fig. 8).

    Parameters
    ----------
    data : ActuatorParameters
        Data of the figure.
    ax : sequence of six matplotlib Axes, optional
        Axes by rows: gain, slow pole, fast pole; columns: x, y. A new figure when left out.

    Returns
    -------
    (3, 2) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 3, 2, size=(TWO_COLUMNS, 5.0), sharex=True)
    for i, (name, symbol, unit, scale) in enumerate(_ROWS):
        for j, axis in enumerate("xy"):
            panel, values = axes[2 * i + j], scale * np.asarray(data.values[f"{name}_{axis}"], float)
            number = np.arange(1, len(values) + 1)
            out = np.asarray(data.outliers.get(f"{name}_{axis}", np.zeros(len(values), bool)))
            panel.plot(number[~out], values[~out], "o", color=BLUE, markersize=3, label="estimates")
            panel.plot(number[out], values[out], "x", color=RED, markersize=5, markeredgewidth=1.2, label="outliers")
            if data.nominal is not None:
                k = data.nominal
                panel.axhline(values[k], color=GREY, linewidth=0.9, linestyle=(0, (5, 1.5)), zorder=0)
                ring: dict[str, Any] = {"markersize": 8, "markerfacecolor": "none", "markeredgewidth": 1.1}
                panel.plot(number[k], values[k], "o", color=ink(), label=f"nominal, no. {k + 1}", **ring)
            panel.set_ylabel(f"${symbol % axis}$ [{unit}]")
            panel.ticklabel_format(axis="y", useOffset=False)
    for panel in axes[4:6]:
        panel.set_xlabel("recording")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes[0])
    return np.array(axes[:6], dtype=object).reshape(3, 2)


def nominal_data(nominal: NominalActuator) -> ActuatorParameters:
    """Return the parameters of the actuators for `plot_actuator_parameters` (Fig. 8).

    Parameters
    ----------
    nominal : NominalActuator
        Choice of the nominal actuators, with the values of all recordings.

    Returns
    -------
    ActuatorParameters
        Parameters of all recordings.
    """
    values = dict(zip(nominal.parameter_names, nominal.values.T, strict=True))
    off = {(o.model, o.parameter) for o in nominal.outliers}
    outliers = {name: np.array([(model, name) in off for model in nominal.models]) for name in values}
    return ActuatorParameters(values, outliers, nominal.models.index(nominal.name))


FIGURES = (
    NamedFigure(
        "fig08_actuator_parameters",
        lambda results: results.nominal,
        lambda nominal: plot_actuator_parameters(nominal_data(nominal)),
    ),
)
