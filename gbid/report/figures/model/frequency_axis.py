"""Logarithmic axis of frequencies with plain numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def frequency_axis(ax: Axes, low: float, high: float) -> None:
    """Set the limits of a logarithmic frequency axis [Hz], with ticks that are readable for short and long ranges."""
    ax.set_xlim(low, high)
    subs = (1.0, 2.0, 5.0) if high < 300 * low else (1.0,)
    ax.xaxis.set_major_locator(LogLocator(subs=subs))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
