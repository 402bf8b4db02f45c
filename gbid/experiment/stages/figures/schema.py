"""Schema of the figures section."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from gbid.experiment.fields import NotNegative, Positive, Section, Switch

Format = Literal["png", "pdf", "svg"]


class FigureSection(Section):
    """Time range that the figure shows, and whether residual tests and Bode diagrams are drawn as well.

    `formats`: file formats of the pictures; each takes its time.
    """

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False
    bode: Switch = False
    formats: Annotated[tuple[Format, ...], Field(min_length=1)] = ("png",)
