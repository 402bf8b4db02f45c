"""Oscillators and errors of the coverage study: what the fits are given, and what they are told of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.signal import lfilter

import gbid
from gbid.core.arrays import FloatArray
from gbid.structure import LinearStructure, Parameter, evaluate

SAMPLE_TIME = 0.005
_SETTLE = 3000  # samples before the recording, in which the errors become stationary


@dataclass(frozen=True)
class Oscillator:
    """One mode with a force as input and its motion as output.

    Attributes
    ----------
    name : str
        Name in the table.
    damping : float
        Damping factor; the natural frequency is 10 Hz.
    noise : float
        Standard deviation of the errors; the static gain is one, and the input jumps between -1 and 1.
    """

    name: str
    damping: float
    noise: float

    @property
    def truth(self) -> dict[str, float]:
        """True parameters: natural frequency [rad/s], damping 2 zeta w [1/s], gain."""
        w = 2 * np.pi * 10.0
        return {"w": w, "d": 2 * self.damping * w, "b": w**2}

    def structure(self, *, gain: bool = False) -> LinearStructure:
        """Return the structure, with a free disturbance gain on request."""
        names = [*self.truth, *(["k1", "k2"] if gain else [])]
        parameters = [Parameter(name, self.truth.get(name, 0.0)) for name in names]

        def matrices(p: Any) -> dict[str, Any]:
            found = {"A": [[0, 1], [-p.w * p.w, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}
            return {**found, "K": [[p.k1], [p.k2]]} if gain else found

        return LinearStructure(self.name, parameters, matrices, inputs="u", outputs="y", intersample="zoh")

    def simulated(self, u: FloatArray) -> FloatArray:
        """Return the motion for a force (n,), (n,)."""
        return np.asarray(self._model.simulate(u[:, None], SAMPLE_TIME, intersample="zoh")[:, 0])

    @cached_property
    def _model(self) -> gbid.LinearModel:
        return evaluate(self.structure(), self.truth)


@dataclass(frozen=True)
class Case:
    """Kind of errors, and the options of the fit.

    Attributes
    ----------
    name : str
        Name in the table.
    errors : callable
        Returns the errors, (n,), for an oscillator, a number of samples and random numbers; of unit power.
    options : dict
        Options of `gbid.fit`.
    words : str
        The options in words.
    gain : bool
        Whether the structure has a free disturbance gain.
    step : float
        Step of the quantisation of the output, in standard deviations of the errors; 0 for none.
    target : bool
        Whether the coverage is to be 92 to 97 %.
    """

    name: str
    errors: Callable[[Oscillator, int, np.random.Generator], FloatArray]
    options: Mapping[str, Any] = field(default_factory=dict)
    words: str = "plain"
    gain: bool = False
    step: float = 0.0
    target: bool = True

    def structure(self, oscillator: Oscillator) -> LinearStructure:
        """Return the structure to fit."""
        return oscillator.structure(gain=self.gain)

    def recording(self, oscillator: Oscillator, n: int, seed: int) -> gbid.Recording:
        """Return a recording of its own input and errors."""
        random = np.random.default_rng([seed, n])
        u = np.repeat(random.choice([-1.0, 1.0], -(-n // 7)), 7)[:n]
        y = oscillator.simulated(u) + oscillator.noise * self.errors(oscillator, n, random)
        if self.step:
            y = self.step * oscillator.noise * np.round(y / (self.step * oscillator.noise))
        return gbid.Recording({"u": u[:, None], "y": y[:, None]}, SAMPLE_TIME, name=f"run-{seed}")


def _white(_: Oscillator, n: int, random: np.random.Generator) -> FloatArray:
    return random.normal(size=n)


def _filtered(poles: Callable[[Oscillator], FloatArray]) -> Callable[..., FloatArray]:
    """Return errors of an autoregression with these poles, of unit power."""

    def errors(oscillator: Oscillator, n: int, random: np.random.Generator) -> FloatArray:
        a = np.poly(poles(oscillator)).real
        power = float((lfilter([1.0], a, np.eye(1, 20_000)[0]) ** 2).sum())
        return np.asarray(lfilter([1.0], a, random.normal(size=n + _SETTLE))[_SETTLE:] / np.sqrt(power))

    return errors


def _pairs(radii: FloatArray, angles: FloatArray) -> FloatArray:
    half = radii * np.exp(1j * angles)
    return np.concatenate([half, half.conj()])


def _at_resonance(oscillator: Oscillator) -> FloatArray:
    return _pairs(np.array([0.99]), np.array([oscillator.truth["w"] * SAMPLE_TIME]))


def _twenty(_: Oscillator) -> FloatArray:
    random = np.random.default_rng(77)
    return _pairs(random.uniform(0.7, 0.97, 10), random.uniform(0.02, np.pi - 0.02, 10))


def _process(oscillator: Oscillator, n: int, random: np.random.Generator) -> FloatArray:
    """Motion that an unknown white force makes, as large as the noise of the sensor."""
    settle = _SETTLE if oscillator.damping > 0.01 else 4 * _SETTLE
    moved = oscillator.simulated(random.normal(size=n + settle))
    unit = oscillator.simulated(np.eye(1, 20_000)[0])
    return np.asarray((moved[settle:] / np.sqrt((unit**2).sum()) + random.normal(size=n)) / np.sqrt(2))


def _hum(_: Oscillator, n: int, random: np.random.Generator) -> FloatArray:
    """Noise, and hum of 17 Hz and twice its standard deviation, at a random phase."""
    t = SAMPLE_TIME * np.arange(n)
    return np.asarray(random.normal(size=n) + 2 * np.sqrt(2) * np.sin(2 * np.pi * (17 * t + random.uniform())))


def _drift(_: Oscillator, n: int, random: np.random.Generator) -> FloatArray:
    """Noise, and a drift over the recording of ten times its standard deviation."""
    return np.asarray(random.normal(size=n) + np.linspace(0, 10, n))


def _spikes(_: Oscillator, n: int, random: np.random.Generator) -> FloatArray:
    """Noise, and spikes of twenty times its standard deviation in one sample of two hundred."""
    return np.asarray(random.normal(size=n) + 20 * random.choice([-1, 0, 1], size=n, p=[0.0025, 0.995, 0.0025]))


OSCILLATORS = (Oscillator("0.27 % damping", 0.0027, 0.5), Oscillator("5 % damping", 0.05, 0.2))
CASES = (
    Case("white", _white),
    Case("AR(1), pole 0.9", _filtered(lambda _: np.array([0.9]))),
    Case("AR(1), pole -0.6", _filtered(lambda _: np.array([-0.6]))),
    Case("AR(2) at the resonance", _filtered(_at_resonance)),
    Case("AR(20)", _filtered(_twenty)),
    Case("process noise", _process),
    Case("process noise", _process, words="disturbance gain free", gain=True),
    Case("hum", _hum),
    Case("hum", _hum, options={"hum": 17.0}, words="`hum=17.0`"),
    Case("drift", _drift, target=False),
    Case("drift", _drift, options={"trend": "linear"}, words='`trend="linear"`'),
    Case("spikes", _spikes, target=False),
    Case("quantisation, 2 std", _white, step=2.0, target=False),
)
