"""Block-oriented structures against filters of scipy, and on recordings of a circuit that scipy simulates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

import gbid
from gbid.core.errors import UsageError
from gbid.structure import nonlinear_model, smooth_hinge, wiener_hammerstein

H = 1e-3
KNOTS = (-0.5, 0.0, 0.5)


def circuit(u: np.ndarray, bend: object, finer: int = 20) -> np.ndarray:
    """A second-order low-pass, a bend and a first-order low-pass, with the input on straight lines between samples."""
    fine = np.interp(np.arange(len(u) * finer) / finer, np.arange(len(u)), u)
    time = H / finer * np.arange(len(fine))
    w = signal.lsim(([500.0, 90000.0], [1.0, 400.0, 90000.0]), fine, time)[1]
    return signal.lsim(([2.0 * 300.0], [1.0, 300.0]), bend(w), time)[1][::finer]  # type: ignore[operator]


def test_simulation_is_that_of_two_filters_and_a_bend() -> None:
    scale = 2 * np.pi * 50.0
    structure = wiener_hammerstein(2, 1, KNOTS, 50.0, steps=4)
    values = {parameter.name: 0.0 for parameter in structure.parameters}
    values |= {"a_0": 90000 / scale**2, "a_1": 400 / scale, "b_1": 500 / scale, "c_0": 300 / scale, "d_0": 600 / scale}
    bends = {"f_0": 0.3, "f_1": -0.8, "f_2": 0.2}

    def bend(w: np.ndarray) -> np.ndarray:
        return w + sum(f * smooth_hinge(w - k, 0.5) for f, k in zip(bends.values(), KNOTS, strict=True))

    u = np.random.default_rng(1).normal(size=400)
    model = nonlinear_model(structure, {**values, **bends, "y_0": 0.1}, steps=4)
    simulated = model.simulate(u[:, None], H, intersample="foh")[:, 0]
    expected = circuit(u, bend) + 0.1
    np.testing.assert_allclose(simulated, expected, atol=1e-4 * np.ptp(expected))


def test_a_smooth_bend_is_found_from_a_linear_start() -> None:
    rng = np.random.default_rng(2)
    sos = signal.butter(3, 0.3, output="sos")

    def recording(name: str) -> gbid.Recording:
        u = signal.sosfilt(sos, rng.normal(size=3000))
        y = circuit(u, lambda w: np.tanh(1.5 * w) + 0.2 * w) + 1e-3 * rng.normal(size=len(u))
        return gbid.Recording({"u": u[:, None], "y": y[:, None]}, H, name=name)

    train, test = recording("train"), recording("test")
    result = gbid.fit(wiener_hammerstein(2, 1, np.linspace(-1.2, 1.2, 9), 50.0), train)
    validation = gbid.cross_validate(result, test)
    assert result.success
    assert np.std(validation.measured - validation.simulated) < 1.5e-3


@pytest.mark.parametrize(
    ("before", "after", "knots", "frequency"),
    [(0, 0, KNOTS, 1.0), (-1, 2, KNOTS, 1.0), (1, 1, (0.0,), 1.0), (1, 1, (1.0, 0.0), 1.0), (1, 1, KNOTS, 0.0)],
)
def test_what_is_no_such_structure_is_refused(before: int, after: int, knots: tuple[float], frequency: float) -> None:
    with pytest.raises(UsageError, match="give orders of 0 or more, one of them 1 or more, at least two knots"):
        wiener_hammerstein(before, after, knots, frequency)


def test_a_structure_without_a_filter_before_or_after() -> None:
    for before, after in ((0, 2), (2, 0)):
        structure = wiener_hammerstein(before, after, KNOTS, 50.0)
        values = {parameter.name: parameter.start for parameter in structure.parameters}
        model = nonlinear_model(structure, values)  # type: ignore[arg-type]
        step = model.simulate(np.ones((2000, 1)), H)[:, 0]
        assert step[-1] == pytest.approx(1.0, abs=1e-6)
