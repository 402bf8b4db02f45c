"""Count how often 95 % intervals of a fit contain the truth, for errors of many kinds; store the numbers.

``python -m tests.benchmarks.coverage [--profile] [--quick] [--seeds N] [--output FILE]``
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

import gbid
from gbid.core.arrays import FloatArray
from gbid.core.notes import FitNote
from gbid.structure import LinearStructure, Parameter, evaluate
from tests.benchmarks.running import about, markdown, options_of, run_study

# ---- Oscillators and errors.

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
            results = {"A": [[0, 1], [-p.w * p.w, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}
            return {**results, "K": [[p.k1], [p.k2]]} if gain else results

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
    shifted = oscillator.simulated(random.normal(size=n + settle))
    unit = oscillator.simulated(np.eye(1, 20_000)[0])
    return np.asarray((shifted[settle:] / np.sqrt((unit**2).sum()) + random.normal(size=n)) / np.sqrt(2))


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
_AR: Mapping[str, Any] = {"errors": "ar", "focus": "simulation"}
CASES = (
    Case("white", _white),
    Case("AR(1), pole 0.9", _filtered(lambda _: np.array([0.9]))),
    Case("AR(1), pole 0.9", _filtered(lambda _: np.array([0.9])), options=_AR, words='`errors="ar"`'),
    Case("AR(1), pole -0.6", _filtered(lambda _: np.array([-0.6]))),
    Case("AR(2) at the resonance", _filtered(_at_resonance)),
    Case("AR(2) at the resonance", _filtered(_at_resonance), options=_AR, words='`errors="ar"`'),
    Case("AR(20)", _filtered(_twenty)),
    Case("AR(20)", _filtered(_twenty), options=_AR, words='`errors="ar"`'),
    Case("process noise", _process),
    Case("process noise", _process, options=_AR, words='`errors="ar"`'),
    Case("process noise", _process, words="disturbance gain free", gain=True),
    Case("hum", _hum),
    Case("hum", _hum, options={"hum": 17.0}, words="`hum=17.0`"),
    Case("drift", _drift, target=False),
    Case("drift", _drift, options={"trend": "linear"}, words='`trend="linear"`'),
    Case("spikes", _spikes, target=False),
    Case("quantisation, 2 std", _white, step=2.0, target=False),
)


# ---- Coverage of the standard deviations of a fit.

LENGTHS = (1000, 5000, 25_000)
TARGET = (0.92, 0.97)
_NOTED = 0.95  # share of the fits with a note, from which a cell counts as noted
_QUANTILE = 1.96  # of the normal distribution, for 95 %


class Coverage(NamedTuple):
    """Figures of one kind of errors at one length.

    Attributes
    ----------
    coverage : float
        Share of the intervals, of all parameters and seeds, that contain the truth.
    coverage_white : float
        The same with the standard deviations for white errors.
    stated : float
        Root mean square of the standard deviations over that of the errors, mean over the parameters.
    failed : int
        Number of fits that did not converge; they do not count.
    noted : float
        Share of the fits with the note that intervals may contain the truth less often than they state; nan in a run
        that did not count them.
    """

    coverage: float
    coverage_white: float
    stated: float
    failed: int
    noted: float = np.nan


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(
        __doc__,
        arguments,
        profile=(False, "standard deviations beside profile likelihoods, where the likelihood is no parabola"),
        quick=(False, "shortest recordings and few seeds, to see that it works"),
        seeds=(int, "recordings of each kind (default 60, with --profile 100)"),
    )
    seeds, first = 4 if options.quick else options.seeds, 1 if options.quick else None
    if options.profile:
        return run_study(lambda: measure_profiles(CURVED[:first], seeds or 100), options.output, profile_table)
    return run_study(lambda: measure(LENGTHS[:first], seeds or 60), options.output, coverage_table)


def measure(lengths: Sequence[int], seeds: int) -> dict[str, Any]:
    """All kinds of errors on all oscillators."""
    rows = [
        {
            "oscillator": oscillator.name,
            "errors": case.name,
            "options": case.words,
            "target": case.target,
            "cells": {str(n): cell(oscillator, case, n, seeds)._asdict() for n in lengths},
        }
        for oscillator in OSCILLATORS
        for case in CASES
    ]
    return {**about(), "seeds": seeds, "rows": rows}


def errors_of(
    oscillator: Oscillator, case: Case, n: int, seeds: int, *kinds: str, **options: Any
) -> tuple[FloatArray, list[FloatArray], float]:
    """Return the errors of the fits that converged, from starts near the truth, and their standard deviations by kind.

    Returns
    -------
    (n_fits, n_parameters) array
        Estimates minus truth.
    list of (n_fits, n_parameters) array
        Standard deviations of each kind; those of the result for an empty word.
    float
        Share of these fits with the note of low coverage.
    """
    truth = oscillator.truth
    off: list[list[float]] = []
    noted = 0
    std: list[list[list[float]]] = [[] for _ in kinds]
    for seed in range(seeds):
        recording = case.recording(oscillator, n, seed)
        result = gbid.fit(case.structure(oscillator), recording, start=truth, **case.options, **options)
        if not result.success:
            continue
        noted += any(FitNote.MAY_COVER_LESS.value in note for note in result.notes)
        off.append([result.parameters[name] - true for name, true in truth.items()])
        for kind, rows in zip(kinds, std, strict=True):
            values = result.std_with(kind) if kind else result.std  # type: ignore[arg-type]  # a word
            rows.append([values[name] for name in truth])
    return np.array(off), [np.array(rows) for rows in std], noted / max(len(off), 1)


def cell(oscillator: Oscillator, case: Case, n: int, seeds: int) -> Coverage:
    """Return the coverage of one kind of errors at one length."""
    off, (sigma, plain), noted = errors_of(oscillator, case, n, seeds, "", "white")
    ratio = np.sqrt((sigma**2).mean(axis=0) / (off**2).mean(axis=0))
    return Coverage(
        coverage=float((np.abs(off) < _QUANTILE * sigma).mean()),
        coverage_white=float((np.abs(off) < _QUANTILE * plain).mean()),
        stated=float(ratio.mean()),
        noted=noted,
        failed=seeds - len(off),
    )


def coverage_table(run: dict[str, Any]) -> str:
    """Return the coverage of all kinds as Markdown, in percent; in brackets with the white standard deviations."""
    lengths = list(run["rows"][0]["cells"])
    rows = [
        [row[key] for key in ("oscillator", "errors", "options")]
        + [_shown(Coverage(**row["cells"][n]), row["target"]) for n in lengths]
        for row in run["rows"]
    ]
    head = ("oscillator", "errors", "fit", *(f"N = {int(n):,}".replace(",", " ") for n in lengths))
    return markdown(head, rows, f"{run['seeds']} recordings in each cell, {run['date']}, gbid {run['gbid']}.")


def missed(run: dict[str, Any]) -> list[str]:
    """Return the cells that miss the target, in words, without those whose fits have the note in 95 % of the cases."""
    return [
        f"{row['oscillator']}, {row['errors']}, {row['options']}, N = {n}: {100 * numbers['coverage']:.1f} %"
        + (f"; {100 * numbers['noted']:.0f} % of the fits have the note" if "noted" in numbers else "")
        for row in run["rows"]
        for n, numbers in row["cells"].items()
        if row["target"]
        and not TARGET[0] <= numbers["coverage"] <= TARGET[1]
        and not numbers.get("noted", 0.0) >= _NOTED
    ]


def _shown(computed: Coverage, target: bool) -> str:
    inside = TARGET[0] <= computed.coverage <= TARGET[1]
    text = f"{100 * computed.coverage:.1f}"
    text = f"**{text}**" if target and not inside else text
    text += " !" if computed.noted >= _NOTED else ""
    left_out = f", {computed.failed} failed" if computed.failed else ""
    return f"{text} ({100 * computed.coverage_white:.0f}){left_out}"


# ---- Coverage of profile likelihoods beside that of standard deviations, where the likelihood is no parabola.


@dataclass(frozen=True)
class CurvedCase:
    """Small fit whose likelihood is no parabola.

    Attributes
    ----------
    name : str
        Name in the table.
    structure : LinearStructure
        Structure with the true values as start values.
    samples : int
        Number of samples.
    noise : float
        Standard deviation of the errors.
    counted : sequence of str
        Parameters whose intervals count.
    pole : float
        Pole of the errors, an autoregression; 0 for white ones.
    hold : int
        Number of samples for which the input stands; 0 for a step.
    sample_time : float
        Time between samples [s].
    """

    name: str
    structure: LinearStructure
    samples: int
    noise: float
    counted: Sequence[str]
    pole: float = 0.0
    hold: int = 7
    sample_time: float = SAMPLE_TIME

    @cached_property
    def truth(self) -> dict[str, float]:
        """True parameters."""
        return {q.name: float(q.start or 0.0) for q in self.structure.parameters}

    def recording(self, seed: int) -> gbid.Recording:
        """Return a recording with its own input and errors, from rest."""
        n, random = self.samples, np.random.default_rng([seed, 5])
        levels = random.choice([-1.0, 1.0], -(-n // max(self.hold, 1)))
        u = np.repeat(levels, self.hold)[:n, None] if self.hold else np.ones((n, 1))
        e = lfilter([np.sqrt(1 - self.pole**2)], [1.0, -self.pole], random.normal(size=n + _SETTLE))[_SETTLE:]
        y = evaluate(self.structure, self.truth).simulate(u, self.sample_time, intersample="zoh")
        return gbid.Recording({"u": u, "y": y + self.noise * e[:, None]}, self.sample_time, name=f"run-{seed}")


def _small(name: str, matrices: Callable[[Any], dict[str, Any]], lowest: float, **truth: float) -> LinearStructure:
    parameters = [
        Parameter(key, value, lower=lowest if key in ("d", "T", "tau") else -np.inf) for key, value in truth.items()
    ]
    return LinearStructure(name, parameters, matrices, inputs="u", outputs="y", intersample="zoh")


def _mode(damping: float) -> LinearStructure:
    truth = Oscillator("", damping, 0.0).truth
    return _small("mode", lambda p: {"A": [[0, 1], [-p.w * p.w, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}, 0.0, **truth)


def _late(tau: float) -> LinearStructure:
    def matrices(p: Any) -> dict[str, Any]:
        return {"A": [[-1 / p.T]], "B": [[0]], "B_delayed": [[p.g / p.T]], "delay": [p.tau], "C": [[1]]}

    return _small("late", matrices, 0.0, T=0.05, g=1.0, tau=tau)


def _pair(one: float, other: float) -> LinearStructure:
    def matrices(p: Any) -> dict[str, Any]:
        product = p.p1 * p.p2
        return {"A": [[0, 1], [-product, -p.p1 - p.p2]], "B": [[0], [p.g * product]], "C": [[1, 0]]}

    return _small("pair", matrices, 0.0, p1=one, p2=other, g=1.0)


_SLOW = _small("lag", lambda p: {"A": [[-1 / p.T]], "B": [[p.g / p.T]], "C": [[1]]}, 1e-3, T=3.0, g=1.0)
CURVED = (
    CurvedCase("5 % damping, 60 samples", _mode(0.05), 60, 0.5, ("w", "d", "b")),
    CurvedCase("damping of one standard deviation, bound 0", _mode(0.01), 100, 1.0, ("d",)),
    CurvedCase("damping 0 on its bound", _mode(0.0), 100, 1.0, ("d",)),
    CurvedCase("delay of a tenth of a sample, bound 0", _late(0.001), 200, 0.2, ("tau",), hold=5, sample_time=0.01),
    CurvedCase("delay 0 on its bound", _late(0.0), 200, 0.2, ("tau",), hold=5, sample_time=0.01),
    CurvedCase("time constant of three recordings", _SLOW, 100, 0.03, ("T", "g"), hold=0, sample_time=0.01),
    CurvedCase("poles of 10 and 18 1/s", _pair(10.0, 18.0), 300, 0.02, ("p1", "p2"), hold=20, sample_time=0.01),
    CurvedCase("poles of 10 and 12 1/s", _pair(10.0, 12.0), 300, 0.02, ("p1", "p2"), hold=20, sample_time=0.01),
    CurvedCase("5 % damping, 200 samples, AR(1), pole 0.9", _mode(0.05), 200, 0.3, ("w", "d", "b"), pole=0.9),
)


def measure_profiles(cases: Sequence[CurvedCase], seeds: int) -> dict[str, Any]:
    """All cases, fitted from the truth with the initial state at rest."""
    return {**about(), "seeds": seeds, "rows": [{"case": q.name, **profile_cell(q, seeds)} for q in cases]}


def profile_cell(case: CurvedCase, seeds: int) -> dict[str, float]:
    """Return the coverage of both, how often a profile is not two-sided, and the fits that failed.

    A parameter without a standard deviation has no interval from it, and counts as missed.
    """
    inside, verdicts, failed = [], [], 0
    for seed in range(seeds):
        fitted = gbid.fit(case.structure, case.recording(seed), start=case.truth, initial_state="zero")
        if not fitted.may_be_profiled:
            failed += 1
            continue
        for name in case.counted:
            profile, true = fitted.profile(name), case.truth[name]
            near = abs(fitted.parameters[name] - true) < _QUANTILE * fitted.std[name]
            inside.append([near, profile.interval[0] <= true <= profile.interval[1]])
            verdicts.append(profile.verdict == "identifiable")
    std, profiled = np.mean(inside, axis=0)
    return {"std": float(std), "profile": float(profiled), "open": 1 - float(np.mean(verdicts)), "failed": failed}


def profile_table(run: dict[str, Any]) -> str:
    """Return the coverage as Markdown, in percent."""
    rows = [[row["case"], *(f"{100 * row[key]:.1f}" for key in ("std", "profile", "open"))] for row in run["rows"]]
    failed = sum(row["failed"] for row in run["rows"])
    note = f"{run['seeds']} recordings in each row ({failed} fits failed), {run['date']}, gbid {run['gbid']}."
    return markdown(("case", "standard deviation", "profile", "one-sided or flat"), rows, note)


if __name__ == "__main__":
    raise SystemExit(main())
