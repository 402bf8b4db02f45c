"""Stage of the figures of fits; `gbid.report` draws them from the results of the other stages."""

from __future__ import annotations

from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.figures.checks import figures_show_fits

FIGURES = Stage("figure", "figures", (figures_show_fits,), lambda _: ())
