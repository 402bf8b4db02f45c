"""Data with few samples: what counts is the number of measured values over all recordings, against the unknowns."""

import casadi as ca
import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, H, levels, simulated

from gbid.identify import fit
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter

FREE = {"l1": 0.0, "l2": 0.0}


def with_missing_rows(recording, rows=15):
    padded = {name: np.vstack([recording.signal(name), np.full((rows, 1), fill)]) for name, fill in FILL.items()}
    return Recording(padded, H, name=recording.name)


FILL = {"u": 0.0, "y": np.nan}


def test_many_short_recordings_are_as_those_with_missing_rows():
    short = [
        simulated(MODE, MODE_AT, levels(9, seed=k), x0=[0.3, k % 3 - 1.0], noise=0.02, seed=k, name=f"run {k}")
        for k in range(20)
    ]
    result, padded = (fit(MODE, each, fixed=FREE) for each in (short, [with_missing_rows(r) for r in short]))
    assert result.success
    for name in result.free:
        assert result.parameters[name] == pytest.approx(padded.parameters[name], abs=1e-3 * padded.std[name])
        assert result.std[name] == pytest.approx(padded.std[name], rel=1e-3)
        assert abs(result.parameters[name] - MODE_AT[name]) < 4 * result.std[name]


def test_six_samples_of_a_certified_curve():
    """NIST StRD, BoxBOD: b1 (1 - exp(-b2 x)) as a lag that a step drives, at irregular times."""
    lag = LinearStructure(
        "lag",
        [Parameter("b1", 100.0, 0.0), Parameter("b2", 0.75, 0.0)],
        lambda p: {"A": [[-p.b2]], "B": [[p.b1 * p.b2]], "C": [[1]], "x0": [p.b1 * (1 - ca.exp(-p.b2))]},
    )
    times, values = [1.0, 2.0, 3.0, 5.0, 7.0, 10.0], [109.0, 149.0, 149.0, 191.0, 213.0, 224.0]
    result = fit(lag, Recording({"u": np.ones(6), "y": np.array(values)}, stamps=np.array(times)), focus="simulation")
    certified = {"b1": (213.80940889, 12.354515176), "b2": (0.54723748542, 0.10455993237)}
    for name, (value, std) in certified.items():
        assert result.parameters[name] == pytest.approx(value, abs=1e-4 * std)
        assert result.std[name] == pytest.approx(std, rel=1e-4)
