"""Fits of nonlinear structures: as linear ones where they are linear, known answers, published estimates, coverage."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from nonlinear_cases import DUFFING, DUFFING_TRUTH, SAME, duffing_recording, mass_recording

import gbid
from gbid import NonlinearStructure, Parameter, Recording
from gbid.structure import nonlinear_model


@pytest.fixture(scope="module")
def masses():
    return [mass_recording(1), mass_recording(2)]


@pytest.mark.parametrize(
    "options",
    [
        {"focus": "simulation", "trend": "offset"},
        {"local": {"b": "recording"}, "prior": {"d": (1.0, 0.05)}, "window": None},
        {"left_out": {"mass 1": [(500, 600)]}, "criterion": "trace"},
        {"trend": "random walk", "initial_state": "zero"},
    ],
    ids=" ".join,
)
def test_linear_equations_give_the_fit_of_the_linear_structure(masses, options):
    linear, other = (gbid.fit(SAME[kind], masses, **options) for kind in ("linear", "nonlinear"))
    assert other.status is linear.status
    assert other.trusted == linear.trusted
    for name in linear.free:
        if np.isfinite(linear.std[name]):
            assert other.parameters[name] == pytest.approx(linear.parameters[name], abs=1e-3 * linear.std[name])
            assert other.std[name] == pytest.approx(linear.std[name], rel=2e-5)


def test_estimates_and_deviations_agree_to_one_in_a_million(masses):
    linear, other = (gbid.fit(SAME[kind], masses, window=None) for kind in ("linear", "nonlinear"))
    for name in linear.free:
        assert other.parameters[name] == pytest.approx(linear.parameters[name], rel=1e-6)
        assert other.std[name] == pytest.approx(linear.std[name], rel=1e-6)
    np.testing.assert_allclose(other.modes_std, linear.modes_std, rtol=1e-6)
    assert np.abs(other.integration_shift).max() < 1e-3


def test_identification_example_of_casadi_is_found_to_eight_digits():
    """CasADi's docs/examples/python/sysid.py: mass, damping and nonlinear spring from data without noise."""
    truth = {"M": 5.625, "c": 2.3, "k": 1.0, "k_nl": 4.69}

    def spring(x, u, p):
        return [x[1], (u[0] - p.k_nl * x[0] ** 3 - p.k * x[0] - p.c * 1e-4 * x[1]) / (p.M * 1e-6)]

    start = [Parameter("M", 5.0), Parameter("c", 2.0), Parameter("k", 1.0), Parameter("k_nl", 5.0)]
    structure = NonlinearStructure("spring", start, ["y", "dy"], spring, lambda x, u, p: x[0], steps=10)
    u = 0.1 * np.random.default_rng(0).random((2000, 1))
    y = nonlinear_model(structure, truth, steps=10).simulate(u, 1 / 610.1)
    result = gbid.fit(structure, Recording({"u": u, "y": y}, 1 / 610.1, name="spring"), initial_state="zero")
    assert result.success
    for name, value in truth.items():
        assert result.parameters[name] == pytest.approx(value, rel=1e-8)


HARES = "30 47.2 70.2 77.4 36.3 20.6 18.1 21.4 22 25.4 27.1 40.3 57 76.6 52.3 19.5 11.2 7.6 14.6 16.2 24.7"
LYNXES = "4 6.1 9.8 35.2 59.4 41.7 19 13 8.3 9.1 7.4 8 12.3 19.5 45.7 51.1 29.7 15.8 9.7 10.1 8.6"


def test_lynx_and_hare_have_the_published_estimates():
    """Posterior of Carpenter (Stan case study, 2018) for Hudson's Bay pelts from 1900 to 1920, on logarithms."""
    published = {"alpha": (0.55, 0.06), "beta": (0.028, 0.004), "gamma": (0.80, 0.09), "delta": (0.024, 0.004)}

    def growth(x, _u, p):  # x are logarithms
        return [p.alpha - p.beta * ca.exp(x[1]), -p.gamma + p.delta * ca.exp(x[0])]

    parameters = [Parameter(name, value) for name, value in zip(published, (1.0, 0.05, 1.0, 0.05), strict=True)]
    structure = NonlinearStructure("pelts", parameters, ["h", "l"], growth, lambda x, u, p: x, (), ["hare", "lynx"])
    pelts = {name: np.log(np.array(text.split(), float))[:, None] for name, text in (("hare", HARES), ("lynx", LYNXES))}
    result = gbid.fit(structure, Recording(pelts, 1.0, name="pelts"), criterion="trace")
    assert result.success
    for name, (mean, deviation) in published.items():
        assert result.parameters[name] == pytest.approx(mean, abs=0.5 * deviation)
        assert result.std[name] == pytest.approx(deviation, rel=0.5)


