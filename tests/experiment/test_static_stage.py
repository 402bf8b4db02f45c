"""Static characterisation and the deeper prefilter as stages of an experiment and on the command line."""

import csv

import numpy as np
import pytest
from experiment_files import STAIRS, copy_results, json_of, printed_by, write_quick
from json_keys import assert_keys

from gbid import load
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.experiment.stages.static import STATIC
from gbid.lpv import load_model
from gbid.prefilter import PiezoCurve, StaticMap
from gbid.prefilter.filtering import PrefilterFile
from gbid.recording import load_recording

AUTO = """\
format: 1
name: auto
rig:
  seed: 3
  operating_points:
    - {pressure_bar: 5.0, speed_rpm: 6000}
  duration_s: 1.0
  prbs: {recordings: 1}
  stationary: {recordings: 2}
prefilter:
  method: auto
  median: 1
"""


@pytest.fixture(scope="module")
def stairs(tmp_path_factory):
    path = write_quick(tmp_path_factory.mktemp("stairs"), text=STAIRS)
    run_stage(Job(load_experiment(path)), RIG)
    return path


def test_static_writes_maps_and_tables(stairs, capsys):
    document = json_of(capsys, "static", stairs)
    assert_keys("static", document)
    assert [entry["name"] for entry in document["static"]] == ["film", "stack4"]
    results = stairs.parent / "results" / "stairs" / "static"
    made = load(results / "film.h5", StaticMap)
    # the published model knows its static gain
    truth = load_model("theisen2016").at(6.0, 0.0).static_gain()
    interval = made.interval(0.999)
    assert ((interval[..., 0] < truth) & (truth < interval[..., 1])).all()
    gains = document["static"][0]["gains"]
    assert [(g["input"], g["output"]) for g in gains[:2]] == [("u_x", "p_x"), ("u_y", "p_x")]
    assert gains[0]["gain"] == made.gain[0, 0]
    curve = load(results / "stack4.h5", PiezoCurve)
    assert document["static"][1]["hysteresis"] == curve.hysteresis
    assert curve.hysteresis == pytest.approx(8.4e-6, rel=0.05)
    with (results / "film.csv").open() as handle:
        lines = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    assert len(lines) == len(made.command) == 50
    assert float(lines[3]["p_x [m]"]) == made.output_mean[3, 0]
    printed, progress = printed_by(capsys, "static", stairs)
    assert progress.count(": kept") == 4
    for word in ("u_x to p_x", "rms off", "hysteresis", "creep per step", "%"):
        assert word in printed


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("p6_n0_stairs_*", "p6_n0_stars", "no recording matches 'p6_n0_stars'"),
        ("command: v,", "command: w,", "has no signal 'w'"),
        ("kind: piezo, ", "", "is for kind: piezo; leave it out for kind: bearing"),
        ('"p6_n0_stack4_open1", kind', '"p6_n0_st*", kind', "characterised from one recording"),
        ('channel: "4"', 'channel: "4", limits: [1, 0]', "give the lower end first"),
        ("keep: 0.4", "keep: 1.4", "static.film.keep: must be at most 1"),
    ],
)
def test_wrong_sections_are_named(tmp_path, old, new, words):
    with pytest.raises(ExperimentError, match=words.replace("[", r"\[")):
        load_experiment(write_quick(tmp_path, (old, new), text=STAIRS))


def test_a_plateau_too_short_is_a_failure_beside_the_others(stairs, tmp_path):
    experiment = load_experiment(write_quick(tmp_path, ("keep: 0.4", "keep: 0.001"), text=STAIRS))
    copy_results(stairs.parent / "results/stairs/recordings", experiment.results / "recordings")
    outcomes = run_stage(Job(experiment), STATIC)
    assert [(o.item.section, o.state) for o in outcomes[:2]] == [("film", "failed"), ("stack4", "made")]
    assert "hold each step longer" in outcomes[0].text


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    job = Job(load_experiment(write_quick(tmp_path_factory.mktemp("auto"), text=AUTO)))
    run_stage(job, RIG)
    return job


def test_prefilter_auto_chooses_and_says_so(turning):
    job = turning
    outcomes = run_stage(job, PREFILTER)
    assert {o.state for o in outcomes} == {"made"}
    assert "method auto: harmonics, 5; rms residual on test data 30" in outcomes[-1].text
    stored = load(outcomes[-1].path, PrefilterFile)
    runout_map, (report,) = stored.runout_map, stored.reports
    assert runout_map is not None
    assert len(runout_map.orders) == 5
    assert any("method auto: harmonics, 5" in note for note in report.notes)


def test_prefilter_aligns_recordings_of_an_encoder_without_index(turning, tmp_path):
    job = Job(load_experiment(write_quick(tmp_path, ("method: auto", "align_index: true"), text=AUTO)))
    copy_results(turning.experiment.results / "recordings", job.experiment.results / "recordings")
    assert {o.state for o in run_stage(job, PREFILTER)} == {"made"}
    filtered = load_recording(job.path("prefiltered", "p5_n6000_prbs1"))
    # the encoder of these has its index, so the offset is next to nothing
    words = filtered.provenance["index"].split()
    assert min(float(words[0]), 360 - float(words[0])) < 0.5
    assert np.std(filtered.signal("p")) > 1e-6


def test_a_recording_without_index_is_refused_by_name(tmp_path):
    """Its map would be subtracted at a wrong angle, and the fit would only be poor."""
    path = write_quick(
        tmp_path,
        ("method: auto", "harmonics: 6"),
        ("prefilter:", '  faults: [{recordings: "*_prbs1", missing_index: true}]\nprefilter:'),
        text=AUTO,
    )
    job = Job(load_experiment(path))
    run_stage(job, RIG)
    outcome, *_ = run_stage(job, PREFILTER)
    assert outcome.state == "failed"
    for words in ("its run-out is that of p5_n6000_still1", "but rotated by", "missed its index", "align_index: true"):
        assert words in outcome.text
