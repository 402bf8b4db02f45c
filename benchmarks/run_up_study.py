"""Surfaces from run-ups: how few recordings of changing pressure and speed replace a campaign at constant points.

``python -m benchmarks.run_up_study`` makes the recordings on the rig, fits the scheduled plant to one, three and six of
them, and stores the figures in docs/run-up.json. The machine is the published model with exact delays, unbalance,
run-out and the noise of the paper's campaign; it repeats exactly. The campaign of 86 recordings is represented by the
information of one recording at each of its 15 points, counted five or six times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import gbid
from benchmarks.running import markdown, options_of, store, timed
from benchmarks.running import stored as stored_run
from gbid import Recording
from gbid.lpv import LPVFit, regressors
from gbid.rig import Course, Machine, Prbs, ScheduledRun, SensorChain, Stationary, record
from gbid.structure import KEY_PARAMETERS

NOISE = {"noise_p_m": (0.65e-6, 0.5e-6), "noise_u_m": 45e-9}
SLOW_RPM = 600.0
PIECE_S = 0.2
_THREE = ["run-up, 3 bar", "coast-down, 7 bar", "pressure ramp, 3000 rpm"]
RUNS: dict[str, list[str]] = {
    "one recording": ["zigzag"],
    "three recordings": _THREE,
    "six recordings": [*_THREE, "run-up, pressure falls", "run-up, 5 bar", "pressure ramp, 6000 rpm"],
}
"""Recordings of each fit."""


def courses(duration_s: float) -> dict[str, Course]:
    """Return the course of each recording."""
    fifth = duration_s / 5
    return {
        "run-up, 3 bar": Course.ramp(duration_s, 3.0, (0.0, 6000.0)),
        "coast-down, 7 bar": Course.coast_down(duration_s, 7.0, 6000.0, 300.0),
        "pressure ramp, 3000 rpm": Course.ramp(duration_s, (3.0, 7.0), 3000.0),
        "run-up, pressure falls": Course.ramp(duration_s, (7.0, 3.0), (0.0, 6000.0)),
        "run-up, 5 bar": Course.ramp(duration_s, 5.0, (0.0, 6000.0)),
        "pressure ramp, 6000 rpm": Course.ramp(duration_s, (3.0, 7.0), 6000.0),
        "zigzag": Course(
            tuple(i * fifth for i in range(6)),
            (3.0, 7.0, 3.0, 5.0, 7.0, 3.0),
            (0.0, 2000.0, 6000.0, 0.0, 6000.0, 3000.0),
        ),
    }


def the_machine(pressure_bar: float, speed_rpm: float) -> Machine:
    """Return the machine at a point; along a course only its sensors, piezos and unbalance count."""
    model = gbid.load_model("theisen2016")
    key_parameters = model.key_parameters(pressure_bar, speed_rpm)
    return Machine.from_parameters(key_parameters, model.actuators, sensors=SensorChain(**NOISE))


def run_up(name: str, duration_s: float, seed: int) -> Recording:
    """Return a recording along a course, less the run-out of a slow roll, with the signal of the unbalance."""
    model, course = gbid.load_model("theisen2016"), courses(duration_s)[name]
    machine = the_machine(3.0, 0.0)
    made = record(
        machine, ScheduledRun(course, Prbs(duration_s)), conditions={}, seed=seed, name=name,
        surfaces=model.key_parameters,
    )  # fmt: skip
    point = {"pressure_bar": 5.0, "speed_rpm": SLOW_RPM}
    still = record(the_machine(**point), Stationary(5.0), conditions=point, seed=seed, name="slow roll")
    clean, _ = gbid.prefilter(made, gbid.identify_runout(still), any_condition=True, remove_mean=False)
    return gbid.with_unbalance(clean)


def surfaces(recordings: Sequence[Recording], piece_s: float = PIECE_S) -> LPVFit:
    """Return the surfaces of a fit to recordings along courses."""
    bearing = gbid.RotorBearing(delay="exact", disturbance_gain="none", unbalance=True)
    structure = gbid.scheduled(gbid.Plant(bearing), piece_s=piece_s)
    result = gbid.fit(structure, recordings, focus="simulation", trend="offset")
    return gbid.lpv_of(result)


def grid() -> tuple[Any, Any]:
    """Return pressures and speeds over the rectangle, each (63,)."""
    pressure, speed = np.meshgrid(np.linspace(3, 7, 9), np.linspace(0, 6000, 7))
    return pressure.ravel(), speed.ravel()


def against_truth(fit: LPVFit) -> dict[str, float]:
    """Return errors over the rectangle in standard deviations, errors of frequencies, and standard deviations."""
    truth = true_values()
    # A course that ends at 300 rpm leaves a margin of the rectangle.
    computed, std = regressors(*grid()) @ fit.coefficients.T, spread(fit.covariance)
    z = np.abs(computed - truth) / std
    frequency = np.abs(frequencies(computed) - frequencies(truth))
    return {
        "within_3_std_percent": float(100 * np.mean(z <= 3)),
        "rms_std": float(np.sqrt(np.mean(z**2))),
        "largest_std": float(z.max()),
        "largest_frequency_error_hz": float(frequency.max()),
        "relative_std_percent": relative_std(fit.covariance),
    }


def true_values() -> Any:
    """Return the key parameters of the machine over the grid, (63, 14)."""
    values = gbid.load_model("theisen2016").key_parameters(*grid())
    return np.column_stack([values[key] for key in KEY_PARAMETERS])


def relative_std(covariance: Any) -> float:
    """Return the standard deviations over the grid, relative to the sizes of the key parameters [%]."""
    size = np.sqrt(np.mean(true_values() ** 2, axis=0))
    return float(100 * np.sqrt(np.mean((spread(covariance) / size) ** 2)))


def spread(covariance: Any) -> Any:
    """Return the standard deviations of the key parameters over the grid, (63, 14)."""
    X = regressors(*grid())
    blocks = covariance.reshape(14, 6, 14, 6)
    return np.sqrt(np.stack([np.einsum("ij,jk,ik->i", X, blocks[a, :, a], X) for a in range(14)], axis=1))


def frequencies(values: Any) -> Any:
    """Return both natural frequencies [Hz] for key parameters (n, 14)."""
    rows = []
    for row in values:
        K, D = (np.reshape(row[i : i + 4], (2, 2)) for i in (0, 4))
        poles = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]]))
        rows.append(np.sort(np.abs(poles[poles.imag > 0])))
    return np.array(rows) / (2 * np.pi)


def campaign(seed: int) -> float:
    """Return the relative standard deviation [%] of the surfaces of 86 recordings of 5 s at 15 points."""
    bearing = gbid.RotorBearing(delay="exact", disturbance_gain="none")
    A, none = np.zeros((84, 84)), np.zeros((2, 0))
    for pressure, speed in gbid.load_model("theisen2016").operating_points:
        count = 5 if (pressure, speed) in _FIVE else 6
        machine = replace(the_machine(pressure, speed), unbalance=gbid.rig.Unbalance(0.0))
        machine = replace(machine, sensors=SensorChain(**NOISE, runout_amplitude_m=none, runout_phase_rad=none))
        point = {"pressure_bar": pressure, "speed_rpm": speed}
        made = record(machine, Prbs(5.0), conditions=point, seed=seed, name="campaign")
        result = gbid.fit(gbid.Plant(bearing), made, focus="simulation", trend="offset")
        columns = [result.free.index(key) for key in KEY_PARAMETERS]
        X = np.kron(np.eye(14), regressors([pressure], [speed]))
        A += count * X.T @ np.linalg.inv(result.covariance_white[np.ix_(columns, columns)]) @ X
    size = 1 / np.sqrt(np.diag(A))
    return relative_std(np.linalg.inv(A * np.outer(size, size)) * np.outer(size, size))


_FIVE = {(6.0, 6000.0), (7.0, 0.0), (7.0, 4000.0), (7.0, 6000.0)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and store its figures."""
    given = options_of(
        __doc__,
        arguments,
        "run-up.json",
        duration=(10.0, "length of each recording [s]"),
        seed=(1, "of noise and excitation"),
        runs=(tuple(RUNS), "which of them"),
        campaign=(False, "also the reference of 86 recordings"),
    )
    stored = stored_run(given.output, {"runs": {}})
    stored |= {"duration_s": given.duration, "piece_s": PIECE_S, "seed": given.seed}
    made: dict[str, Recording] = {}
    for word in given.runs:
        for name in RUNS[word]:
            made.setdefault(name, run_up(name, given.duration, given.seed))
        fit, spent = timed(partial(surfaces, [made[name] for name in RUNS[word]]))
        stored["runs"][word] = {
            **against_truth(fit),
            "recordings": len(RUNS[word]),
            "pieces": int(fit.options["pieces"]),
            "cpu_s": spent,
            "status": str(fit.status),
            "coefficients": fit.coefficients.tolist(),
            "covariance": [fit.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6].tolist() for i in range(14)],
        }
        store(stored, given.output)
        print(table(stored), flush=True)
    if given.campaign:
        stored["campaign_relative_std_percent"] = campaign(given.seed)
        store(stored, given.output)
        print("campaign", stored["campaign_relative_std_percent"])
    return 0


