"""Designed excitations tried on the rig: deviations expected and obtained, gain over a PRBS, distance to the wall.

``python -m benchmarks.excitation_study`` writes ``docs/excitation.json``; ``--seeds`` and ``--draws`` make it short.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import gbid
from benchmarks.running import markdown, options_of, store
from benchmarks.running import stored as stored_run
from gbid.core.errors import DataError
from gbid.excite import ExcitationLimits, KnownModel, expected_covariance, recording_length, rig_limits
from gbid.rig import Machine, Played, Prbs, Scatter, SensorChain, Unbalance, record
from gbid.structure import KEY_PARAMETERS, Plant, RotorBearing

POINTS = ((6.0, 0.0), (5.0, 6000.0), (3.0, 4000.0))
DT, DURATION = 2e-4, 5.0
NOISE_U, NOISE_P = 10e-9, 30e-9
PEAKS, RADIUS = {"r": 4.5e-6, "u": 8.4e-6}, {"p": 15e-6}
STRUCTURE = Plant(RotorBearing(delay="exact", disturbance_gain="none"))
QUIET = SensorChain(
    noise_p_m=NOISE_P, noise_u_m=NOISE_U, runout_amplitude_m=np.zeros((2, 1)), runout_phase_rad=np.zeros((2, 1)),
    offset_p_m=(0.0, 0.0), offset_u_m=(0.0, 0.0),
)  # fmt: skip


def truth_at(point: tuple[float, float]) -> dict[str, float]:
    """Return the true parameters of bearing and actuators at an operating point."""
    model = gbid.load_model("theisen2016")
    return {name: float(v) for name, v in model.key_parameters(*point).items()} | model.actuators


def known_at(truth: dict[str, float]) -> KnownModel:
    """Return the plant at its true parameters with the noise of the rig."""
    return KnownModel(STRUCTURE, truth, np.array([NOISE_U, NOISE_U, NOISE_P, NOISE_P]))


def scaled_prbs(known: KnownModel, hold_s: float, seed: int) -> np.ndarray:
    """Return the random binary references of the rig at the peaks of the limits."""
    r = Prbs(DURATION, 1.0, hold_s).reference(round(DURATION / DT), DT, np.random.default_rng(seed))
    y = known.model.simulate(r, DT)
    disc = np.hypot(y[:, 2], y[:, 3]).max()
    return r / max(1 / PEAKS["r"], np.abs(y[:, :2]).max() / PEAKS["u"], disc / RADIUS["p"])


def mean_relative(std: dict[str, float], truth: dict[str, float]) -> float:
    """Return the mean over the key parameters of standard deviation over value [%]."""
    return 100 * float(np.mean([std[name] / abs(truth[name]) for name in KEY_PARAMETERS]))


def of_point(point: tuple[float, float], seeds: int, draws: int) -> dict[str, Any]:
    """Return the study at one operating point."""
    conditions, truth = {"pressure_bar": point[0], "speed_rpm": point[1]}, truth_at(point)
    known = known_at(truth)
    limits = ExcitationLimits(PEAKS, RADIUS)
    results: dict[str, Any] = {"pressure_bar": point[0], "speed_rpm": point[1], "seeds": seeds, "draws": draws}
    options: dict[str, Any] = {"duration": DURATION, "sample_time": DT, "focus": KEY_PARAMETERS}
    made = {kind: gbid.design_excitation(known, limits=limits, kind=kind, **options) for kind in ("multisine", "prbs")}
    expected = [expected_covariance(known, scaled_prbs(known, 20e-3, seed), DT) for seed in range(5)]
    stds = (dict(zip(q.free, np.sqrt(np.diag(q.covariance)), strict=True)) for q in expected)
    paper = [mean_relative(std, truth) for std in stds]
    results["mean_std_percent"] = {
        "multisine": mean_relative(made["multisine"].std, truth),
        "prbs": mean_relative(made["prbs"].std, truth),
        "prbs_20ms": float(np.mean(paper)),
    }
    results["prbs_hold_s"] = made["prbs"].sequence.hold_s
    results["gap"] = made["multisine"].gap
    results["lines"] = len(made["multisine"].lines.frequency_hz)
    results["reached"] = {kind: list(each.reached) for kind, each in made.items()}
    results["obtained"] = {
        kind: obtained(each, truth, conditions, seeds if kind == "multisine" else 0) for kind, each in made.items()
    }
    results["wall"] = wall(truth, conditions, draws, options)
    return results


def obtained(
    excitation: gbid.Excitation, truth: dict[str, float], conditions: dict[str, float], seeds: int
) -> dict[str, float]:
    """Return the root mean square of the errors of fits over the standard deviation expected, by parameter."""
    machine = Machine.from_parameters(truth, truth, Unbalance(0.0), QUIET)
    played = Played(excitation.signals["r"], DT, "design")
    names, errors = [q.name for q in STRUCTURE.parameters], []
    for seed in range(seeds):
        recording = record(machine, played, conditions=conditions, seed=seed, name="designed")
        fit = gbid.fit(STRUCTURE, recording, start={name: truth[name] for name in names})
        assert fit.success, fit.status
        errors.append([(fit.parameters[name] - truth[name]) / excitation.std[name] for name in fit.free])
    return dict(zip(names, np.sqrt(np.mean(np.square(errors), axis=0)).tolist(), strict=True)) if errors else {}


def wall(truth: dict[str, float], conditions: dict[str, float], draws: int, options: dict[str, Any]) -> dict[str, Any]:
    """Return how many recordings of machines that the rig draws touch the bearing, with limits of the rig."""
    machine = Machine.from_parameters(truth, truth)
    scatter = Scatter()
    limits = rig_limits(machine, conditions=conditions, peaks=PEAKS, radius=RADIUS, scatter=scatter)
    made = gbid.design_excitation(known_at(truth), limits=limits, **options)
    period = round(made.lines.period_s / DT)
    played = Played(made.signals["r"][:period], DT, "design")
    touched = 0
    for seed in range(draws):
        try:
            record(machine, played, conditions=conditions, seed=seed, name="scattered", scatter=scatter)
        except DataError:
            touched += 1
    return {
        "touched": touched,
        "draws": draws,
        "mean_std_percent": mean_relative(made.std, truth),
        "reached": list(made.reached),
        "use": dict(made.use),
    }


def of_length(seeds: int) -> dict[str, Any]:
    """Return how long a recording must be for given targets with the noise of the paper's rig, tried by fits."""
    point, truth = {"pressure_bar": POINTS[0][0], "speed_rpm": POINTS[0][1]}, truth_at(POINTS[0])
    actuators = {name: truth[name] for name in truth if name not in KEY_PARAMETERS}  # known from other recordings
    known = KnownModel(STRUCTURE, truth, np.array([45e-9, 45e-9, 0.65e-6, 0.5e-6]), fixed=tuple(actuators))
    limits = ExcitationLimits({name: value / 3 for name, value in PEAKS.items()}, {"p": RADIUS["p"] / 3})
    length = recording_length(
        known, sample_time=DT, limits=limits, relative={"damping_*": 0.01}, absolute={"tau_*": 5e-6}
    )
    sensors = replace(QUIET, noise_p_m=(0.65e-6, 0.5e-6), noise_u_m=45e-9)
    machine = Machine.from_parameters(truth, truth, Unbalance(0.0), sensors)
    played = Played(length.excitation.signals["r"], DT, "design")
    modes = np.array(known.model.modes())[:, 1]
    errors: dict[str, list[float]] = {name: [] for name in length.targets}
    for seed in range(seeds):
        recording = record(machine, played, conditions=point, seed=seed, name="length")
        start = {q.name: truth[q.name] for q in STRUCTURE.parameters}
        fit = gbid.fit(STRUCTURE, recording, start=start, fixed=actuators)
        assert fit.success, (fit.status, fit.notes)
        own = {f"damping_{i + 1}": z - modes[i] for i, (_, z) in enumerate(fit.model.modes())}
        own |= {name: fit.parameters[name] - truth[name] for name in ("tau_x", "tau_y")}
        for name, of_name in errors.items():
            of_name.append(own[name])
    return {
        "seeds": seeds,
        "duration_s": length.duration_s,
        "decisive": length.decisive,
        "targets": {name: float(value) for name, value in length.targets.items()},
        "expected": {name: length.excitation.std[name] for name in errors},
        "obtained": {name: float(np.sqrt(np.mean(np.square(own)))) for name, own in errors.items()},
    }


