"""Courses of pressure and speed in the YAML: recordings, prefilter by a slow roll, and problems."""

import numpy as np
import pytest
from experiment_files import gbid, write_quick

from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.recording import load_recording

COURSES = """\
format: 1
name: courses
rig:
  operating_points: [{pressure_bar: 5.0, speed_rpm: 600}]
  duration_s: 0.4
  settle_s: 0.02
  prbs: {recordings: 0, amplitude_m: 1.0e-12}
  sensors: {noise_p_m: 1.0e-9, encoder_counts: null}
  unbalance: {eccentricity_m: 0.0}
  courses:
    - {name: down, duration_s: 0.2, pressure_bar: 4.0, speed_rpm: [6000.0, 500.0], coast_down: true}
prefilter: {slow_roll: ["*_still1"], remove_mean: false}
"""


def test_recordings_of_courses_lose_the_runout_of_the_slow_roll(tmp_path):
    job = Job(load_experiment(write_quick(tmp_path, text=COURSES), tmp_path / "r"))
    for stage in (RIG, PREFILTER):
        assert all(outcome.state == "made" for outcome in run_stage(job, stage))
    raw = load_recording(tmp_path / "r" / "recordings" / "down1.h5")
    clean = load_recording(tmp_path / "r" / "prefiltered" / "down1.h5")
    assert raw.signal("speed_rpm")[-1, 0] == pytest.approx(500.0, rel=0.02)
    assert "truth" not in raw.provenance
    assert raw.signal("p").std() > 2e-6
    assert clean.signal("p").std() < 2e-9
    np.testing.assert_array_equal(clean.signal("pressure_bar"), 4.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[6000.0, 500.0]", "[9000.0, 500.0]"), "leaves the domain"),
        (("[6000.0, 500.0]", "3000.0"), "two numbers for speed_rpm"),
        (('["*_still1"]', '["*_steel1"]'), "no stationary recording matches"),
    ],
)
def test_problems_of_courses_are_named(tmp_path, capsys, change, words):
    assert gbid("check", write_quick(tmp_path, change, text=COURSES)) == 2
    assert words in " ".join("".join(capsys.readouterr()).split())
