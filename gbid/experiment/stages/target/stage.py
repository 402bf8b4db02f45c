"""Stage of the control chain; `gbid export --to c` writes it, and the rig runs it (``rig: controller: compiled``)."""

from __future__ import annotations

from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.target.checks import chain_can_run

TARGET = Stage("target", "target", (chain_can_run,), lambda _: ())
