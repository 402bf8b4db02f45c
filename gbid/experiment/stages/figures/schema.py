"""Schema of the figures section."""

from __future__ import annotations

from gbid.experiment.fields import NotNegative, Positive, Section, Switch


class FigureSection(Section):
    """Time range that the figure shows, and whether it also shows the residuals."""

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False
