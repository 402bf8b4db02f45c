"""Compare ways to identify a rotor from recordings in closed loop; store the figures.

``python -m benchmarks.closed_loop_study [--seeds N] [--output FILE]``
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import gbid
from benchmarks.running import about, markdown, options_of, run_study, stored, timed
from gbid.control import p_controller
from gbid.control.loop.close import sample_controller
from gbid.core.arrays import FloatArray
from gbid.identify.data import Record
from gbid.identify.predictor import Predictor, build_predictor
from gbid.identify.start.black_box import black_box
from gbid.rig import (
    FilmStiffening,
    Machine,
    Prbs,
    ProcessNoise,
    SampledController,
    SensorChain,
    Stationary,
    Unbalance,
    record,
)
from gbid.structure import KEY_PARAMETERS, evaluate

# ---- Recordings of the closed-loop study: the published rotor under its published controller, by the virtual rig.

SAMPLE_TIME = 2e-4
POINT = (7.0, 6000.0)
"""Pressure [bar] and speed [rpm] at which the published rotor is damped least."""
SENSORS = SensorChain(noise_p_m=(0.65e-6, 0.5e-6), noise_u_m=45e-9)
"""Run-out of the rig, and noise of the probes in x and y as the paper's recordings have it."""
CONTROLLER = sample_controller(p_controller(1.125, 0.99), SAMPLE_TIME)
"""The controller of the paper (Sec. 5) as it runs: positive gains are positive feedback."""
BINS = 720  # angles of the table that the controller subtracts


@dataclass(frozen=True)
class LoopCase:
    """Rotor, effects beyond the model, and excitation.

    Attributes
    ----------
    name : str
        Name in the table.
    parts : dict
        Effects of the rig, arguments of `gbid.rig.Machine`.
    amplitude, hold_s, duration_s : float
        Excitation, see `gbid.rig.Prbs`.
    """

    name: str
    parts: Mapping[str, Any]
    amplitude: float = 4.5e-6
    hold_s: float = 5e-3
    duration_s: float = 2.0

    @cached_property
    def truth(self) -> dict[str, float]:
        """True parameters of rotor, bearing and actuators."""
        model = gbid.load_model("theisen2016")
        return {**model.key_parameters(*POINT), **model.actuators}

    def linearised(self, recording: gbid.Recording) -> dict[str, float]:
        """Return the true parameters for the motion in a recording: a film that stiffens is linearised over it.

        The stiffness is the mean derivative of the film's force over the orbit of the unbalance, which the prefilter
        subtracts with the run-out, as both turn with the shaft, and over the motion about it, as if that were normal.
        """
        film = self.parts.get("stiffening")
        if film is None:
            return self.truth
        K, D = (np.array([[self.truth[f"{a}_{b}{c}"] for c in "xy"] for b in "xy"]) for a in "kd")
        speed = POINT[1] * (np.pi / 30)
        force = Unbalance().eccentricity_m * speed**2 * np.array([1.0, -1j])
        orbit = np.linalg.solve(-(speed**2) * np.eye(2) - 1j * speed * D - K, force)
        noise = np.diag(np.square(np.asarray(SENSORS.noise_p_m)))
        motion = np.real(np.outer(orbit, orbit.conj())) / 2 + np.cov(recording.signal("p").T) - noise
        stiff = K + film.inverse_square_length * (K * np.trace(motion) + 2 * K @ motion)
        return self.truth | dict(zip(("k_xx", "k_xy", "k_yx", "k_yy"), stiff.ravel().tolist(), strict=True))

    @property
    def machine(self) -> Machine:
        """The rig."""
        return Machine.from_parameters(self.truth, self.truth, sensors=SENSORS, **self.parts)

    @cached_property
    def runout_map(self) -> gbid.prefilter.RunoutMap:
        """Run-out and unbalance of the rotor in open loop."""
        return gbid.identify_runout(self._record(self.machine, Stationary(5.0), 0, "still"))

    def recording(self, seed: int, *, closed: bool = True) -> gbid.Recording:
        """Return one recording without run-out and means; in closed loop the controller subtracts the run-out, too."""
        nodes = np.arange(BINS) * (2 * np.pi / BINS)
        law = SampledController(
            CONTROLLER.A,
            CONTROLLER.B,
            CONTROLLER.C,
            CONTROLLER.D,
            SAMPLE_TIME,
            runout=self.runout_map.evaluate(nodes) - self.runout_map.mean,
            offset=self.runout_map.mean,
        )
        run = Prbs(self.duration_s, self.amplitude, self.hold_s)
        made = self._record(self.machine, run, seed, f"run {seed}", law if closed else None)
        return gbid.prefilter(made, self.runout_map)[0]

    def _record(
        self, machine: Machine, run: Prbs | Stationary, seed: int, name: str, law: SampledController | None = None
    ) -> gbid.Recording:
        at = {"pressure_bar": POINT[0], "speed_rpm": POINT[1]}
        return record(machine, run, conditions=at, seed=seed, name=name, controller=law)


