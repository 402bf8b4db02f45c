"""Count how often 95 % intervals of fits to frequency responses contain the truth, beside fits to the same recordings.

``python -m tests.benchmarks.response_intervals [--seeds N] [--output FILE]``
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, dlsim

import gbid
from gbid.core.arrays import ComplexArray, FloatArray
from gbid.structure import LinearStructure, Parameter, Structure
from tests.benchmarks.running import about, markdown, options_of, run_study, under

STEP, PERIOD = 2e-4, 2500
_QUANTILE = 1.96

# ---- An oscillator of 100 Hz with a delay of one and a half samples, and a magnetic bearing in its loop.

OSCILLATOR = {"k": (200 * np.pi) ** 2, "d": 0.04 * 200 * np.pi, "g": 100.0, "tau": 1.5 * STEP}
BEARING = {"k_s_z": 2e5, "k_i_z": 80.0, "omega_amplifier": 2400 * np.pi, "tau_amplifier": 4e-5}


def oscillator() -> LinearStructure:
    """Return the structure, with start values off the truth."""

    def matrices(p: Any) -> dict[str, Any]:
        delayed = {"B_delayed": [[0], [p.g]], "delay": [[p.tau]]}
        return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [0]], "C": [[1, 0]], **delayed}

    starts = zip(OSCILLATOR, (3e5, 30.0, 50.0, 1e-4), strict=True)
    return LinearStructure("oscillator", [Parameter(name, start, lower=0.0) for name, start in starts], matrices)


def stated(seed: int) -> gbid.FrequencyData:
    """Return responses whose errors have the stated deviations."""
    f = np.linspace(5, 300, 120)
    s = 2j * np.pi * f
    exact = OSCILLATOR["g"] * np.exp(-s * OSCILLATOR["tau"]) / (s**2 + OSCILLATOR["d"] * s + OSCILLATOR["k"])
    std = 0.03 * float(np.abs(exact).mean())
    return gbid.FrequencyData(f, exact + std * _complex(np.random.default_rng(seed), len(f)), std=std)


def _complex(random: np.random.Generator, n: int) -> ComplexArray:
    return np.asarray([1, 1j] @ random.standard_normal((2, n)), complex)


def recorded(u: FloatArray, seed: int, noise: float) -> gbid.Recording:
    """Return a recording of the oscillator by scipy, in half samples because of the delay."""
    A, B = np.array([[0, 1], [-OSCILLATOR["k"], -OSCILLATOR["d"]]]), np.array([[0], [OSCILLATOR["g"]]])
    half = cont2discrete((A, B, np.eye(1, 2), np.zeros((1, 1))), STEP / 2)
    y = dlsim((*half[:4], STEP / 2), np.concatenate([np.zeros(3), np.repeat(u, 2)[:-3]]))[1][::2, 0]
    return gbid.Recording({"u": u, "y": y + noise * np.random.default_rng([seed, 1]).standard_normal(len(u))}, STEP)


def multisine(seed: int) -> gbid.Recording:
    """Return a recording of nine periods of a multisine."""
    lines, phases = np.arange(5, 400), np.random.default_rng(seed).uniform(0, 2 * np.pi, 395)
    period = np.cos(2 * np.pi * np.outer(np.arange(PERIOD), lines) / PERIOD + phases).sum(axis=1)
    return recorded(np.tile(period, 9), seed, 1e-4)


def random_input(seed: int) -> gbid.Recording:
    """Return a recording with an input that jumps at random."""
    u = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 6000), 5)
    return recorded(u, seed, 1e-5)


def loop_responses(seed: int) -> gbid.FrequencyData:
    """Return the responses of current and position to what is injected; noise of the sensor is in both."""
    random, s = np.random.default_rng(seed), 2j * np.pi * np.geomspace(5, 600, 150)
    k_s, k_i, omega, tau = BEARING.values()
    plant, controller = k_i / (2.0 * s**2 - k_s) * np.exp(-s * tau) / (1 + s / omega), 6000 + 12 * s / (1 + s / 6000)
    sensor, amplifier = 3e-7 * _complex(random, len(s)), 4e-5 * _complex(random, len(s))
    sensitivity = 1 / (1 + plant * controller)
    current, position = sensitivity * (1 - controller * sensor) + amplifier, sensitivity * (plant + sensor)
    std = np.array([np.abs(controller * sensitivity) * 3e-7 + 4e-5, np.abs(sensitivity) * 3e-7]).T
    responses = np.array([current, position]).T
    return gbid.FrequencyData(
        s.imag / (2 * np.pi), responses[:, :, None], std[:, :, None], inputs="r", outputs=["i", "p"], name="loop"
    )


# ---- The study.


@dataclass(frozen=True)
class Case:
    """Kind of data: its words, the structure, the truth, responses and the recording behind them, from a seed."""

    name: str
    structure: Structure
    truth: dict[str, float]
    responses: Callable[[Any], gbid.FrequencyData]
    recording: Callable[[int], gbid.Recording] | None = None


CASES = (
    Case("stated deviations, 120 lines", oscillator(), OSCILLATOR, stated),
    Case(
        "multisine, nine periods",
        oscillator(),
        OSCILLATOR,
        lambda recording: gbid.measured_response(recording, "u", "y", period_s=PERIOD * STEP),
        multisine,
    ),
    Case(
        "random input, segments (Welch)",
        oscillator(),
        OSCILLATOR,
        lambda recording: gbid.measured_response(recording, "u", "y", resolution_hz=1.0),
        random_input,
    ),
    Case(
        "magnetic bearing, responses of its loop",
        gbid.MagneticBearing(gbid.structure.RigidRotor(mass_kg=2.0)),
        BEARING,
        lambda seed: loop_responses(seed).channels("i", "p", reference="r"),
    ),
)


def measure(seeds: int) -> dict[str, Any]:
    """All kinds of data."""
    return {**about(), "seeds": seeds, "rows": [{"case": case.name, **cell(case, seeds)} for case in CASES]}


def cell(case: Case, seeds: int) -> dict[str, float | None]:
    """Return coverage with the standard deviations of the fit and with the white ones, and how near the time fits are.

    `near` is the share of parameters within one standard deviation of the fit to the recording in time; `told` the
    share of fits with the word that the structure leaves something out.
    """
    off, std, white, near, told = [], [], [], [], 0
    for seed in range(seeds):
        source: Any = seed if case.recording is None else case.recording(seed)
        result = gbid.fit(case.structure, case.responses(source))
        if not result.success:
            continue
        told += result.trusted == "none"
        names = list(case.truth)
        off.append([result.parameters[q] - case.truth[q] for q in names])
        std.append([result.std[q] for q in names])
        white.append([result.std_with("white")[q] for q in names])
        if case.recording is not None:
            in_time = gbid.fit(case.structure, source, focus="simulation")
            near.append([abs(result.parameters[q] - in_time.parameters[q]) < in_time.std[q] for q in names])
    errors, sigma = np.array(off), np.array(std)
    return {
        "coverage": float((np.abs(errors) < _QUANTILE * sigma).mean()),
        "coverage_white": float((np.abs(errors) < _QUANTILE * np.array(white)).mean()),
        "rms": float(np.sqrt(np.mean((errors / sigma) ** 2))),
        "told": told / max(len(off), 1),
        "near": float(np.mean(near)) if near else None,
        "failed": seeds - len(off),
    }


def table(run: dict[str, Any]) -> str:
    """Return the study as Markdown, in percent."""
    rows = [
        [
            row["case"],
            f"{100 * row['coverage']:.1f} ({100 * row['coverage_white']:.0f})",
            f"{row['rms']:.2f}",
            "-" if row["near"] is None else f"{100 * row['near']:.0f}",
            f"{100 * row['told']:.0f}",
        ]
        for row in run["rows"]
    ]
    head = ("data", "within 95 %", "rms error [std]", "within 1 std of the time fit", "GB123")
    failed = sum(row["failed"] for row in run["rows"])
    return markdown(head, rows, under(run, f"{run['seeds']} seeds in each row ({failed} fits failed)"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(__doc__, arguments, "response-intervals.json", seeds=(200, "data sets of each kind"))
    return run_study(lambda: measure(options.seeds), options.output, table)


if __name__ == "__main__":
    raise SystemExit(main())
