"""What `gbid check` finds before hours are spent: in files, clocks, lengths and on the disk."""

import shutil
from collections import namedtuple

import numpy as np
import pytest
from experiment_files import gbid, json_of, printed_by, write_quick, write_spring, write_spring_data
from own_files import BY_NAME, CLOCK, COLUMNS, SIGNALS, write_file

from gbid.core.errors import DataError
from gbid.experiment.load import find_data_problems, load_experiment
from gbid.recording import ImportMapping
from gbid.recording.importing import peek

FITS = """\
prefilter: {}
fits:
  bearing: {structure: rotor_bearing}
  piezos: {structure: piezo_pair}
crossval:
  bearing: {on: cyclic}
"""


def columns(n=1000, seed=0, step=2e-4):
    random = np.random.default_rng(seed)
    return {"t": step * np.arange(n), **{name: random.standard_normal(n) for name in (*COLUMNS, "phi")}}


def write_many(folder, ending="mat", clock=CLOCK, points=2, n=1000):
    (folder / "data").mkdir(parents=True)
    for i in range(points):
        for kind in ("prbs1", "prbs2", "still1"):
            write_file(folder / "data" / f"p{3 + i}_n4000_{kind}.{ending}", columns(n, 3 * i))
    path = folder / "experiment.yaml"
    path.write_text(BY_NAME.format(ending=ending, clock=clock, signals=SIGNALS.rstrip()) + FITS)
    return path


def problems(path):
    return find_data_problems(load_experiment(path))[:2]


@pytest.mark.parametrize("ending", ["mat", "csv"])
def test_a_truncated_file_is_named_in_the_check(ending, tmp_path, capsys):
    path = write_many(tmp_path, ending)
    assert problems(path) == ([], 0)
    victim = tmp_path / "data" / f"p4_n4000_prbs2.{ending}"
    complete = victim.read_bytes()
    victim.write_bytes(complete[: int(0.6 * len(complete)) if ending != "csv" else -30])
    texts, code = problems(path)
    assert code == 3
    assert len(texts) == 1
    assert f"experiment.yaml:6:5: {victim}" in texts[0]
    assert str(victim) in printed_by(capsys, "check", path, "--quick", code=3).err
    victim.write_bytes(b"")
    assert problems(path)[1] == 3


def test_a_column_that_is_not_there(tmp_path):
    path = write_many(tmp_path, "npz")
    values = columns()
    del values["p_y"]
    write_file(tmp_path / "data" / "p3_n4000_prbs1.npz", values)
    (text,), code = problems(path)
    assert "p3_n4000_prbs1.npz: no variable 'p_y'" in text
    assert code == 3


def test_one_clock_that_differs_is_named(tmp_path):
    path = write_many(tmp_path, clock="time: t")
    assert problems(path) == ([], 0)
    write_file(tmp_path / "data" / "p4_n4000_prbs1.mat", columns(step=1e-4))
    texts, code = problems(path)
    assert code == 3
    assert len(texts) == 2  # of both fits
    assert "recording 'p4_n4000_prbs1': sample time 0.0001 s; 3 of 4 recordings of fit bearing have 0.0002" in texts[0]


def test_recordings_too_short_for_their_unknowns(tmp_path):
    path = write_many(tmp_path, n=190)
    texts, code = problems(path)
    assert code == 3
    # 14 key parameters, 4 disturbance gains, 4 states
    assert len([t for t in texts if "190 samples for the 22 unknowns of fit bearing" in t]) == 4
    assert not [t for t in texts if "piezos" in t]
    path.write_text(path.read_text().replace("rotor_bearing}", "rotor_bearing, options: {disturbance_gain: none}}"))
    assert problems(path) == ([], 0)
    shorter = ("duration_s: 1.0", "duration_s: 0.036"), ("hold_s: 20e-3", "hold_s: 2e-3")
    quick = write_quick(tmp_path / "rig", *shorter, ("from_s: 0.2, to_s: 0.4", "to_s: 0.036"))
    assert any("unknowns of fit bearing" in text for text in problems(quick)[0])


def test_results_that_do_not_fit_on_the_disk(tmp_path, monkeypatch, capsys):
    path = write_quick(tmp_path)
    assert problems(path) == ([], 0)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9 - 10**5, 10**5))
    (text,), code = problems(path)
    assert code == 3
    assert "the results need about" in text
    assert "100 kB are free; make room, or write elsewhere with --results" in text
    told = json_of(capsys, "check", path, code=3)
    assert told["bytes_free"] == 10**5 < told["bytes_needed"]


def test_the_content_is_looked_at_unless_quick(tmp_path, capsys):
    path = write_spring(tmp_path)

    def dead(values):
        values["position [um]"][:] = 0.0

    write_spring_data(tmp_path / "data" / "run2.csv", 2, damage=dead)
    assert gbid("check", path, "--quick") == 0
    assert "is constant" in printed_by(capsys, "check", path, code=3).err