NOISE: dict[str, Any] = {"process_noise": ProcessNoise(0.03)}
FILM = {**NOISE, "stiffening": FilmStiffening(0.3e-6)}
CASES = (LoopCase("noise", NOISE), LoopCase("noise, film", FILM))


# ---- Dual-Youla identification (Hansen's scheme): a black box in between, then the parameters.

ORDER = 48
"""States of the black-box model of the dual-Youla parameter, the best of 6 to 64 on recordings beside the study."""
FREQUENCIES = np.geomspace(20.0, 600.0, 120)  # [Hz]


def dual_youla(
    loop: gbid.ClosedLoop, recording: gbid.Recording, nominal: Mapping[str, float], fixed: Mapping[str, float]
) -> dict[str, float]:
    r"""Return the parameters by way of the dual-Youla parameter R, in three steps.

    Every plant that the controller stabilises is ``G = (N + V R) (D - U R)^-1`` with coprime factors of a nominal plant
    ``G_0 = N D^-1`` and of the controller ``K = U V^-1`` (Hansen, Franklin and Kosut, ACC 1989; for gas bearings
    Sekunda, Niemann, Poulsen and Santos). R is driven by w and gives z, both known from the data, without feedback. The
    controller is stable, so that V is one; with ``D = (I - K G_0)^-1`` then ``z = y - T_0 w``, where T is the response
    of the loop, and ``R = T - T_0``.

    A grey-box R with the parameters of the plant would have the residuals ``z - R w = y - T w`` of the indirect method,
    so that there is nothing to compare. As the field does it, R is a black-box model here, whose plant
    is matched by the structure over frequency, weighted by the accuracy of R.

    Parameters
    ----------
    loop : ClosedLoop
        The loop, without disturbance gain.
    recording : Recording
        Recording with w, u and p.
    nominal : dict of str to float
        Parameters of the nominal plant, which are also the start values of the match.
    fixed : dict of str to float
        Parameters of the actuators.
    """
    w = recording.signal("w")
    y = np.hstack([recording.signal(name) for name in loop.outputs])
    model = evaluate(loop, {**nominal, **fixed})
    z = y - model.simulate(w)
    result = black_box([Record("z", w, z)], ORDER, feedthrough=False)
    points = np.exp(2j * np.pi * FREQUENCIES * recording.sample_time)
    R, std = result.response(points)
    wanted = model.frequency_response(FREQUENCIES) + R
    predictor = build_predictor(loop, dict(fixed), recording.sample_time, "zoh", "simulation")
    scale = np.array([nominal[q.name] for q in predictor.free])

    def residual(relative: FloatArray) -> FloatArray:
        return _parts((_response(predictor, relative * scale, points)[0] - wanted) / std)

    def slopes(relative: FloatArray) -> FloatArray:
        by_theta = _response(predictor, relative * scale, points)[1] / std
        return np.array([_parts(column) for column in by_theta]).T * scale

    limits = np.sort(
        [np.array([q.lower, q.upper]) / size for q, size in zip(predictor.free, scale, strict=True)], axis=1
    )
    start = np.ones(len(scale))
    best = least_squares(residual, start, jac=slopes, bounds=limits.T, x_scale="jac", max_nfev=100).x * scale
    return {q.name: float(v) for q, v in zip(predictor.free, best, strict=True)}


