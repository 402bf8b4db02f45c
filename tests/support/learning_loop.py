"""Loop of the rig at 6 bar and 6000 rpm with dither, whose stiffness k_xx changes, and a fit of its plant."""

from __future__ import annotations

from functools import cache

import numpy as np
from balanced_loop import DESIGN, MODEL

import gbid
from gbid.control.loop.close import force_entry, sample_plant
from gbid.control.loop.sampled import exact_plant_of
from gbid.discretise import discretise
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.rig import Course, Machine, Prbs, SampledController, ScheduledRun, SensorChain, Stationary, Unbalance, record

AT = {"pressure_bar": 6.0, "speed_rpm": 6000.0}
TRUTH = MODEL.key_parameters(6.0, 6000.0)
FOUR = ("k_xx", "k_yy", "d_xx", "d_yy")


def rig(eccentricity_m: float = 0.0) -> Machine:
    sensors = SensorChain(runout_amplitude_m=np.zeros((2, 0)), runout_phase_rad=np.zeros((2, 0)), offset_p_m=(0, 0))
    return Machine.from_parameters(TRUTH, MODEL.actuators, unbalance=Unbalance(eccentricity_m, 0.7), sensors=sensors)


@cache
def fitted() -> gbid.FitResult:
    recording = record(rig(), Prbs(1.0), conditions=AT, seed=1, name="prbs")
    return gbid.fit(gbid.Plant(gbid.RotorBearing(), outputs=("p",)), recording, fixed=MODEL.actuators)


def in_loop(seconds, *, dither=0.2e-6, changes=(0.0, 0.0), at=(0.1, 0.2), seed=3, eccentricity_m=0.0):
    """Return a recording in closed loop; k_xx changes by shares from one time to another, linearly."""
    law = DESIGN.sampled_at()

    def surfaces(pressure, speed):
        moved = {name: value + 0 * pressure for name, value in TRUTH.items()}
        return {**moved, "k_xx": moved["k_xx"] * (np.asarray(pressure) - 5.0)}

    bars = tuple(6.0 + share for share in changes)
    course = Course((0.0, *at, seconds), (bars[0], *bars, bars[1]), 6000.0)
    excitation = Prbs(seconds, amplitude_m=dither, hold_s=2e-3) if dither else Stationary(seconds)
    return record(
        rig(eccentricity_m),
        ScheduledRun(course, excitation),
        conditions={},
        surfaces=surfaces,
        seed=seed,
        name="loop",
        settle_s=0.2,
        controller=SampledController(*(np.array(getattr(law, a)) for a in "ABCD"), 2e-4),
    )


def coverage(seeds, seconds=4.0, change=0.002, forgetting_s=0.5, memory_s=0.02, process=0.0):
    """Return which 95 % intervals of the chain in C contain the truth, (n_seeds, n_times, 4), as k_xx drifts linearly.

    The plant is simulated by its exact discretisation here, with white noise of the position and of forces.
    """
    fit = gbid.RecursiveFit(
        fitted(), DESIGN, parameters=FOUR, forgetting_s=forgetting_s, memory_s=memory_s, dither=0.2e-6
    )
    options = ChainOptions(ramp_s=2e-4, fade_s=2e-4, spike_limit_m=None, limit_m=20e-6)
    chain = CompiledChain(chain_of(DESIGN, options=options, learn=fit))
    ends = [exact_plant_of(MODEL, {**TRUTH, "k_xx": TRUTH["k_xx"] * (1 + c)}) for c in (0.0, change)]
    first, last = (sample_plant(plant, 2e-4, 2e-4) for plant in ends)
    force = np.pad(
        discretise(np.array(ends[0].A), force_entry(ends[0]), 2e-4, "zoh").G_now, ((0, first.n_states - 8), (0, 0))
    )
    n, truth, inside = round(seconds / 2e-4), np.array([TRUTH[name] for name in FOUR]), []
    for seed in seeds:
        random, x, kept = np.random.default_rng(seed), np.zeros(first.n_states), []
        noise = 30e-9 * random.standard_normal((n, 2))
        pushed = process * random.standard_normal((n, 2)) @ force.T
        chain.start()
        chain._run(np.array([[0.0, 0.0, 0.01 * k, 6.0, 6000.0, 2.0] for k in range(3)]))
        drift = last.A - first.A
        for k in range(n):
            p = first.C @ x + noise[k]
            row = chain._run(np.array([[p[0], p[1], 0.0005 * (k % 10000), 6.0, 6000.0, 2.0]]))[0]
            share = k / n
            r = row[4:6]
            x = first.A @ x + first.B @ r + share * (drift @ x) + pushed[k]
            if k % 250 == 249 and k * 2e-4 > 1.5:
                now = truth * (1 + change * share * np.array([1.0, 0.0, 0.0, 0.0]))
                kept.append(np.abs(row[8:12] - now) < 1.96 * row[12:16])
        inside.append(kept)
    return np.array(inside)
