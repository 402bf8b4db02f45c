"""Example data of templates: csv files as a data logger writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gbid.arrays import FloatArray
from gbid.structure import LinearModel


def write_example_data(path: Path, seed: int, n_samples: int = 4000, sample_time: float = 5e-4) -> None:
    """Write a CSV file like that of a data logger: a mass on a spring, 40 Hz, damping factor 0.05, random input.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    seed : int
        Seed of the random numbers.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    """
    random = np.random.default_rng(seed)
    omega = 2 * np.pi * 40.0
    model = LinearModel(
        np.array([[0.0, 1.0], [-(omega**2), -2 * 0.05 * omega]]),
        np.array([[0.0], [2.0]]),
        np.array([[1.0, 0.0]]),
        np.array([[0.0]]),
    )
    volt = np.repeat(random.choice([-1.0, 1.0], size=-(-n_samples // 8)), 8)[:n_samples]
    metre = model.simulate(volt[:, None], sample_time)[:, 0] + 2e-7 * random.standard_normal(n_samples)
    time = 1e3 * sample_time * np.arange(n_samples)
    rows = np.column_stack([time, volt, 1e6 * metre])
    np.savetxt(path, rows, delimiter=",", header="time [ms],drive [V],position [um]", comments="", fmt="%.6g")


def write_held_bearing(path: Path, seed: int, n_samples: int = 6000, sample_time: float = 1e-4) -> None:
    """Write a CSV file of a magnetic bearing that a PD controller holds, with a random current added to its output.

    The bearing has the negative stiffness 4e4 N/(kg m), the damping 2 N s/(kg m) and the gain 60 N/(kg A).

    Parameters
    ----------
    path : pathlib.Path
        The file.
    seed : int
        Seed of the random numbers.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    """
    random = np.random.default_rng(seed)
    stiffness, gain = 4e4, 60.0
    rate = stiffness**0.5  # the poles are about +- this, in 1/s
    A = np.array([[np.cosh(rate * sample_time), np.sinh(rate * sample_time) / rate], [0.0, 0.0]])
    A[1] = [rate * np.sinh(rate * sample_time), np.cosh(rate * sample_time)]
    A[:, 1] *= np.exp(-2.0 * sample_time)  # damping
    B = gain * np.array([(np.cosh(rate * sample_time) - 1) / stiffness, np.sinh(rate * sample_time) / rate])
    added = np.repeat(random.choice([-0.15, 0.15], -(-n_samples // 20)), 20)[:n_samples]
    noise = 1e-6 * random.standard_normal(n_samples)
    current, position = np.empty(n_samples), np.empty(n_samples)
    x: FloatArray = np.zeros(2)
    before, velocity = 0.0, 0.0
    for k in range(n_samples):
        position[k] = x[0] + noise[k]
        velocity += 0.3 * ((position[k] - before) / sample_time - velocity)
        before = position[k]
        current[k] = added[k] - (5 * stiffness * position[k] + 2.8 * rate * velocity) / gain
        x = A @ x + B * current[k]
    rows = np.column_stack([1e3 * sample_time * np.arange(n_samples), added, current, 1e6 * position])
    header = "time [ms],added [A],current [A],position [um]"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.6g")