def length_summary(stored: dict[str, Any]) -> str:
    """Return the length for the targets as a sentence and a Markdown table."""
    length = stored["length"]
    columns = length["targets"], length["expected"], length["obtained"]
    rows = [(name, *(f"{column[name]:.3g}" for column in columns)) for name in length["targets"]]
    text = (
        f"{length['duration_s']:g} s are needed, because of {length['decisive']}. Fits to {length['seeds']} recordings:"
    )
    return f"{text}\n\n{markdown(('quantity', 'wanted std', 'expected', 'obtained'), rows)}"


def summary(stored: dict[str, Any]) -> str:
    """Return the study as a Markdown table."""
    head = ("point", "mean std, multisine", "designed PRBS", "PRBS held 20 ms", "gain", "seeds", "obtained / expected")
    rows = []
    for point in stored["points"]:
        mean, ratio, wall_ = point["mean_std_percent"], list(point["obtained"]["multisine"].values()), point["wall"]
        cells = (
            f"{point['pressure_bar']:g} bar, {point['speed_rpm']:g} rpm",
            *(f"{mean[kind]:.3g} %" for kind in ("multisine", "prbs", "prbs_20ms")),
            f"{mean['prbs_20ms'] / mean['multisine']:.2f}",
            f"{point['seeds']}",
            f"{np.mean(ratio):.3f} ({min(ratio):.2f} to {max(ratio):.2f})",
            f"{wall_['touched']} of {wall_['draws']}",
        )
        rows.append(cells)
    return markdown((*head, "touched"), rows)


def main() -> None:
    """Make the study and write it."""
    arguments = options_of(
        __doc__,
        output="excitation.json",
        seeds=(60, "recordings"),
        draws=(334, "machines at each operating point"),
        only=(str, "points or length: make this part, and keep the other"),
    )
    stored = stored_run(arguments.output, {})
    if arguments.only != "points":
        stored["length"] = of_length(arguments.seeds)
        print(length_summary(stored))
    if arguments.only != "length":
        stored["points"] = [of_point(point, arguments.seeds, arguments.draws) for point in POINTS]
        print(summary(stored))
    store(stored, arguments.output)


if __name__ == "__main__":
    main()
