"""Figures of values, as plain descriptions that `gbid.report` draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple


class Figure(NamedTuple):
    """Description of one figure of a value.

    Attributes
    ----------
    function : str
        Public function of `gbid.report` that draws it.
    caption : str
        Description for readers who cannot see the figure.
    values : tuple
        Positional arguments of the function.
    options : dict
        Keyword arguments of the function.
    """

    function: str
    caption: str
    values: tuple[Any, ...]
    options: Mapping[str, Any] = {}


class Pictured:
    """Base of values that have figures."""

    renderer: ClassVar[Callable[..., Any]]
    """Function that draws the first figure of a value; the package `gbid` sets it, because drawing lies above."""
    drawn_by: ClassVar[str] = ""
    """Function of `gbid.report` that draws a value with one figure."""

    def figures(self) -> list[Figure]:
        """Return the figures of this value; `plot` draws the first figure."""
        return [Figure(self.drawn_by, repr(self).partition("\n")[0], (self,))]

    def plot(self, ax: Any = None, **options: Any) -> Any:
        """Draw the first figure of this value, as ``gbid.report.plot(value, ax, **options)`` does.

        A new figure belongs to ``matplotlib.pyplot``: a notebook shows it, and so does ``plt.show()``.

        Parameters
        ----------
        ax : matplotlib Axes or array of them, optional
            Axes to draw into; a new figure when left out.
        **options
            Options of the function that draws, which `gbid.report.plot` names.

        Returns
        -------
        matplotlib Axes or array of them
            The axes; their ``figure`` is the figure.
        """
        return Pictured.renderer(self, ax, **options)
