"""Phase of a frequency response, against the sum of the angles of poles and zeros, each followed from rest."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import zpk2ss

import gbid
from gbid.identify.uncertainty.curves import bode
from gbid.structure import LinearModel
from gbid.structure.models import phase_in_degrees

F = np.array([1000.0, 0.01, 1.0, 30.0])  # coarse, and in any order


def angle(root: complex) -> np.ndarray:
    """Angle of jw - root in degrees, from its value at rest on; 90 for a root at zero."""
    way = 2j * np.pi * np.linspace(1e-9, 1, 20_001)[:, None] * F - root
    return np.degrees(np.unwrap(np.angle(way), axis=0)[-1])


@pytest.mark.parametrize(
    ("zeros", "poles", "gain", "turns"),
    [
        ([], [0, 0, 0], 1, 0),
        ([], [0, -1, -2], 2, 0),
        ([], [1], 1, 0),
        ([-1], [0, -2], 1, 0),
        ([], [-1], -1, 0),
        ([1], [-1], -1, -1),  # from 0 degrees on
        ([0], [-1, -1], 1, 0),
        ([], [-0.1 + 100j, -0.1 - 100j], 1, 0),
        ([-0.001 + 50j, -0.001 - 50j], [-0.1 + 100j, -0.1 - 100j, -1, 0], 1, 0),
        ([0.001 + 50j, 0.001 - 50j], [-0.1 + 100j, -0.1 - 100j, -1, 0], 1, 0),
        ([], [100j, -100j], 1, 0),
    ],
)
def test_phase_is_counted_from_the_poles(zeros: list, poles: list, gain: float, turns: int) -> None:
    model = LinearModel(*zpk2ss(zeros, poles, gain))
    expected = sum(map(angle, zeros)) - sum(map(angle, poles)) + (180 if gain < 0 else 0) + 360 * turns
    np.testing.assert_allclose(phase_in_degrees(model, F)[:, 0, 0], expected, atol=1e-4)


def test_a_long_delay_is_in_csv_as_in_the_picture(tmp_path: Path) -> None:
    f = np.array([0.3, 2.0, 11.0, 90.0])
    late = LinearModel([[-1.0]], [[0.0]], [[1.0]], [[0.0]], B_delayed=[[1.0]], delay=[2.0])
    expected = -np.degrees(np.arctan(2 * np.pi * f)) - 720 * f
    np.testing.assert_allclose(bode(late, f).phase_deg[:, 0, 0], expected, atol=1e-6)
    with gbid.export.save_csv(late, tmp_path / "late.csv", frequency_hz=f).open() as file:
        rows = list(csv.reader(file))[1:]
    np.testing.assert_allclose([float(row[2]) for row in rows], expected, atol=1e-6)
    both = LinearModel([[-1.0]], [[0.1]], [[1.0]], [[0.0]], B_delayed=[[1.0]], delay=[2.0])  # followed in fine steps
    most = np.degrees(np.arcsin(0.1))
    assert np.abs(phase_in_degrees(both, f)[:, 0, 0] - expected).max() < most


def test_a_sampled_integrator_and_a_channel_without_effect() -> None:
    model = LinearModel([[1.0]], [[1.0, 0.0]], [[1.0]], [[0.0, 0.0]], dt=0.01)
    phase = phase_in_degrees(model, [0.1, 1.0, 49.0])
    np.testing.assert_allclose(phase[:, 0, 0], -90 - 180 * 0.01 * np.array([0.1, 1.0, 49.0]), atol=1e-6)
    assert not phase[:, 0, 1].any()