def _off(seed):
    result = gbid.fit(DUFFING, duffing_recording(seed))
    assert result.success
    return [(result.parameters[name] - value) / result.std[name] for name, value in DUFFING_TRUTH.items()]


def test_deviations_of_a_duffing_oscillator_are_those_of_its_estimates():
    off = np.array([_off(seed) for seed in range(8)])
    assert np.abs(off).max() < 4
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.5


@pytest.mark.slow
def test_intervals_of_a_duffing_oscillator_cover():
    inside = np.abs([_off(seed) for seed in range(200)]) < 1.959964
    print(f"intervals of 95 % cover {100 * inside.mean():.1f} % ({inside.mean(axis=0)})")  # noqa: T201
    assert 0.93 <= inside.mean() <= 0.97


def test_too_coarse_an_integration_is_refined_or_said():
    recording = duffing_recording(4, noise=1e-5, steps=16)
    fine = gbid.fit(DUFFING, recording)
    assert fine.model.steps > 1
    assert np.abs(fine.integration_shift).max() < 0.1
    at_once = gbid.fit(replace(DUFFING, steps=fine.model.steps), recording)  # not from the end of a coarser solve
    assert all(abs(fine.parameters[name] - at_once.parameters[name]) < 1e-3 * at_once.std[name] for name in fine.free)
    coarse = NonlinearStructure(
        DUFFING.name, DUFFING.parameters, DUFFING.states, DUFFING.dynamics, DUFFING.output, steps=1
    )
    result = gbid.fit(coarse, recording)
    assert np.abs(result.integration_shift).max() > 0.1
    assert any("error of the integration" in note for note in result.notes)
    for name, shift in zip(result.free, result.integration_shift, strict=True):  # what was measured is what comes
        shifted = (fine.parameters[name] - result.parameters[name]) / result.std[name]
        assert shifted == pytest.approx(shift, rel=0.2, abs=0.3)


def test_a_stiff_structure_needs_the_implicit_integrator():
    def slow_and_fast(x, u, p):
        return [-p.a * x[0] ** 3 + x[1], 1e5 * (u[0] - x[1])]

    parts = ("stiff", [Parameter("a", 0.5)], ["x", "z"], slow_and_fast, lambda x, u, p: x[0])
    with pytest.raises(gbid.core.errors.UsageError, match="the equations are stiff; use integrator='implicit'"):
        gbid.fit(NonlinearStructure(*parts), duffing_recording(0, n=100))
    stiff = NonlinearStructure(*parts, integrator="implicit")
    u = duffing_recording(0, n=300).signal("u")
    y = nonlinear_model(stiff, {"a": 0.8}, steps=32).simulate(u, 0.1)
    y = y + 1e-3 * np.random.default_rng(0).normal(size=y.shape)
    result = gbid.fit(stiff, Recording({"u": u, "y": y}, 0.1, name="stiff"))
    assert result.success
    assert abs(result.parameters["a"] - 0.8) < 4 * result.std["a"]


def test_stored_fits_simulate_and_validate_without_their_structure(tmp_path):
    recording, other = duffing_recording(5), duffing_recording(6)
    result = gbid.fit(DUFFING, recording)
    large = result.changed(model=replace(result.model, equations=result.model.equations + " " * 70_000))
    gbid.save(large, tmp_path / "large.h5")  # an attribute of HDF5 holds 64 kB, if the text is inside of it
    assert gbid.load(tmp_path / "large.h5").model.equations == large.model.equations
    gbid.save(result, tmp_path / "fit.h5")
    stored = gbid.load(tmp_path / "fit.h5")
    u = other.signal("u")
    np.testing.assert_array_equal(stored.model.simulate(u, 0.1), result.model.simulate(u, 0.1))
    np.testing.assert_array_equal(stored.integration_shift, result.integration_shift)
    validation = gbid.cross_validate(stored, other)
    assert validation.fit_percent.min() > 97
    np.testing.assert_allclose(validation.initial_state, 0, atol=0.02)
    assert gbid.check_residuals(stored, other).white.all()
    at_rest = stored.model.linearise(np.zeros(2))
    k, d = (result.parameters[name] for name in "kd")
    np.testing.assert_allclose(at_rest.A, [[0, 1], [-k, -d]], rtol=1e-12)
