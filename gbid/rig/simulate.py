"""One recording of the virtual rig, as the data logger of the real one would store it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from gbid.errors import DataError, UsageError
from gbid.recording import FloatArray, Recording
from gbid.rig.excitation import Experiment, whole_samples
from gbid.rig.machine import Machine
from gbid.rig.response import MIN_OVERSAMPLING, driven_motion, unbalance_orbit
from gbid.rig.sensors import TURN, encoder_angle, runout


def record(
    machine: Machine,
    experiment: Experiment,
    *,
    conditions: Mapping[str, float],
    seed: int,
    name: str,
    sample_time: float = 2e-4,
    oversampling: int = MIN_OVERSAMPLING,
    settle_s: float = 0.5,
) -> Recording:
    """Make one recording (paper, Secs. 2, 3.4 and 3.5).

    The experiment runs for `settle_s` before the logger starts, so the recording begins in motion. The shaft
    turns at constant speed from an angle that differs from recording to recording.

    Parameters
    ----------
    machine : Machine
        The rig, with the parameters that hold at the operating point.
    experiment : Stationary or Prbs
        What the references do, and for how long.
    conditions : dict of str to float
        The operating point; ``speed_rpm`` is needed and turns the shaft, all are stored.
    seed : int
        At least zero. Same seed, same name: the same recording, bit for bit.
    name : str
        Name of the recording. Recordings of one seed with different names are independent: another sequence,
        another noise, another angle.
    sample_time : float
        Time between samples [s].
    oversampling : int
        Points per sample at which the motion is looked at, at least 20 (see `gbid.rig.response`).
    settle_s : float
        Time of the experiment before the first sample [s], a whole number of samples or zero.

    Returns
    -------
    Recording
        Signals r (as commanded), u (piezo position, offset and noise), p (disc position, run-out, offset and
        noise) [m], phi (encoder, within [0, 2 pi)) [rad].

    Raises
    ------
    UsageError
        For a wrong argument, or a rotor that is unstable.
    DataError
        When the disc leaves the clearance of the bearing.
    """
    speed = _speed(conditions)
    if seed < 0 or not name:
        raise UsageError(f"seed = {seed}, name = {name!r}; give a seed of at least zero and a name")
    machine.rotor_bearing.check_stable()
    n_samples = whole_samples("duration_s", experiment.duration_s, sample_time)
    n_settle = whole_samples("settle_s", settle_s, sample_time) if settle_s else 0
    root = np.random.SeedSequence(seed, spawn_key=tuple(name.encode()))
    levels, start, noise_u, noise_p = (np.random.default_rng(child) for child in root.spawn(4))

    reference = experiment.reference(n_settle + n_samples, sample_time, levels)
    driven = driven_motion(machine.rotor_bearing, machine.actuator, reference, sample_time, oversampling)
    fine_angle = start.uniform(0.0, TURN) + speed * driven.time
    disc = driven.p + unbalance_orbit(machine.rotor_bearing, machine.unbalance, speed, fine_angle)
    _check_clearance(name, driven.time - settle_s, disc, machine.clearance)

    at = slice(n_settle * oversampling, None, oversampling)
    angle, sensors = fine_angle[at], machine.sensors
    u = driven.u[at] + sensors.offset_u + sensors.noise_u * noise_u.standard_normal((n_samples, 2))
    p = disc[at] + runout(sensors, angle) + sensors.offset_p
    p = p + sensors.noise_p * noise_p.standard_normal((n_samples, 2))
    return Recording(
        {"r": reference[n_settle:], "u": u, "p": p, "phi": encoder_angle(sensors, angle)[:, None]},
        sample_time,
        conditions=conditions,
        name=name,
        provenance={
            "source": "gbid virtual rig",
            "seed": str(seed),
            "experiment": _as_json({type(experiment).__name__: asdict(experiment)}),
            "rig": _as_json({"oversampling": oversampling, "settle_s": settle_s, **asdict(machine)}),
        },
    )


def _speed(conditions: Mapping[str, float]) -> float:
    """Speed of the shaft [rad/s]."""
    speed_rpm = conditions.get("speed_rpm")
    if speed_rpm is None or not np.isfinite(speed_rpm):
        raise UsageError(f"conditions: speed_rpm = {speed_rpm}; give the speed of the shaft, 0 for standstill")
    return float(speed_rpm) * TURN / 60.0


def _check_clearance(name: str, time: FloatArray, disc: FloatArray, clearance: float) -> None:
    """Refuse a recording in which the rotor would touch the bearing."""
    radius = np.hypot(disc[:, 0], disc[:, 1])
    worst = int(radius.argmax())
    if radius[worst] >= clearance:
        raise DataError(
            f"recording {name!r}: the disc moves {radius[worst] * 1e6:.1f} um at {time[worst]:.4f} s and "
            f"uses up the clearance of {clearance * 1e6:.1f} um; lower the amplitude or lengthen the hold"
        )


def _as_json(value: dict[str, Any]) -> str:
    return json.dumps(value, default=lambda array: np.asarray(array).tolist(), sort_keys=True)
