"""Simulated recordings of the one-axis magnetic bearing under a PD controller."""

import numpy as np

import gbid
from gbid.core.files import share_folder
from gbid.structure import evaluate, load_structure

random = np.random.default_rng(1)


def compare(fit, true):
    print(f"{fit.recordings[0]}: {fit.status}")
    for name in fit.free:
        if name in true:
            value, std, unit = fit.parameters[name], fit.std[name], fit.units[name]
            print(f"  {name:5s} {value:11.5g} +- {std:7.2g} {unit:13s} truth {true[name]:g}")


bearing = load_structure("magnetic_bearing.py:structure", share_folder("models"))


def held_bearing(bias, n=4000, T=1e-4):
    """Recording of the bearing under a PD controller, at a bias current [A]; and the true parameters."""
    true = {"k_s": 4e4 * bias**2, "d": 2.0, "k_i": 60.0 * bias}
    plant = evaluate(bearing, {**true, "l1": 0.0, "l2": 0.0}).discretise(T)
    stiffness = 4 * true["k_s"]
    kp, kd = (true["k_s"] + stiffness) / true["k_i"], 1.4 * stiffness**0.5 / true["k_i"]
    extra = np.repeat(random.choice([-0.15, 0.15], n // 20), 20)
    current, position = np.empty(n), np.empty(n)
    x, rate = np.zeros(2), 0.0
    for k in range(n):
        position[k] = x[0] + 1e-6 * random.standard_normal()
        rate += 0.3 * ((position[k] - position[max(k - 1, 0)]) / T - rate)
        current[k] = extra[k] - kp * position[k] - kd * rate
        x = plant.A @ x + plant.B[:, 0] * current[k]
    signals = {"added": extra[:, None], "current": current[:, None], "position": position[:, None]}
    units = {"added": "A", "current": "A", "position": "m"}
    return gbid.Recording(signals, T, name=f"bias {bias:g} A", units=units), true
