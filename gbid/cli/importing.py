"""`gbid import`: recordings from files of one's own."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Engine, ExperimentPath, Overwrite, Results, Retry, Workers


def import_data(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Read the recordings of the import section."""
    with guarded(as_json, debug):
        from gbid.cli.sources import make_recordings
        from gbid.experiment.stages.importing.stage import import_recordings

        make_recordings("import", import_recordings, experiment, results, overwrite, as_json, engine, workers, retry)
