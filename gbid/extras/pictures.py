"""Pictures of values, drawn by the report at the time of the call."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class Pictured:
    """Base of values with a picture.

    A value lies below the report, which draws. So the report is imported by name, and only when a picture is wanted.
    `gbid.report.plot` knows which picture belongs to which type.
    """

    def plot(self, ax: Any = None, **options: Any) -> Any:
        """Draw the picture of this value, as ``gbid.report.plot(value, ax, **options)`` does.

        A new figure belongs to ``matplotlib.pyplot``: a notebook shows it, and so does ``plt.show()``.

        Parameters
        ----------
        ax : matplotlib Axes or array of them, optional
            Axes to draw into; a new figure when left out.
        **options
            Options of the picture function, which `gbid.report.plot` names.

        Returns
        -------
        matplotlib Axes or array of them
            The axes; their ``figure`` is the figure.
        """
        return import_module("gbid.report.figures.picture_of").shown(self, ax, **options)
