"""Modes that a run prints are those of each operating point, with intervals that cover the scatter of the models."""

import numpy as np
import pytest

from gbid.report.views import modes_by_point, summary_lines

POINTS = {f"{point}_{i}": point for point in ("p3_n0", "p5_n6000") for i in range(5)}


def fit(recording, frequency, std=0.001, success=True):
    mode = {"frequency_hz": frequency, "frequency_std_hz": std, "damping": 0.02, "damping_std": 1e-4}
    place = {"fit": "bearing", "model": recording, "recordings": [recording]}
    return {**place, "success": success, "modes": [mode], "notes": []}


def test_modes_are_those_of_each_operating_point():
    scattered = {"p3_n0": 90 + np.array([0.3, -0.2, 0.1, -0.4, 0.2]), "p5_n6000": np.full(5, 131.0)}
    fits = [fit(name, scattered[point][int(name[-1])]) for name, point in POINTS.items()]
    slow, fast = modes_by_point([*fits, fit("p3_n0_1", 200.0, success=False)], POINTS)
    assert (slow.point, slow.models, fast.point, fast.models) == ("p3_n0", 5, "p5_n6000", 5)
    assert slow.frequency_hz == pytest.approx(90.0)
    assert slow.frequency_std_hz == pytest.approx(np.std(scattered["p3_n0"], ddof=1))  # far above the 0.001 Hz stated
    assert (fast.frequency_hz, fast.frequency_std_hz) == pytest.approx((131.0, 0.001))


def test_many_points_are_ranges():
    fits = [fit(f"r{i}", 90.0 + i) for i in range(10)]
    lines = summary_lines({"fits": fits, "crossval_summary": [], "lpv": [], "tuning": []}, {})
    assert lines[1:] == ["  bearing mode 1: 90 to 99 Hz, damping 0.02 to 0.02 at 10 points"]
