"""A new stage is one file (here tests/support/peak_stage.py), an entry in the registry and a field of the schema."""

import json
import pickle

import pytest
from experiment_files import gbid, printed_by, write_spring
from peak_stage import PEAK, SHOWN_PEAK, FileWithPeaks, peak_tasks

from gbid.experiment import load
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.experiment.stages import registry

PEAKS = 'peaks: {recordings: "run*"}\n'


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(load, "ExperimentFile", FileWithPeaks)
    monkeypatch.setattr(registry, "STAGES", (*registry.STAGES, PEAK))


def write(folder, more=PEAKS):
    path = write_spring(folder)
    path.write_text(path.read_text().partition("fits:")[0] + more)
    return path


def peaks_of(path, capsys, *options, code=0):
    capsys.readouterr()
    assert gbid("run", path, "--json", *options) == code
    out, err = capsys.readouterr()
    document = json.loads(out)
    return document["peaks"], [o for o in document["outcomes"] if o["stage"] == "peak"], err


def test_the_schema_knows_its_section():
    schema = load.experiment_json_schema()
    assert schema["properties"]["peaks"] == {"$ref": "#/$defs/PeaksSection"}
    assert "limit" in schema["$defs"]["PeaksSection"]["properties"]


def test_its_form_and_its_meaning_are_checked(tmp_path):
    path = write(tmp_path, "peaks: {recordings: ran1, size: 3}\n")
    with pytest.raises(ExperimentError) as error:
        load_experiment(path)
    lines = [line.split(": ", 1)[1] for line in str(error.value).splitlines()]
    assert lines == [
        "peaks.recordings: no recording matches 'ran1'; did you mean 'run1'? choose from run1, run2",
        "peaks.size: unknown key; choose from recordings, signal, limit",
    ]


def test_run_makes_and_keeps_its_results(tmp_path, capsys):
    path = write(tmp_path)
    assert pickle.loads(pickle.dumps(peak_tasks(Job(load_experiment(path)))))  # as on the way to a worker
    shown, outcomes, err = peaks_of(path, capsys)
    assert [(o["item"], o["state"]) for o in outcomes] == [("run1", "made"), ("run2", "made"), ("count", "made")]
    assert [row["item"] for row in shown] == ["run1", "run2", "count"]
    assert float(shown[0]["text"]) > 0
    assert "peak run1: made" in err
    assert (tmp_path / "results/spring/peaks/count.txt").read_text().endswith("\n2\n")
    _, outcomes, _ = peaks_of(path, capsys)
    assert {o["state"] for o in outcomes} == {"kept"}
    assert "peak" in printed_by(capsys, "run", path, "-v").out  # its table


def test_its_failures_are_remembered(tmp_path, capsys):
    path = write(tmp_path, PEAKS.replace("}", ", limit: 1.0e-12}"))
    _, outcomes, err = peaks_of(path, capsys, code=3)
    assert [(o["item"], o["cause"], o["failed_before"]) for o in outcomes] == [
        ("run1", "data", False),
        ("run2", "data", False),
    ]
    assert "gbid: error: peak run1: recording 'run1'" in err
    _, outcomes, err = peaks_of(path, capsys, code=3)
    assert all(o["failed_before"] for o in outcomes)
    assert "failed in an earlier run; use --retry to try again" in err
    _, outcomes, _ = peaks_of(path, capsys, "--retry", code=3)
    assert not any(o["failed_before"] for o in outcomes)


def test_its_view_is_shown(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(registry, "STAGES", (*registry.STAGES[:-1], SHOWN_PEAK))
    path = write(tmp_path)
    shown, _, _ = peaks_of(path, capsys)
    assert [row["recording"] for row in shown] == ["run1", "run2"]
    assert all(row["peak"] == pytest.approx(1.0) for row in shown)  # the drive switches between -1 and 1 V
    assert ["run2", "1.00"] in [line.split() for line in printed_by(capsys, "run", path, "-v").out.splitlines()]