def test_an_index_that_jumps_in_a_stationary_run_is_named(tmp_path, capsys):
    """The map of run-out is made from such runs, which no fit uses."""
    path = write_many(tmp_path, points=1)
    for k, kind in enumerate(("prbs1", "prbs2", "still1")):
        values = columns(seed=k)
        turning = 2 * np.pi * 4000 / 60 * 2e-4 * np.arange(1000) + (np.arange(1000) > 499) * 1.1 * (kind == "still1")
        write_file(tmp_path / "data" / f"p3_n4000_{kind}.mat", {**values, "phi": np.mod(turning, 2 * np.pi)})
    said = printed_by(capsys, "check", path, code=3).err
    assert "'p3_n4000_still1': signal 'phi' jumps 1 times, the first by +63.0 degrees at 0.0998 s" in said


@pytest.mark.parametrize("ending", ["mat", "npz", "csv"])
def test_a_short_look_agrees_with_the_recording(tmp_path, ending):
    file = tmp_path / f"a.{ending}"
    write_file(file, columns(300, step=5e-4))
    mapping = ImportMapping.from_dict({"time": "t", "samples": [10, None], "signals": {"p": {"columns": ["p_x"]}}})
    computed = peek(file, mapping)
    assert computed.n_samples == 290
    assert computed.sample_time == pytest.approx(5e-4, rel=1e-6)
    delayed = ImportMapping.from_dict(
        {"sample_time": 1.0, "samples": [10, 400], "signals": {"p": {"columns": ["p_x"]}}}
    )
    with pytest.raises(DataError, match="samples 10 to 400 are not within its 300 samples"):
        peek(file, delayed)


def test_stretches_left_out_of_a_fit_are_left_out_of_its_validation(tmp_path, capsys):
    """A disturbed stretch spoils the cross-validation unless the fit leaves it out."""

    def knock(values):
        values["position [um]"][600:700] += 300.0

    path = write_spring(tmp_path, ("minimum_percent: 90", "residuals: none"))
    write_spring_data(tmp_path / "data" / "run2.csv", 2, damage=knock)
    assert gbid("import", path) == 0
    assert gbid("fit", path) == 0
    before = {r["model"]: r for r in json_of(capsys, "crossval", path)["crossval"]}
    assert before["run1"]["fit_percent"] < 80
    assert before["run2"]["fit_percent"] < 98
    assert before["run1"]["residual_p"] is None
    left_out = "focus: simulation, left_out: {run2: [[0.3, 0.35]]}"
    write_spring(tmp_path, ("minimum_percent: 90", "residuals: pairs"), ("focus: simulation", left_out))
    write_spring_data(tmp_path / "data" / "run2.csv", 2, damage=knock)
    assert gbid("fit", path, "--overwrite") == 0
    after = {r["model"]: r for r in json_of(capsys, "crossval", path, "--overwrite")["crossval"]}
    assert after["run1"]["recording"] == "run2"
    assert after["run1"]["fit_percent"] > 98
    assert after["run2"]["fit_percent"] > 98
    assert after["run1"]["residual_p"] > 1e-3


def test_residuals_once_for_each_model(tmp_path, capsys):
    path = write_spring(tmp_path, ("on: cyclic, minimum_percent: 90", "on: [run1, run2], residuals: models"))
    for verb in ("import", "fit"):
        assert gbid(verb, path) == 0
    rows = json_of(capsys, "crossval", path)["crossval"]
    assert [(r["model"], r["recording"], r["residual_p"] is None) for r in rows] == [
        ("run1", "run1", False),
        ("run1", "run2", True),
        ("run2", "run1", False),
        ("run2", "run2", True),
    ]


RIG = """
format: 1
name: rig
rig:
  duration_s: 1.6
  operating_points: [{pressure_bar: 5.0, speed_rpm: 6000}]
  prbs: {recordings: 1}
prefilter: {harmonics: 10}
fits: {bearing: {structure: rotor_bearing}, piezos: {structure: piezo_pair}}
nominal: {fit: piezos}
lpv: {fit: bearing, order: 0, actuators: nominal}
controller: {loop: {structure: P, sample_time_s: 2.0e-4}}
"""


@pytest.mark.parametrize(
    ("value", "words", "code"),
    [
        ("rig.prbs.recordings=1000000000", "rig.prbs.recordings: must be at most 1000, found 1000000000", 2),
        ("rig.duration_s=1.0e+9", "rig.duration_s: must be at most 36000", 2),
        ("rig.prbs.hold_s=20", "prbs.hold_s: 20 s, so a PRBS never switches within the 1.6 s", 2),
        ("prefilter.harmonics=600", "harmonics = 600, but at 6000 rpm samples of 0.0002 s show at most 24", 3),
        ("controller.loop.sample_time_s=0.2", "sample_time_s = 0.2 s, but the machine has a mode at 131.5 Hz", 3),
    ],
)
def test_values_without_sense_are_refused_with_the_reason(value, words, code, tmp_path, capsys):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG, encoding="utf-8")
    assert words in " ".join(printed_by(capsys, "check", path, "--set", value, code=code).err.split())
