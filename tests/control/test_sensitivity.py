"""Sensitivities and their peaks: against closed forms, dense grids, python-control and the paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_cases import MACHINE, PAPER, static

import gbid
from gbid.control import exact_plant, peak_gain, sensitivity_data
from gbid.control.loop.norm import largest_singular_values
from gbid.core.errors import UsageError
from gbid.structure import LinearModel

NAMES = ("output", "input", "control", "plant", "complementary")


def second_order(w: float, zeta: float) -> LinearModel:
    return LinearModel([[0, 1], [-(w**2), -2 * zeta * w]], [[0], [w**2]], [[1, 0]], [[0]])


def random_stable(rng: np.random.Generator, n: int, n_u: int, n_y: int, dt: float | None, D: float) -> LinearModel:
    A = rng.normal(size=(n, n))
    if dt is None:
        A -= (np.linalg.eigvals(A).real.max() + 10 ** rng.uniform(-3, 0)) * np.eye(n)
    else:
        A *= (1 - 10 ** rng.uniform(-3, -1)) / np.abs(np.linalg.eigvals(A)).max()
    return LinearModel(A, rng.normal(size=(n, n_u)), rng.normal(size=(n_y, n)), D * rng.normal(size=(n_y, n_u)), dt=dt)


@pytest.mark.parametrize("zeta", [0.001, 0.1, 0.5])
def test_peak_of_a_second_order_lag_in_closed_form(zeta: float) -> None:
    w = 2 * np.pi * 130.0
    peak = peak_gain(second_order(w, zeta))
    assert peak.value == pytest.approx(1 / (2 * zeta * np.sqrt(1 - zeta**2)), rel=3e-8)
    assert peak.frequency_hz == pytest.approx(130.0 * np.sqrt(1 - 2 * zeta**2), rel=1e-4)


def test_peak_at_rest_and_at_infinity() -> None:
    assert peak_gain(second_order(5.0, 0.9)) == pytest.approx((1.0, 0.0), abs=3e-8)
    high_pass = LinearModel([[-3.0]], [[1.0]], [[-6.0]], [[2.0]])  # 2 s/(s + 3)
    assert peak_gain(high_pass) == (2.0, np.inf)
    assert peak_gain(static([[3.0, 0], [0, 4.0]])).value == 4.0
    assert peak_gain(LinearModel([[1.0]], [[1.0]], [[1.0]], [[0.0]])).value == np.inf


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.tuples(st.integers(1, 7), st.integers(1, 3), st.integers(1, 3)),
    dt=st.sampled_from([None, 0.2]),
    D=st.sampled_from([0.0, 1.0]),
)
def test_no_frequency_has_more_gain_than_the_peak(
    seed: int, sizes: tuple[int, int, int], dt: float | None, D: float
) -> None:
    model = random_stable(np.random.default_rng(seed), *sizes, dt, D)
    peak = peak_gain(model)
    centre = np.abs(model.poles().imag) / (2 * np.pi)
    spread = np.abs(model.poles().real) / (2 * np.pi)
    around = (centre[:, None] + spread[:, None] * np.linspace(-3, 3, 200)).ravel()
    grid = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 1000) if dt is None else np.linspace(0, 2.5, 1000), around])
    grid = grid[(grid >= 0) & (grid <= (np.inf if dt is None else 2.5))]
    dense = np.linalg.svd(model.frequency_response(grid), compute_uv=False)[:, 0].max()
    assert dense <= peak.value * (1 + 3e-8)
    reached = (
        np.linalg.norm(model.D, 2)
        if np.isinf(peak.frequency_hz)
        else np.linalg.norm(model.frequency_response(peak.frequency_hz)[0], 2)
    )
    assert peak.value == pytest.approx(reached, rel=1e-7)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), dt=st.sampled_from([None, 0.05]), D=st.sampled_from([0.0, 0.2]))
def test_models_and_responses_agree_with_the_definitions(seed: int, dt: float | None, D: float) -> None:
    rng = np.random.default_rng(seed)
    plant, controller = random_stable(rng, 3, 2, 3, dt, D), random_stable(rng, 2, 3, 2, dt, D)
    f = np.array([0.0, 0.05, 0.4, 3.0])
    G, K = plant.frequency_response(f), controller.frequency_response(f)
    S_o, S_i = np.linalg.inv(np.eye(3) - G @ K), np.linalg.inv(np.eye(2) - K @ G)
    expected = dict(zip(NAMES, (S_o, S_i, K @ S_o, S_o @ G, -G @ K @ S_o), strict=True))
    loop = gbid.sensitivities(plant, controller)
    size = max(np.linalg.cond(np.eye(3) - G @ K).max(), 1.0) * max(np.abs(v).max() for v in expected.values())
    for name, value in expected.items():
        np.testing.assert_allclose(loop.response(name, f), value, rtol=0, atol=1e-9 * size)
        np.testing.assert_allclose(loop.model(name).frequency_response(f), value, rtol=0, atol=1e-9 * size)


def test_peaks_of_the_published_design() -> None:
    """Known of the paper's design: 2.283 at 6 bar and 0 rpm, 2.62 over the 15 points."""
    loop = gbid.sensitivities(MACHINE.plant_at(6, 0), PAPER)
    dense = np.linspace(0, 400, 10001)
    for name in NAMES:
        grid = largest_singular_values(loop.response(name, dense)).max()
        assert loop.peak(name).value == pytest.approx(grid, rel=1e-6)
    assert round(loop.peak("output").value, 3) == 2.283
    peaks = [gbid.sensitivities(MACHINE.plant_at(*q), PAPER).peak("output").value for q in MACHINE.operating_points]
    assert round(max(peaks), 2) == 2.62


