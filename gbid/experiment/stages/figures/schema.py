"""Schema of the figures section."""

from __future__ import annotations

from gbid.experiment.fields import NotNegative, Positive, Section, Switch


class FigureSection(Section):
    """Time range that the figure shows, and whether residual tests and Bode diagrams are drawn as well."""

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False
    bode: Switch = False