def _response(predictor: Predictor, theta: FloatArray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the response of the loop (n_f, n_y, n_u), and its derivatives by the parameters."""
    A, B, C, D, *_ = predictor.matrices(theta)
    inverse = np.linalg.inv(points[:, None, None] * np.eye(A.shape[0]) - A.value)
    left, states = C.value @ inverse, inverse @ B.value
    by_theta = [
        dC @ states + left @ (dA @ states + dB) + dD
        for dA, dB, dC, dD in zip(A.slope, B.slope, C.slope, D.slope, strict=True)
    ]
    return left @ B.value + D.value, np.array(by_theta)


def _parts(values: np.ndarray) -> FloatArray:
    return np.concatenate([values.real.ravel(), values.imag.ravel()])


# ---- The study.

Found = tuple[Mapping[str, float], Mapping[str, float] | None, bool]
"""Estimates, standard deviations where the way has them, and whether it converged."""


def bearing(gain: str) -> gbid.RotorBearing:
    """Return the structure from u to p with exact delays and a disturbance gain."""
    return gbid.RotorBearing(delay="exact", disturbance_gain=gain)  # type: ignore[arg-type]  # a word


def before_values() -> dict[str, float]:
    """Return what is known before the recording: the published model at another pressure."""
    return dict(gbid.load_model("theisen2016").key_parameters(6.0, 6000.0))


def _fitted(structure: Any, recording: gbid.Recording, start: Mapping[str, float], focus: Any) -> Found:
    result = gbid.fit(structure, recording, start=start, focus=focus)
    return result.parameters, result.std, result.success


def _looped(gain: str, recording: gbid.Recording, focus: str) -> Found:
    start = {**before_values(), **gbid.load_model("theisen2016").actuators}
    return _fitted(gbid.ClosedLoop(gbid.Plant(bearing(gain)), CONTROLLER), recording, start, focus)


def _naive(recording: gbid.Recording) -> Found:
    return _fitted(bearing("none"), recording, before_values(), "simulation")


def _direct(recording: gbid.Recording) -> Found:
    return _looped("states", recording, "prediction")


def _indirect(recording: gbid.Recording) -> Found:
    return _looped("none", recording, "simulation")


def _hansen(recording: gbid.Recording) -> Found:
    fixed = dict(gbid.fit(gbid.PiezoPair(), recording).parameters)  # from r to u, whose noise is not fed back
    loop = gbid.ClosedLoop(gbid.Plant(bearing("none"), outputs=("p",)), CONTROLLER)
    return dual_youla(loop, recording, before_values(), fixed), None, True


WAYS: dict[str, Callable[[gbid.Recording], Found]] = {
    "indirect": _indirect,
    "direct": _direct,
    "dual-Youla": _hansen,
    "naive": _naive,
}
"""By the name in the table."""


def measure(case: LoopCase, way: str, recordings: Sequence[gbid.Recording]) -> dict[str, Any]:
    """Return bias and scatter of the key parameters in percent, coverage and time of one way."""
    rows, errors = [], []

    def tried(recording: gbid.Recording) -> Found:
        with suppress(gbid.core.errors.GbidError):
            return WAYS[way](recording)
        return {}, None, False

    results, seconds = timed(lambda: [tried(recording) for recording in recordings])
    for recording, (values, std, converged) in zip(recordings, results, strict=True):
        if not converged:
            continue
        true = case.linearised(recording)
        off = np.array([values[name] - true[name] for name in KEY_PARAMETERS])
        rows.append(off)
        if std is not None:
            errors.append(off / np.array([std[name] for name in KEY_PARAMETERS]))  # NaN without a std: outside
    n = len(recordings)
    by_name: dict[str, Any] = {"recordings": n, "failed": n - len(rows), "seconds": seconds / n}
    if not rows:
        return by_name
    # A parameter is compared with the largest of its kind.
    size = [max(abs(case.truth[key]) for key in KEY_PARAMETERS if key[:2] == name[:2]) for name in KEY_PARAMETERS]
    off = np.array(rows) / np.array(size)
    by_name["bias"] = float(100 * np.sqrt((off.mean(axis=0) ** 2).mean()))
    by_name["scatter"] = float(100 * np.sqrt(off.var(axis=0).mean()))
    by_name["biases"] = {name: float(100 * v) for name, v in zip(KEY_PARAMETERS, off.mean(axis=0), strict=True)}
    if errors:
        t = np.abs(np.array(errors))
        by_name |= {"within_2": float((t < 1.96).mean()), "within_3": float((t < 3).mean())}
    return by_name


def price(case: LoopCase, seeds: Sequence[int]) -> dict[str, Any]:
    """Return standard deviations in the loop beside those of open-loop recordings of equal length and equal peaks.

    The amplitude in open loop is the one whose largest movement of the disc is that of the loop.
    """
    start = {**before_values(), **gbid.load_model("theisen2016").actuators}
    small, ratios, amplitudes = replace(case, amplitude=1e-6), [], []
    for seed in seeds:
        held = case.recording(seed)
        scale = _peak(held) / _peak(small.recording(seed, closed=False))
        free = replace(case, amplitude=scale * small.amplitude)
        amplitudes.append(free.amplitude)
        apart = gbid.fit(gbid.Plant(bearing("states")), free.recording(seed, closed=False), start=start)
        _, std, _ = _direct(held)
        ratios.append([(std or {})[key] / apart.std[key] for key in KEY_PARAMETERS])
    by_name = np.nanmedian(np.array(ratios), axis=0)
    return {
        "recordings": len(seeds),
        "amplitude": float(np.median(amplitudes)),
        "std_ratio": {key: float(v) for key, v in zip(KEY_PARAMETERS, by_name, strict=True)},
    }


def _peak(recording: gbid.Recording) -> float:
    return float(np.abs(recording.signal("p")).max())


def price_text(run: Mapping[str, Any], amplitude: float) -> str:
    """Return what the loop costs in precision, as a sentence and a table."""
    computed = run["price"]
    ratios = computed["std_ratio"]
    words = (
        f"References of {1e6 * amplitude:.1f} um in the loop move the disc as far as "
        f"{1e6 * computed['amplitude']:.1f} um without it. Standard deviation in the loop (direct method) over that "
        f"in open loop, median of {computed['recordings']} pairs of recordings:"
    )
    return f"{words}\n\n{markdown(list(ratios), [[f'{v:.2f}' for v in ratios.values()]])}"


def study(seeds: int, cases: Sequence[LoopCase] = CASES) -> dict[str, Any]:
    """Run all ways on the recordings of all cases."""
    run: dict[str, Any] = {**about(), "seeds": seeds, "cases": {}}
    for case in cases:
        recordings = [case.recording(seed) for seed in range(seeds)]
        run["cases"][case.name] = {}
        for way in WAYS:
            run["cases"][case.name][way] = measure(case, way, recordings)
            print(case.name, way, json.dumps(run["cases"][case.name][way]), flush=True)
    run["price"] = price(CASES[0], range(seeds))
    print("price", json.dumps(run["price"]), flush=True)
    return run


def study_table(run: Mapping[str, Any]) -> str:
    """Return the figures of all cases as Markdown."""
    head = ("recordings", "way", "bias %", "scatter %", "within 1.96 std", "within 3 std", "s a fit", "failed")
    rows = []
    for case, ways in run["cases"].items():
        for way, f in ways.items():
            size = [f"{f[key]:.2f}" if key in f else "" for key in ("bias", "scatter")]
            shares = [f"{100 * f[key]:.1f} %" if key in f else "" for key in ("within_2", "within_3")]
            rows.append((f"{case} ({f['recordings']})", way, *size, *shares, f"{f['seconds']:.1f}", f["failed"]))
    return markdown(head, rows, f"Recordings of each case in brackets; {run['date']}, gbid {run['gbid']}.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(
        __doc__,
        arguments,
        seeds=(20, "recordings of each case (default 20)"),
        case=(tuple(case.name for case in CASES), "only these cases; others of an earlier run stay"),
    )

    def measured() -> dict[str, Any]:
        run = study(options.seeds, [case for case in CASES if case.name in options.case])
        earlier = stored(options.output, {}) if options.output else {}
        return run | {"cases": earlier.get("cases", {}) | run["cases"]}

    return run_study(measured, options.output, study_table)


if __name__ == "__main__":
    raise SystemExit(main())
