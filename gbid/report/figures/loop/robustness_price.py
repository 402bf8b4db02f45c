"""Price of robustness: what designs promise over the probability with which it holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from gbid.control.assessment.tuned_design import TunedDesign
from gbid.errors import DataError
from gbid.report.figures.canvas import panels, series, styled
from gbid.report.figures.named import NamedFigure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@styled
def plot_robustness_price(designs: Mapping[str, TunedDesign], ax: Axes | None = None) -> Axes:
    """Draw the promised objective of robust designs over the probability, beside that of the nominal design.

    Parameters
    ----------
    designs : dict of str to TunedDesign
        Designs by name; those without promises are left out.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.

    Raises
    ------
    DataError
        When no design has promises.
    """
    robust = {name: design for name, design in designs.items() if design.promises}
    if not robust:
        raise DataError("no design is robust; write robust: {probability: 0.95, price: [0.5, 0.8]} in its section")
    _, (panel, *_) = panels(ax, size=(4.6, 3.1))
    for k, (name, design) in enumerate(robust.items()):
        look = series(k)
        at = [p.probability for p in design.promises]
        panel.plot(at, [p.promised for p in design.promises], label=name, **look)
        plain = [p.of_nominal for p in design.promises]
        words = f"{name} for the nominal plant (limits kept: {100 * design.promises[0].limits_of_nominal:.0f} %)"
        panel.plot(at, plain, label=words, **{**look, "linestyle": ":", "markerfacecolor": "none"})
    unit = {"damping": "promised damping factor [-]", "decay": "promised decay [1/s]"}
    objectives = {design.result.objective for design in robust.values()}
    panel.set_xlabel("probability [-]")
    panel.set_ylabel(unit.get(objectives.pop(), "promised objective") if len(objectives) == 1 else "promised objective")
    panel.legend(loc="best")
    return panel


FIGURES = (
    NamedFigure(
        "designs_robust",
        lambda results: results.tuned,
        plot_robustness_price,
    ),
)
