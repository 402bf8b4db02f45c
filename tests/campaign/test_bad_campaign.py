"""A folder full of faults: each is named, by the check or among the failures, and the rest is fitted."""

import numpy as np
import pytest
from experiment_files import printed_by
from own_files import BY_NAME, SIGNALS, columns_of, write_file
from rig_point import machine

from gbid import load
from gbid.rig import Faults, Prbs, Stationary, record

FITS = """\
prefilter: {harmonics: 4}
fits:
  bearing: {structure: rotor_bearing, options: {disturbance_gain: none}, focus: simulation, stop: paper}
  piezos: {structure: piezo_pair}
"""
GOOD = ("p5_n6000_prbs1", "p5_n6000_prbs2", "p6_n0_prbs1")
BAD = {  # and what the check says of it
    "p5_n6000_prbs3": "signal 'p' shows a rub",
    "p5_n6000_prbs4": "signal 'p' channel 'y' is constant: all 5000 samples are 1e-06 m; a dead sensor",
    "p5_n6000_prbs5": "sample time 0.00025 s; 7 of 8 recordings of fit bearing have 0.0002 s",
    "p5_n6000_prbs6": "signal 'p' has x and y swapped",
    "p5_n6000_prbs7": "truncated",
    "p5_n6000_prbs8": "holds the same samples as 'p5_n6000_prbs1'",
}
AT_IMPORT = {"p5_n6000_prbs5": "a sample time of 0.0002 s would fit"}


def measure(name, seed, **faults):
    pressure, speed = float(name[1]), float(name.split("_")[1][1:])
    conditions, kind = {"pressure_bar": pressure, "speed_rpm": speed}, Stationary if "still" in name else Prbs
    rig, faulty = machine(pressure, speed), Faults(**faults)
    made = record(rig, kind(1.0), conditions=conditions, seed=seed, name=name, faults=faulty)
    return {**columns_of(made), "t": made.sample_time * np.arange(made.n_samples)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("bad")
    (made / "data").mkdir()
    faults = {
        "p5_n6000_prbs3": {"rub_clearance_m": 7e-6},
        "p5_n6000_prbs4": {"dead": {"p.y": 1e-6}},
        "p5_n6000_prbs6": {"swapped": ("p",)},
    }
    still = ("p5_n6000_still1", "p6_n0_still1")
    for seed, name in enumerate((*GOOD, *BAD, *still)):
        write_file(made / "data" / f"{name}.npz", measure(name, seed, **faults.get(name, {})))
    data = made / "data"
    values = dict(np.load(data / "p5_n6000_prbs5.npz"))
    np.savez(data / "p5_n6000_prbs5.npz", **{**values, "t": 1.25 * values["t"]})
    complete = (data / "p5_n6000_prbs7.npz").read_bytes()
    (data / "p5_n6000_prbs7.npz").write_bytes(complete[: len(complete) // 2])
    (data / "p5_n6000_prbs8.npz").write_bytes((data / "p5_n6000_prbs1.npz").read_bytes())
    path = made / "experiment.yaml"
    path.write_text(BY_NAME.format(ending="npz", clock="time: t", signals=SIGNALS.rstrip()) + FITS)
    return path


def test_each_fault_is_named_and_the_rest_is_fitted(folder, capsys):
    # What the experiment cannot do at all is said first.
    alone = folder.parent / "data" / "p7_n4000_prbs1.npz"
    write_file(alone, measure(alone.stem, 99))
    for verb in ("check", "batch"):
        (line,) = printed_by(capsys, verb, folder, code=2).err.splitlines()
        assert "no stationary recording at p7_n4000 (as 'p7_n4000_prbs1')" in line
    alone.unlink()

    told = printed_by(capsys, "check", folder, code=3).err.splitlines()
    for name, text in BAD.items():
        assert any(name in line and text in line for line in told), name
    assert not [line for line in told if not any(name in line for name in BAD)]

    told = printed_by(capsys, "batch", folder, "--engine", "serial", code=3).err.splitlines()
    reasons = [line for line in told if line.startswith("gbid: error: import ")]
    assert len(reasons) == len(BAD)
    table = load(folder.parent / "results" / "own" / "table.h5")
    assert len(table) == 2 * (len(GOOD) + len(BAD))
    for i in range(len(table)):
        name = str(table.model[i])
        if name in GOOD:
            assert table.success[i], table.status[i]
            assert table.fit_percent[i][np.isfinite(table.fit_percent[i])].min() > 90
        else:
            assert not table.success[i]
            text = AT_IMPORT.get(name, BAD[name])
            assert table.status[i].startswith(f"failed: import {name}: ")
            assert text in table.status[i]
            assert any(f"import {name}: " in line and text in line for line in reasons)
