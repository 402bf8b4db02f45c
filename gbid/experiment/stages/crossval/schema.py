"""Schema of the crossval section."""

from __future__ import annotations

from typing import Literal

from gbid.experiment.fields import Names, Number, Section


class CrossvalSection(Section):
    """Recordings on which the models of a fit are validated (paper, Sec. 3.8).

    `on`: ``cyclic`` is model j on recording j + 1 of its operating point, the last on the first; ``others`` each model
    on all other excited recordings; ``point`` on those of its own operating point; else names of recordings.
    `residuals` are tested for all ``pairs``, for the first pair of each of the ``models``, or not at all (``none``).
    The default is all pairs when there are at most 200, else one pair for each model.
    """

    on: Names = ("cyclic",)
    minimum_percent: Number | None = None
    residuals: Literal["pairs", "models", "none"] | None = None
