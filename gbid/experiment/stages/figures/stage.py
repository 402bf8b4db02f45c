"""Stage of the figures of fits; they are drawn above, in `gbid.report`, from what the other stages have made."""

from __future__ import annotations

from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.figures.checks import figures_show_fits

FIGURES = Stage("figure", "figures", (figures_show_fits,), lambda _: ())
