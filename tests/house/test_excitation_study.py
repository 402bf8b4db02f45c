"""The stored study of excitations: what the page says of it must be in it."""

import json

import numpy as np
from places import ROOT

from benchmarks.excitation_study import length_summary, summary

STORED = json.loads((ROOT / "docs" / "excitation.json").read_text(encoding="utf-8"))


def test_deviations_were_obtained_as_expected_and_no_recording_touched():
    points = STORED["points"]
    assert len(points) == 3
    for point in points:
        obtained = list(point["obtained"]["multisine"].values())
        assert point["seeds"] >= 60
        assert abs(np.mean(obtained) - 1) < 0.1
        assert max(obtained) < 1 + 4 / np.sqrt(2 * point["seeds"]), "no parameter alone beyond the draws"
        assert point["mean_std_percent"]["prbs_20ms"] > 1.5 * point["mean_std_percent"]["multisine"]
        assert point["wall"]["touched"] == 0
    assert sum(point["wall"]["draws"] for point in points) >= 1000
    assert summary(STORED).count("| 60 |") == 3


def test_the_length_reached_its_targets():
    length = STORED["length"]
    assert all(length["obtained"][name] < 1.1 * wanted for name, wanted in length["targets"].items())
    assert f"{length['duration_s']:g} s" in length_summary(STORED)
