"""The fit that is timed: the published machine at 6 bar, 0 rpm, 24 unknowns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from gbid import Recording, load_model
from gbid.core.arrays import FloatArray
from gbid.structure import PiezoPair, RotorBearing, evaluate

SAMPLE_TIME = 2e-4  # s, the paper's
STRUCTURE = RotorBearing(pade_order=1, disturbance_gain="full")
N_STATES = 6
N_UNKNOWNS = len(STRUCTURE.parameters) + N_STATES
_POINT = (6.0, 0.0)  # bar, rpm
_NOISE = 30e-9  # m
_HOLD = 40  # samples for which a reference stands
_AMPLITUDE = 4.5e-6  # m


@dataclass(frozen=True, eq=False)
class Samples:
    """A recording as plain arrays.

    Attributes
    ----------
    u : (n_samples, 2) array
        Piezo positions [m].
    p : (n_samples, 2) array
        Rotor positions [m].
    """

    u: FloatArray
    p: FloatArray

    def recording(self) -> Recording:
        """The same as gbid takes it."""
        return Recording({"u": self.u, "p": self.p}, SAMPLE_TIME, name="benchmark")

    def save(self, path: Path) -> None:
        np.savez(path, u=self.u, p=self.p)

    @staticmethod
    def load(path: Path) -> Samples:
        with np.load(path) as file:
            return Samples(file["u"], file["p"])


# The seed is one with which every method finds the same optimum at 2 000 samples too, the length of a quick run. That
# short, with four of seeds 1 to 10 gbid's predictor turns unstable and it holds the disturbance gain, and with some (b)
# does not converge in 100 iterations. At 5 000 samples gbid estimates all unknowns with each of seeds 1 to 20.
def make_samples(n_samples: int, seed: int = 9) -> Samples:
    """Simulate a recording: binary references through the published actuators, the rotor, white sensor noise."""
    machine = load_model("theisen2016")
    random = np.random.default_rng(seed)
    levels = random.choice([-_AMPLITUDE, _AMPLITUDE], (-(-n_samples // _HOLD), 2))
    actuators = evaluate(PiezoPair(), dict(machine.actuators))
    u = actuators.simulate(np.repeat(levels, _HOLD, axis=0)[:n_samples], SAMPLE_TIME, intersample="zoh")
    none = {q.name: 0.0 for q in STRUCTURE.parameters if q.name.startswith("bd")}
    model = evaluate(STRUCTURE, {**machine.key_parameters(*_POINT), **none})
    p = model.simulate(u, SAMPLE_TIME, intersample="foh")
    return Samples(u, p + _NOISE * random.standard_normal(p.shape))


def sampled(A: FloatArray, B: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sample ``xd = A x + B u + K e``, u linear between samples and e held, by one matrix exponential.

    Returns
    -------
    F : (n, n) array
    G : (n, 2 n_u + n_y) array
        ``x[k+1] = F x[k] + G [u[k], u[k+1], e[k]]``.
    """
    n, n_u, n_y = len(A), B.shape[1], K.shape[1]
    big = np.zeros((n + 2 * n_u + n_y,) * 2)
    big[:n] = np.hstack([A, B, np.zeros((n, n_u)), K]) * SAMPLE_TIME
    big[n : n + n_u, n + n_u : n + 2 * n_u] = np.eye(n_u)
    step = expm(big)[:n]
    now, slope = step[:, n : n + n_u], step[:, n + n_u : n + 2 * n_u]
    return step[:, :n], np.hstack([now - slope, slope, step[:, n + 2 * n_u :]])
