"""Poles: eigenvalue map, and root locus over a factor on the gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief
from gbid.report.figures.canvas import (
    GREY,
    ink,
    legend_above,
    panels,
    series,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gbid.structure import LinearModel


@dataclass(frozen=True, eq=False)
class Eigenvalues(Brief):
    """Poles of several models.

    Attributes
    ----------
    poles : dict of str to (n,) complex array
        Poles by label [rad/s].
    title : str
        Title of the figure.
    """

    poles: Mapping[str, ComplexArray]
    title: str = ""


def eigenvalues_data(models: Mapping[str, LinearModel], title: str = "") -> Eigenvalues:
    """Return the poles of models.

    Parameters
    ----------
    models : dict of str to LinearModel
        Models by label.
    title : str
        Title of the figure.

    Returns
    -------
    Eigenvalues
        Poles by label.
    """
    return Eigenvalues({label: model.poles() for label, model in models.items()}, title)


@styled
def plot_eigenvalues(data: Eigenvalues, ax: Axes | None = None, *, largest_hz: float = 160.0) -> Axes:
    """Draw poles in the upper half plane, with rays of equal damping.

    Parameters
    ----------
    data : Eigenvalues
        Data of the figure.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    largest_hz : float
        Largest distance from zero of the poles shown [Hz].

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    figure, (panel, *_) = panels(ax, size=(4.6, 3.6))
    for k, (label, poles) in enumerate(data.poles.items()):
        near = _hertz(poles)
        near = near[(np.abs(near) <= largest_hz) & (near.imag >= -1e-9)]
        look = series(k, linestyle="none", markersize=5, markerfacecolor="none", markeredgewidth=1.1)
        panel.plot(near.real, near.imag, label=label, **look)
    _finish_plane(panel, largest_hz)
    legend_above(figure, panel, columns=4, title=data.title)
    return panel


@dataclass(frozen=True, eq=False)
class RootLocus(Brief):
    """Poles of a closed loop over a factor on the controller.

    Attributes
    ----------
    factor : (n,) array
        Factors.
    poles : (n, n_poles) complex array
        Poles for each factor [rad/s].
    label : str
        Meaning of the factor, for the colour bar.
    title : str
        Title of the figure.
    """

    factor: FloatArray
    poles: ComplexArray
    label: str = "factor on the gains [-]"
    title: str = ""


def root_locus_data(
    plant: LinearModel,
    controller: Callable[[float], LinearModel],
    factor: npt.ArrayLike,
    *,
    label: str = "factor on the gains [-]",
    title: str = "",
) -> RootLocus:
    """Return the poles of a closed loop over a factor on the controller.

    Parameters
    ----------
    plant : LinearModel
        Plant.
    controller : callable
        Function from the factor to the controller, as ``lambda f: p_controller(f * 1.125, f * 0.99)``.
    factor : (n,) array
        Factors.
    label, title : str
        Meaning of the factor, and title of the figure.

    Returns
    -------
    RootLocus
        Poles for each factor.
    """
    from gbid.control import close_loop

    factors = np.atleast_1d(np.asarray(factor, float))
    poles = np.array([close_loop(plant, controller(float(f))).poles() for f in factors])
    return RootLocus(factors, poles, label, title)


@styled
def plot_root_locus(data: RootLocus, ax: Axes | None = None, *, largest_hz: float = 160.0) -> Axes:
    """Draw the path of the poles in the upper half plane, from circles to squares.

    Parameters
    ----------
    data : RootLocus
        Data of `root_locus_data`.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    largest_hz : float
        Largest distance from zero of the poles shown [Hz].

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    figure, (panel, *_) = panels(ax, size=(5.2, 3.6))
    poles = _hertz(data.poles)
    shown = (np.abs(poles) <= largest_hz) & (poles.imag >= -1e-9)
    factor = np.broadcast_to(data.factor[:, None], poles.shape)
    cloud = panel.scatter(poles.real[shown], poles.imag[shown], s=5, c=factor[shown], cmap="viridis", linewidths=0)
    for row, marker in ((0, "o"), (-1, "s")):
        at, near = poles[row], shown[row]
        look: dict[str, Any] = {"color": ink(), "markersize": 5, "markerfacecolor": "none", "linestyle": "none"}
        label = f"{data.factor[row]:g}"
        panel.plot(at.real[near], at.imag[near], marker=marker, label=label, **look)
    bar = figure.colorbar(cloud, ax=panel, pad=0.02)
    bar.set_label(data.label)
    _finish_plane(panel, largest_hz)
    panel.legend(loc="lower left", title="factor", title_fontsize=8)
    if data.title:
        panel.set_title(data.title, loc="left", pad=6)
    return panel


def _hertz(poles: ComplexArray) -> ComplexArray:
    return np.asarray(poles / (2 * np.pi), np.complex128)


def _finish_plane(ax: Any, largest_hz: float) -> None:
    """Draw rays of equal damping, labels with units, and the limit of stability."""
    ax.axvline(0.0, color=ink(), linewidth=0.9)
    left, right = ax.get_xlim()
    left = min(left, -0.05 * largest_hz)
    right = max(right, 0.02 * largest_hz)
    top = min(1.05 * largest_hz, 1.15 * ax.get_ylim()[1])
    written = 0.0
    for zeta in (0.7, 0.4, 0.2, 0.1, 0.05, 0.02):
        slope = np.sqrt(1 - zeta**2) / zeta
        reach = min(-left, top / slope)
        ax.plot([0, -reach], [0, reach * slope], color=GREY, linewidth=0.6, linestyle=(0, (4, 3)), zorder=0)
        at_edge = reach < top / slope
        if at_edge or not written or written - reach > 0.07 * (right - left):  # otherwise the numbers overlap
            look: dict[str, Any] = {"ha": "left", "va": "top"} if at_edge else {"ha": "center", "va": "bottom"}
            shift = (2, -3) if at_edge else (0, 1)
            word = {"fontsize": 7, "color": "#666666", "textcoords": "offset points", "xytext": shift}
            ax.annotate(f"{zeta:g}", (-reach, reach * slope), **word, **look)
            written = written if at_edge else reach
    ax.set_xlim(left, right)
    ax.set_ylim(-0.02 * top, top)
    ax.set_xlabel("real part / 2π [Hz]; dashed: equal damping factor")
    ax.set_ylabel("imaginary part / 2π [Hz]")
