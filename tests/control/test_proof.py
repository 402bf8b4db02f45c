"""Proved damping: against plants built one by one, known stability limits, and falsified certificates."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy

import gbid
from gbid.control import ControllerDesign, Proof, ProofStatus, close_loop, p_controller, scheduled, smallest_damping
from gbid.control.proof import loop_matrix, plant_set
from gbid.core.errors import UsageError
from gbid.lpv import Domain, Estimates, LPVFit, LPVModel
from gbid.lpv.model import regressors
from gbid.structure import KEY_PARAMETERS, LinearModel, LinearStructure, Parameter

MODEL = gbid.load_model("theisen2016")
P = p_controller(0.98, 1.05)


def surfaces(model: LPVModel, covariance: np.ndarray, names: tuple[str, ...] = KEY_PARAMETERS) -> LPVFit:
    """Surfaces with a given covariance of their coefficients, as if from two recordings."""
    k, scheduling = len(names), model.scheduling
    none = np.zeros((2, len(scheduling)))
    estimates = Estimates(("a", "b"), none, np.ones((2, k)), np.ones((2, k, k)), (), names, scheduling)
    return LPVFit(model, covariance, np.zeros((k, k)), estimates)


@cache
def bearing(share: float = 0.001, seed: int = 0) -> LPVFit:
    """Surfaces of the published machine with correlated errors of all 84 coefficients."""
    rng = np.random.default_rng(seed)
    points = np.array([(p, n) for p in (3.0, 5.0, 7.0) for n in (0.0, 3000.0, 6000.0)])
    terms = regressors(*points.T)
    information = np.linalg.inv(terms.T @ terms / len(points))
    values = np.array([MODEL.key_parameters(5.0, 3000.0)[name] for name in KEY_PARAMETERS])
    mix = np.eye(14) + 0.2 * rng.normal(size=(14, 14))
    return surfaces(MODEL, np.kron(mix @ mix.T * np.outer(values, values) * share**2, information))


@cache
def proof() -> Proof:
    return gbid.prove(P, bearing(), seconds=600.0)


def test_loop_matrix_has_the_poles_of_the_closed_loop() -> None:
    plants = plant_set(P, bearing(), 0.95)
    theta = np.array([*MODEL.key_parameters(4.0, 2500.0).values()])
    expected = close_loop(MODEL.plant_at(4.0, 2500.0), P).poles()
    poles = np.linalg.eigvals(loop_matrix(plants, theta))
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(expected), rtol=1e-6)


def test_bound_is_near_the_worst_plant_and_below_all_others() -> None:
    result, fit = proof(), bearing()
    assert result.status == ProofStatus.PROVED
    assert 0.94 * result.worst.damping < result.damping < result.worst.damping < result.nominal
    worst = replace(MODEL, coefficients=result.worst.coefficients)
    assert smallest_damping(close_loop(worst.plant_at(**result.worst.point), P)) == pytest.approx(result.worst.damping)
    rng = np.random.default_rng(1)
    plants, root = plant_set(P, fit, 0.95), np.linalg.cholesky(fit.covariance + 1e-300 * np.eye(84))
    for _ in range(300):
        u = rng.normal(size=84)
        rows = fit.coefficients + plants.radius * (root @ (u / np.linalg.norm(u))).reshape(14, 6)
        poles = np.linalg.eigvals(loop_matrix(plants, rows @ regressors(rng.uniform(3, 7), rng.uniform(0, 6000))))
        assert (-poles.real / np.abs(poles)).min() > result.damping


def test_true_certificate_is_verified() -> None:
    assert proof().verify()


def falsified(result: Proof, **changes: object) -> Proof:
    """A changed proof with a checksum that fits."""
    changed = replace(result, **changes)
    return replace(changed, digest=changed._checksum())


@pytest.mark.parametrize("case", range(8))
def test_falsified_certificates_are_found_by_the_check_itself(case: int) -> None:
    result = proof()
    changes = [
        {"damping": 1.001 * result.worst.damping},
        {"damping": 0.5},
        {"damping": np.nan},
        {"splits": result.splits[:-1]},
        {"splits": np.append(result.splits, -1)},
        {"splits": np.full(1, -1, np.int8)},
        {"directions": 0.9 * result.directions},
        {"model": replace(bearing(), covariance=9 * bearing().covariance)},
    ][case]
    assert not falsified(result, **changes).verify()


def test_checksum_finds_two_hundred_changed_values() -> None:
    result, rng = proof(), np.random.default_rng(2)
    for _ in range(200):
        field = rng.choice(["damping", "level", "directions", "splits"])
        value = np.array(getattr(result, field), float)
        place = tuple(rng.integers(n) for n in value.shape)
        value[place] += rng.choice([-1, 1]) * max(abs(value[place]), 1e-6) * 10.0 ** rng.integers(-12, -1)
        assert not replace(result, **{str(field): value if value.ndim else float(value)}).verify()


SPRING = LinearStructure(
    "two_masses",
    [Parameter("k", 1.0)],
    lambda p: {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [-p["k"], p["k"], 0, 0], [p["k"], -p["k"], 0, 0]],
        "B": [[0], [0], [1], [0]],
        "C": [[0, 1, 0, 0]],
    },
    ("u",),
    ("y",),
)


def stiffness(width: float) -> LPVFit:
    """Two masses and a spring of 1 +- width N/m, at the level 0.95 of one normal number."""
    domain = Domain((0.0, 1.0), variables=("load",))
    model = LPVModel(
        "spring", {"k": (1.0,)}, domain, structure=SPRING, exponents=((0,),), input_names=("u",), output_names=("y",)
    )
    return surfaces(model, np.array([[(width / 1.959963984540054) ** 2]]), ("k",))


@cache
def observer() -> LinearModel:
    """Linear quadratic regulator and Kalman filter for k = 1 of the benchmark of Wie and Bernstein (1992)."""
    plant = stiffness(0.1).model.at(0.5)
    A, B, C = plant.A, plant.B, plant.C
    F = -B.T @ scipy.linalg.solve_continuous_are(A, B, np.diag([1.0, 4.0, 0, 0]), np.eye(1))
    L = scipy.linalg.solve_continuous_are(A.T, C.T, np.diag([0, 0, 1.0, 4.0]), 0.01 * np.eye(1)) @ C.T / 0.01
    return LinearModel(A + B @ F - L @ C, L, F, np.zeros((1, 1)), input_names=("y",), output_names=("u",))


def test_stability_limit_of_two_masses_is_on_the_right_side() -> None:
    def stable(k: float) -> bool:
        plant = replace(stiffness(0.1).model, coefficients={"k": (k,)}).at(0.5)
        return bool((close_loop(plant, observer()).poles().real < 0).all())

    widths = np.linspace(0.0, 0.99, 991)
    limit = next(w for w in widths if not (stable(1 - w) and stable(1 + w)))
    assert gbid.prove(observer(), stiffness(0.9 * limit), seconds=600.0).status == ProofStatus.PROVED
    refuted = gbid.prove(observer(), stiffness(1.02 * limit), seconds=600.0)
    assert refuted.status == ProofStatus.REFUTED
    assert not stable(refuted.worst.coefficients["k"][0])


@pytest.mark.parametrize("gain", np.linspace(-9.0, -2.0, 10))
@pytest.mark.parametrize("axis", [0, 1])
def test_design_that_is_unstable_for_a_plant_of_the_set_is_never_proved(gain: float, axis: int) -> None:
    gains = [0.98, 1.05]
    gains[axis] *= gain
    K = p_controller(*gains)
    assert smallest_damping(close_loop(MODEL.plant_at(7.0, 6000.0), K)) < 0.02
    result = gbid.prove(K, bearing(), seconds=600.0)
    assert result.status == ProofStatus.REFUTED
    assert not result.damping > 0


def test_refusals_say_what_to_do() -> None:
    with pytest.raises(UsageError, match="rates are not supported"):
        gbid.prove(P, bearing(), rates={"pressure_bar": 10.0})
    with pytest.raises(UsageError, match="continuous"):
        gbid.prove(replace(P, dt=1e-4), bearing())
    structure = scheduled(gbid.controller_structure("P"))
    with pytest.raises(UsageError, match="constant gains"):
        gbid.prove(ControllerDesign("scheduled", structure, {}), bearing())
    with pytest.raises(UsageError, match="LPV"):
        gbid.prove(P, MODEL)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="drives 1 and measures 1"):
        gbid.prove(observer(), bearing())
