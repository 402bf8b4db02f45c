"""The table of a campaign: its rows, and whose files it replaces."""

from types import SimpleNamespace

from campaign_files import write_springs

from gbid.experiment.campaign import NOT_MADE, TABLE, _entry, collect
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.identify import load_table


def test_a_row_has_the_conditions_that_its_recordings_share():
    conditions = {"a": {"pressure_bar": 3.0, "speed_rpm": 0.0}, "b": {"pressure_bar": 3.0, "speed_rpm": 6000.0}}
    recordings = {name: SimpleNamespace(conditions=stated) for name, stated in conditions.items()}
    job = SimpleNamespace(experiment=SimpleNamespace(recordings=recordings))
    entry = _entry(job, "bearing", "joint", SimpleNamespace(recordings=("a", "b")), "failed: too short")
    assert (entry.fit, entry.model, entry.recordings) == ("bearing", "joint", ("a", "b"))
    assert (entry.conditions, entry.failure) == ({"pressure_bar": 3.0}, "failed: too short")


def test_a_table_of_others_is_left_and_nothing_made_is_said(tmp_path):
    job = Job(load_experiment(write_springs(tmp_path, 2)))
    table, outcomes = collect(job)
    assert len(table) == len(outcomes) == 2
    assert not table.success.any()
    assert all(NOT_MADE in status for status in table.status)
    again, outcomes = collect(job)
    assert {outcome.state for outcome in outcomes} == {"kept"}
    assert len(again) == len(load_table(job.path("", TABLE, ".h5"))) == 2
    own = job.path("", TABLE, ".csv")
    own.write_text("of someone else")
    assert [outcome.state for outcome in collect(job)[1]] == ["kept", "failed"]
    assert own.read_text() == "of someone else"
