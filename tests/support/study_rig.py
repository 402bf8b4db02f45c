"""Recordings of the virtual rig for the long studies."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from gbid.lpv import load_model
from gbid.prefilter.filtering import prefilter
from gbid.prefilter.runout_identification import identify_runout
from gbid.rig import Machine, Prbs, SensorChain, Stationary, Unbalance, record

PAPER = load_model("theisen2016")
POINTS = [(p, n) for p in (3.0, 4.0, 5.0, 6.0, 7.0) for n in (0.0, 4000.0, 6000.0)]
# 86 recordings: eleven points with six and four with five (errata, "Other readings").
CAMPAIGN = [(point, i) for k, point in enumerate(POINTS) for i in range(6 if k < 11 else 5)]


def truth_at(pressure, speed):
    """All parameters that the rig was made with, by name."""
    return {**PAPER.key_parameters(pressure, speed), **PAPER.actuators}


def machine_at(pressure, speed, noise=30e-9):
    t = truth_at(pressure, speed)
    return Machine.from_parameters(t, t, Unbalance(), SensorChain(noise_p_m=noise))


def prefiltered(pressure, speed, *, duration_s=5.0, seed=0, name="prbs", noise=30e-9):
    """One PRBS recording without run-out, unbalance and means."""
    machine = machine_at(pressure, speed, noise)
    conditions = {"pressure_bar": pressure, "speed_rpm": speed}
    made = record(machine, Prbs(duration_s=duration_s), conditions=conditions, seed=seed, name=name)
    runout = None
    if speed:
        still = record(machine, Stationary(duration_s=5.0), conditions=conditions, seed=seed, name=f"{name}-still")
        runout = identify_runout([still])
    return prefilter(made, runout)[0]


def with_coloured_noise(recording, seed, std=30e-9, pole=0.9):
    """Add first-order autoregressive noise to the position."""
    rng = np.random.default_rng(seed)
    n = recording.n_samples
    noise = lfilter([np.sqrt(1 - pole**2)], [1, -pole], rng.normal(size=(n + 1000, 2)) * std, axis=0)[1000:]
    p = recording.signal("p") + noise
    return replace(recording, signals={**recording.signals, "p": p - p.mean(axis=0)})