def table(stored: dict[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    head = ["recordings", "time [s]", "within 3 std [%]", "rms [std]", "largest [std]"]
    head += ["largest frequency error [Hz]", "relative std [%]"]
    formats = {"within_3_std_percent": ".1f", "rms_std": ".2f", "largest_std": ".2f"}
    formats |= {"largest_frequency_error_hz": ".3f", "relative_std_percent": ".3f"}
    rows = [
        [word, f"{run['recordings'] * stored['duration_s']:g}", *(format(run[key], f) for key, f in formats.items())]
        for word, run in stored["runs"].items()
    ]
    if "campaign_relative_std_percent" in stored:
        rows.append(["86 at constant points", "430", *[""] * 4, f"{stored['campaign_relative_std_percent']:.3f}"])
    return markdown(head, rows)


def draw(stored: dict[str, Any]) -> Any:
    """Draw surfaces of k_xx, d_xx and tau_x at three pressures with three standard deviations, and the true ones."""
    import matplotlib.pyplot as plt

    model, speed = gbid.load_model("theisen2016"), np.linspace(0, 6000, 61)
    word = list(stored["runs"])[-1]
    run = stored["runs"][word]
    coefficients, covariance = np.array(run["coefficients"]), np.array(run["covariance"])
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
    for ax, key, factor, unit in zip(
        axes, ("k_xx", "d_xx", "tau_x"), (1e-5, 1.0, 1e3), ("1e5 N/(kg m)", "N s/(kg m)", "ms"), strict=True
    ):
        i = KEY_PARAMETERS.index(key)
        for colour, pressure in enumerate((3.0, 5.0, 7.0)):
            X = regressors(np.full(61, pressure), speed)
            computed, std = X @ coefficients[i], np.sqrt(np.einsum("ij,jk,ik->i", X, covariance[i], X))
            ax.plot(speed, factor * model.key_parameters(np.full(61, pressure), speed)[key], "k--", linewidth=1)
            ax.plot(speed, factor * computed, color=f"C{colour}", label=f"{pressure:g} bar")
            low, high = (factor * (computed + sign * 3 * std) for sign in (-1, 1))
            ax.fill_between(speed, low, high, color=f"C{colour}", alpha=0.25, linewidth=0)
        ax.set(xlabel="speed [rpm]", ylabel=f"{key} [{unit}]")
    axes[1].legend(title=f"{word}; truth dashed", fontsize=8, title_fontsize=8, loc="upper center")
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
