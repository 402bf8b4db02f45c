"""Simulated recordings of small examples: a shaken oscillator, an oscillator in a sampled loop."""

import numpy as np
from scipy import signal

import gbid
from gbid.structure import evaluate


def multisine_recording(truth, step=2e-4, n=2500):
    """Six periods of a multisine through an oscillator with a delay of one and a half samples, simulated with SciPy."""
    random = np.random.default_rng(1)
    lines = np.arange(5, 400)
    phases = random.uniform(0, 2 * np.pi, len(lines))
    u = np.tile(np.cos(2 * np.pi * np.outer(np.arange(n), lines) / n + phases).sum(axis=1), 6)
    A, B = np.array([[0, 1], [-truth["k"], -truth["d"]]]), np.array([[0], [truth["g"]]])
    half = signal.cont2discrete((A, B, np.eye(1, 2), np.zeros((1, 1))), step / 2)
    late = np.concatenate([np.zeros(3), np.repeat(u, 2)[:-3]])
    y = signal.dlsim((*half[:4], step / 2), late)[1][::2, 0]
    return gbid.Recording({"u": u, "y": y + 0.1 * y.std() * random.standard_normal(len(y))}, step, name="six periods")


def loop_recording(structure, truth, controller, sample_time):
    """A plant under a controller that is one sample late; a random binary excitation w is added to its output."""
    random = np.random.default_rng(1)
    plant = evaluate(structure, truth).discretise(sample_time)
    w = random.choice([-1.0, 1.0], 800).repeat(5)
    x, z, waiting = np.zeros(2), np.zeros(1), 0.0
    signals = {name: np.zeros((len(w), 1)) for name in "wrp"}
    for n, excitation in enumerate(w):
        p = plant.C[0] @ x + 0.05 * random.standard_normal()
        r = excitation + waiting
        waiting, z = controller.C[0] @ z + controller.D[0, 0] * p, controller.A @ z + controller.B[:, 0] * p
        x = plant.A @ x + plant.B[:, 0] * r
        signals["w"][n], signals["r"][n], signals["p"][n] = excitation, r, p
    return gbid.Recording(signals, sample_time, name="held", units={"w": "m", "r": "m", "p": "m"})


def shaker_fit():
    """Recording of a noisy oscillator of 10 Hz, its fit, and the true model."""
    mode = gbid.LinearStructure(
        "mode",
        [
            gbid.Parameter("f", 9.0, 1.0, 30.0, unit="Hz"),
            gbid.Parameter("damping", 0.05, 0.0, 1.0),
            gbid.Parameter("gain", 1.0),
        ],
        lambda p: {
            "A": [[0, 1], [-((2 * np.pi * p.f) ** 2), -4 * np.pi * p.damping * p.f]],
            "B": [[0], [p.gain * (2 * np.pi * p.f) ** 2]],
            "C": [[1, 0]],
        },
    )
    truth = evaluate(mode, {"f": 10.0, "damping": 0.03, "gain": 2.0})
    random = np.random.default_rng(4)
    u = np.repeat(random.choice([-1.0, 1.0], 400), 5)[:, None]
    y = truth.simulate(u, 0.005) + 3 * random.standard_normal((2000, 1))
    shaker = gbid.Recording({"u": u, "y": y}, 0.005, name="shaker")
    return shaker, gbid.fit(mode, shaker, focus="simulation"), truth