def test_exact_delay_against_a_dense_grid_and_high_pade_orders() -> None:
    plant = exact_plant(MACHINE, 3, 6000)
    loop = gbid.sensitivities(plant, PAPER)
    with pytest.raises(UsageError, match="has exact delays: use response"):
        loop.model("output")
    dense = largest_singular_values(loop.response("output", np.linspace(0, 200, 20001))).max()
    assert loop.peak("output").value == pytest.approx(dense, rel=1e-9)
    pade = gbid.sensitivities(gbid.structure.with_pade(plant, 8), PAPER).peak("output")
    assert loop.peak("output").value == pytest.approx(pade.value, rel=1e-7)


def test_exact_delay_closed_form() -> None:
    """G = e^(-s T)/s under K = -k: |S| peaks where the loop gain passes closest to one; unstable from k T = pi/2."""
    T = 0.1
    plant = LinearModel([[-1e-9]], [[0.0]], [[1.0]], [[0.0]], B_delayed=[[1.0]], delay=[T])
    k = 5.0
    w = np.linspace(1e-3, 200, 2_000_001)
    dense = np.abs(1 / (1 + k * np.exp(-1j * w * T) / (1j * w))).max()
    assert gbid.sensitivities(plant, static(-k)).peak("output").value == pytest.approx(dense, rel=1e-8)
    assert gbid.sensitivities(plant, static(-1.001 * np.pi / 2 / T)).peak("output").value == np.inf
    assert gbid.sensitivities(plant, static(-0.999 * np.pi / 2 / T)).is_stable()


def test_curves_of_figures_20_and_21() -> None:
    plant = MACHINE.plant_at(6, 0)
    data = sensitivity_data(plant, PAPER)
    assert data.output.shape == (len(data.frequency_hz), 2, 2)
    np.testing.assert_allclose(data.plant, data.output @ data.open_loop, rtol=1e-10, atol=1e-15)
    near = np.abs(data.frequency_hz - 127).argmin()
    assert np.abs(data.output[near, 0, 0]) < 0.2  # "greatly reduced close to the resonance frequencies"
    assert np.abs(data.output[0, 0, 0]) > 2  # "amplification for low frequencies in the horizontal direction"
    assert np.abs(data.plant[:, 0, 0]).max() < np.abs(data.open_loop[:, 0, 0]).max() / 2  # "reduction in peak gain"


def test_bad_input() -> None:
    loop = gbid.sensitivities(MACHINE.plant_at(6, 0), PAPER)
    with pytest.raises(UsageError, match="sensitivity 'S'; choose 'output', 'input'"):
        loop.peak("S")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="bring both to one time"):
        gbid.sensitivities(MACHINE.plant_at(6, 0), PAPER.discretise(1e-3))
    with pytest.raises(UsageError, match="has exact delays"):
        peak_gain(exact_plant(MACHINE, 6, 0))


@pytest.mark.parametrize("shape", [(2, 2), (1, 3), (3, 1), (2, 5), (4, 3)])
def test_largest_singular_values_of_any_shape_and_size(shape: tuple[int, int]) -> None:
    random = np.random.default_rng(1)
    stack = random.normal(size=(6, *shape)) + 1j * random.normal(size=(6, *shape))
    stack *= np.array([1.0, 1e-100, 1e100, 0.0, 1e-5, 1.0])[:, None, None]
    stack[5, 0, 0] = np.inf
    expected = [*(np.linalg.norm(each, 2) for each in stack[:5]), np.inf]
    np.testing.assert_allclose(largest_singular_values(stack), expected, rtol=1e-13)
