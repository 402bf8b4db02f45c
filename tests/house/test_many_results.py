"""The generated folder of many results: every verb takes its copies for made."""

from pathlib import Path

from gbid.experiment.run import Job
from gbid.report.read import Results
from tests.benchmarks.many_results import REAL, make_results


def test_copies_stand_as_made_under_their_names(tmp_path: Path) -> None:
    results = Results(Job(make_results(tmp_path / "many", REAL + 3)))
    assert {(standing.item.stage, standing.state) for standing in results.standings} == {
        ("rig", "kept"),
        ("fit", "kept"),
    }
    assert [fit.document["recordings"] for fit in results.fits] == [[fit.model] for fit in results.fits]
    assert len(results.recordings) == len(results.fits) == REAL + 3
    fits = [fit.document["parameters"] for fit in results.fits]
    assert fits[REAL] == fits[0]
    assert fits[0] != fits[1]
