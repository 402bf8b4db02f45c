"""Run the identification-for-control cycle of an experiment; print its rounds, store the numbers.

``python -m benchmarks.cycle [--experiment FILE] [--output FILE]``
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import gbid
from benchmarks.running import options_of, store
from gbid.core.tables import markdown_table
from gbid.experiment.campaign import run_campaign, working
from gbid.experiment.load import load_experiment
from gbid.experiment.run import run_stage
from gbid.experiment.stages.cycle import made_rows
from gbid.experiment.stages.registry import STAGES
from gbid.report.control_tables import cycle_documents, cycle_summary


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(__doc__, arguments, experiment=("experiments/cycle.yaml", "the experiment"))
    with tempfile.TemporaryDirectory() as folder:
        experiment = load_experiment(Path(options.experiment), Path(folder) / "results")
        with working(experiment, engine="serial") as job:
            run_campaign(job)
            for stage in STAGES:
                if not stage.early:
                    run_stage(job, stage)
            rows = made_rows(job)
    run = {"gbid": gbid.__version__, "experiment": experiment.spec.name, "rows": [asdict(row) for row in rows]}
    store(run, options.output)
    print(markdown_table(cycle_summary(cycle_documents(rows))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
