"""Controllers, run-out maps and samples for the tests of control chains."""

from __future__ import annotations

from math import cos, inf, nan, pi, sin

import numpy as np

from gbid.control import ControllerDesign, controller_structure, scheduled
from gbid.export.chain_python import ChainInput, ChainMode
from gbid.prefilter import RunoutMap

GAINS = {"kappa_x": 1.3, "kappa_y": 1.1}
BIQUAD = {
    **{f"{gain}_{axis}": value for gain, value in (("b0", 0.5), ("b1", 0.8), ("b2", 0.1)) for axis in "xy"},
    **{f"{gain}_{axis}": value for gain, value in (("frequency", 0.15), ("damping", 0.7)) for axis in "xy"},
}
KINDS = ("P", "biquad", "scheduled")


def design(kind: str) -> ControllerDesign:
    """Return a controller: P, biquad, or a biquad scheduled over pressure and speed."""
    if kind == "P":
        return ControllerDesign("damper", controller_structure("P"), GAINS, sample_time=2e-4, plant="theisen2016")
    if kind == "biquad":
        return ControllerDesign("damper", controller_structure("biquad"), BIQUAD, sample_time=2e-4, plant="theisen2016")
    structure = scheduled(controller_structure("biquad"))
    gains = {}
    for parameter in structure.parameters:
        gain, _, term = parameter.name.rpartition("_")
        gains[parameter.name] = BIQUAD[gain] * {"1": 1.0, "P": 0.15, "Omega": -0.1}[term]
    return ControllerDesign("damper", structure, gains, sample_time=2e-4, plant="theisen2016")


def runout_map(method: str = "harmonics", pressure: float = 6.0, speed: float = 6000.0, size: float = 1.0) -> RunoutMap:
    """Return a map of a few micrometres: harmonics 1, 2 and 4, a table over 17 angles, or the mean alone."""
    random = np.random.default_rng(3)
    waves = size * 1e-6 * random.normal(size=(2, 3, 2))
    angles, table = np.sort(random.uniform(0, 2 * pi, 17)), 1e-6 * random.normal(size=(17, 2))
    none, empty = np.zeros(0), np.zeros((0, 2))
    harmonics, bins = method == "harmonics", method == "bins"
    return RunoutMap(
        method,
        size * np.array([2e-6, -3e-6]),
        np.array([1.0, 2.0, 4.0]) if harmonics else none,
        waves[0] if harmonics else empty,
        waves[1] if harmonics else empty,
        angles if bins else none,
        table if bins else empty,
        ("x", "y"),
        {"pressure_bar": pressure, "speed_rpm": speed},
        ("still",),
        10.0,
        np.zeros(2),
        np.zeros(2),
    )


def grid_of_maps() -> tuple[RunoutMap, ...]:
    """Return four maps at the corners of a rectangle."""
    return tuple(runout_map(pressure=p, speed=s, size=0.5 + s / 6000) for p in (3.0, 7.0) for s in (2000.0, 6000.0))


def eventful_samples(n: int = 3000) -> list[ChainInput]:
    """Return samples with spikes, faulty numbers, a stuck sensor, turns both ways, and changes of mode and point."""
    random = np.random.default_rng(0)
    results = []
    for k in range(n):
        angle = (k * 0.1257 * (1 if k < 2000 else -1)) % (2 * pi) - (2 * pi if k % 7 == 0 else 0.0)
        size = 3e-6 if k < 1500 else 18e-6
        x = 2e-6 + size * sin(0.16 * k) + 3e-7 * random.normal()
        y = -3e-6 + size * cos(0.163 * k) + 3e-7 * random.normal()
        x += 2e-5 if k % 97 == 0 else 0.0
        if 2400 <= k < 2460:
            y = 1e-6
        if k % 501 == 0:
            y = nan
        if 2000 < k < 2010:
            x = inf
        mode = ChainMode.CONTROL
        if k < 3 or 2100 < k < 2110 or 2500 < k < 2502:
            mode = ChainMode.OFFSET
        if k > 2800:
            mode = ChainMode.OFF
        pressure, speed = 3.0 + 4.0 * ((k // 300) % 2), 6000 * abs(sin(k / 700))
        results.append(ChainInput((x, y), angle, pressure, speed, mode))
    return results
