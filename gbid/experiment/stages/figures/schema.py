"""What an experiment YAML may say of figures of fits."""

from __future__ import annotations

from gbid.experiment.fields import NotNegative, Positive, Section, Switch


class FigureSection(Section):
    """The part of the recording that the picture shows, and whether one of the residuals is drawn beside it."""

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False
