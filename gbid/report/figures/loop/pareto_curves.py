"""Pareto front of robustness and damping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.control.assessment.tuned_design import TunedDesign
from gbid.control.tuning.gain_result import GainResult
from gbid.report.figures.canvas import (
    SERIES,
    ink,
    panels,
    series,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.report.reader.designs import comparable_designs, design_performances

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class ParetoCurves(Brief):
    """Pareto fronts of robustness and damping, and single designs.

    Attributes
    ----------
    peak_sensitivity : dict of str to (n,) array
        Peak of S_o of the designs, by structure of the controller.
    damping : dict of str to (n,) array
        Smallest damping factor of the same designs.
    designs : dict of str to (peak, damping)
        Single designs with a mark, as the paper's gains.
    title : str
        Title of the figure.
    """

    peak_sensitivity: Mapping[str, FloatArray]
    damping: Mapping[str, FloatArray]
    designs: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    title: str = ""


def pareto_data(
    designs: Mapping[str, Sequence[tuple[float, float]]],
    marked: Mapping[str, tuple[float, float]] | None = None,
    title: str = "",
) -> ParetoCurves:
    """Return designs in ascending order of their peak sensitivity.

    Parameters
    ----------
    designs : dict of str to sequence of (peak_sensitivity, damping)
        Designs by structure of the controller.
    marked : dict of str to (peak_sensitivity, damping), optional
        Single designs with a mark.
    title : str
        Title of the figure.

    Returns
    -------
    ParetoCurves
        Fronts and single designs.
    """
    sorted_designs = {label: np.array(sorted(pairs), float).reshape(-1, 2) for label, pairs in designs.items()}
    peaks = {label: pairs[:, 0] for label, pairs in sorted_designs.items()}
    damping = {label: pairs[:, 1] for label, pairs in sorted_designs.items()}
    return ParetoCurves(peaks, damping, dict(marked or {}), title)


def designs_pareto_data(designs: Mapping[str, TunedDesign]) -> ParetoCurves:
    """Return the fronts of comparable designs, with the published designs, for `plot_pareto`.

    Parameters
    ----------
    designs : dict of str to TunedDesign
        Designs by name; each has its designs for other limits of the peak sensitivity.

    Returns
    -------
    ParetoCurves
        Fronts by structure; designs that violate a limit are left out.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = comparable_designs(designs)
    fronts: dict[str, list[tuple[float, float]]] = {}
    for name, design in chosen.items():
        results = [design.result, *(result for _, result in design.front)]
        label = design.performance[0].structure if design.performance else name
        label = name if label in fronts else label
        fronts[label] = [_place(result) for result in results if result.success and result.peak_sensitivity is not None]
    first, marked = next(iter(chosen.values())), {}
    runs = first.result.sample_time is not None
    figures = ("sampled_peak_output", "sampled_damping") if runs else ("peak_output", "damping")
    for performance in design_performances(designs)[len(chosen) :]:
        peak, damping = (performance.worst[figure][0] for figure in figures)
        if np.isfinite([peak, damping]).all():
            marked[performance.name] = (peak, damping)
    title = f"{first.plant}, worst of {len(first.result.points)} operating points"
    if first.result.sample_time is not None:
        title += f", sampled at {1e3 * first.result.sample_time:g} ms"
    return pareto_data(fronts, marked, title)


def _place(result: GainResult) -> tuple[float, float]:
    assert result.peak_sensitivity is not None
    return result.peak_sensitivity, result.value


@styled
def plot_pareto(data: ParetoCurves, ax: Axes | None = None) -> Axes:
    """Draw the smallest damping factor over the peak of the output sensitivity.

    Parameters
    ----------
    data : ParetoCurves
        Data of the figure.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    many = len(data.peak_sensitivity) > len(SERIES)  # too many lines for a legend among them
    _figure, (panel, *_) = panels(ax, size=(5.9 if many else 4.6, 3.1))
    for k, (label, peak) in enumerate(data.peak_sensitivity.items()):
        order = np.argsort(peak)
        values = np.asarray(data.damping[label], float)[order]
        hollow: dict[str, Any] = (
            {} if k % (2 * len(SERIES)) < len(SERIES) else {"markerfacecolor": "white"}
        )  # colours come again
        panel.plot(np.asarray(peak, float)[order], values, label=label, markersize=3.5, **series(k), **hollow)
    for k, (label, (peak_so, damping)) in enumerate(data.designs.items()):
        look: dict[str, Any] = {"color": ink(), "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 1.3}
        panel.plot(peak_so, damping, "*sPX"[k % 4], label=label, **look)
    panel.set_xlabel("peak of the output sensitivity $S_o$ [-]")
    panel.set_ylabel("smallest damping factor [-]")
    panel.set_ylim(bottom=0.0)
    panel.legend(**({"loc": "center left", "bbox_to_anchor": (1.02, 0.5)} if many else {"loc": "best"}))
    if data.title:
        panel.set_title(data.title, loc="left", pad=4)
    return panel


FIGURES = (
    NamedFigure("designs_pareto", lambda results: results.tuned, lambda tuned: plot_pareto(designs_pareto_data(tuned))),
)
