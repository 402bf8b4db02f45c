"""`gbid rig`: recordings of the virtual rig."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Engine, ExperimentPath, Overwrite, Results, Retry, Workers


def rig(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Make the recordings of the rig section."""
    with guarded(as_json, debug):
        from gbid.cli.sources import make_recordings
        from gbid.experiment.stages.rig.stage import make_rig_recordings

        make_recordings("rig", make_rig_recordings, experiment, results, overwrite, as_json, engine, workers, retry)
