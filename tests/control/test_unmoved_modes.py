"""Modes that no gain moves leave the objective, by name; the design is that of the plant without them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import block_diag

import gbid
from gbid.control import MaxDecay, MinDamping, SlowestPole, controller_at
from gbid.structure import LinearModel

PD = gbid.controller_structure("PD", axes=("",), lowpass_hz=2000.0)


def of(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> LinearModel:
    return LinearModel(A, B, C, np.zeros((1, 1)), input_names=("r",), output_names=("p",))


def pair(seed: int) -> tuple[LinearModel, LinearModel, str, float]:
    """Plant of three modes in mixed states, of which the last one has a node; the same without it; what names it."""
    random = np.random.default_rng(seed)
    hz, damping = np.sort(random.uniform(20, 200, 3)), random.uniform(0.003, 0.02, 3)
    w = 2 * np.pi * hz
    A = block_diag(*([[0, 1], [-(a**2), -2 * z * a]] for a, z in zip(w, damping, strict=True)))
    B, C = np.zeros((6, 1)), np.zeros((1, 6))
    B[1::2, 0], C[0, ::2] = 0.5 * random.uniform(0.3, 1, 3) * w**2, 1.0
    if seed % 3 != 1:
        B[5] = 0  # node at the actuator
    if seed % 3 != 0:
        C[0, 4] = 0  # node at the sensor
    T = np.diag(np.column_stack([np.ones(3), w]).ravel()) @ random.normal(size=(6, 6))  # velocities in units of p
    return (
        of(np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T),
        of(A[:4, :4], B[:4], C[:, :4]),
        f"{hz[2]:.4g} Hz, damping {damping[2]:.3g}",
        w[2] * damping[2],
    )


OPTIONS = (
    {"peak_sensitivity": None},
    {},
    {"objective": "decay", "peak_sensitivity": None},
    {"sample_time": 2e-4, "peak_sensitivity": None},
    {"sample_time": 2e-4},
)


@pytest.mark.parametrize("seed", [3, 8, pytest.param(range(50), marks=pytest.mark.slow)])
def test_the_other_modes_are_damped_as_without_it(seed: int | range) -> None:
    for each in seed if isinstance(seed, range) else [seed]:
        whole, reduced, name, _ = pair(each)
        options = OPTIONS[each // 3 % len(OPTIONS)]
        result, expected = gbid.tune(whole, PD, **options), gbid.tune(reduced, PD, **options)
        assert result.value == pytest.approx(expected.value, rel=0.02)
        assert result.status == expected.status
        assert any("GB415" in note and name in note for note in result.notes), result.notes
        assert not any("GB41" in note for note in expected.notes)


def test_a_channel_with_zero_gain_is_named_and_its_gain_stays() -> None:
    plant, _, _, _ = pair(0)
    _, single, _, _ = pair(1)
    both = LinearModel(
        block_diag(single.A, plant.A),
        np.block([[single.B, np.zeros((4, 1))], [np.zeros((6, 1)), 0 * plant.B]]),
        block_diag(single.C, plant.C),
        np.zeros((2, 2)),
        input_names=("r_x", "r_y"),
        output_names=("p_x", "p_y"),
    )
    result = gbid.tune(both, "P", bounds={"kappa_x": (-3, 3)}, peak_sensitivity=None)
    expected = gbid.tune(
        single, gbid.controller_structure("P", axes=("",)), bounds={"kappa": (-3, 3)}, peak_sensitivity=None
    )
    assert result.value == pytest.approx(expected.value, rel=1e-6)
    assert result.gains["kappa_y"] == 0.0
    assert any("GB416" in note and "kappa_y" in note for note in result.notes)
    assert any("GB415" in note and note.count("Hz") == 3 for note in result.notes)


def test_functions_of_gains_too_and_nothing_changes_where_no_gain_moves_anything() -> None:
    g = ca.SX.sym("g")
    first, second = ca.blockcat([[0, 1], [-1, -0.02 - g]]), ca.SX(ca.DM([[0, 1], [-9, -0.06]]))
    result = gbid.maximise_damping(ca.Function("A", [g], [ca.diagcat(first, second)]), ["g"], -1, 1)
    assert result.value == pytest.approx(0.51)
    assert any("0.4775 Hz, damping 0.01" in note for note in result.notes)
    still = gbid.maximise_damping(ca.Function("A", [g], [second]), ["g"], -1, 1)
    assert (still.value, still.gains["g"]) == (pytest.approx(0.01), 0.0)
    assert [note[-6:-1] for note in still.notes] == ["GB415", "GB416"]


def test_a_mode_that_breaks_a_limit_by_itself_stays() -> None:
    whole, _, name, decay = pair(0)
    result = gbid.tune(whole, PD, goals=[MaxDecay(), SlowestPole(rate=2 * decay)])
    assert result.status == "infeasible"
    damped = gbid.tune(whole, PD, goals=[MaxDecay(), MinDamping(0.1, low_hz=125)], starts=1)
    assert damped.status == "infeasible"
    assert all(any(name in note for note in each.notes) for each in (result, damped))


def test_damping_of_one_says_that_the_decay_is_not_maximised() -> None:
    plant = LinearModel([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]], input_names=("r",), output_names=("p",))
    law = gbid.controller_structure("PD", axes=("",), feedback="negative", lower=0.0, upper=3.0, kd_limit_ms=3e3)
    result = gbid.tune(plant, law)
    assert result.value == pytest.approx(1.0)
    (note,) = (note for note in result.notes if "GB417" in note)
    slowest = -np.linalg.eigvals(gbid.close_loop(plant, controller_at(law, result.gains, 0.0, 0.0)).A).real.max()
    assert float(note.split("decays with ")[1].split()[0]) == pytest.approx(slowest, rel=0.01)
