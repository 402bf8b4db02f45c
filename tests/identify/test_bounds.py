"""Estimates on bounds: told by the force of the bound and the parameter's own standard deviation, not by a scale."""

import casadi as ca
import numpy as np
import pytest
from scipy.signal import cont2discrete

from gbid import LinearStructure, Parameter, Recording, fit
from gbid.identify import FitStatus

TRUE = {"k": 400.0, "d": 2.0, "g": 50.0}


def oscillator_matrices(p):
    """``y'' + d y' + k y = g u``; a parameter z decays a state that no output shows."""
    A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-p["k"], -p["d"]))
    B, C = ca.vertcat(0, p["g"]), ca.DM([[1, 0]])
    if "z" in p:
        A, B, C = ca.diagcat(A, -p["z"]), ca.vertcat(B, 1), ca.DM([[1, 0, 0]])
    return {"A": A, "B": B, "C": C}


def oscillator(*further):
    parameters = [Parameter("k", 300.0, lower=0.0), Parameter("d", 1.0, lower=0.0), Parameter("g", 1.0), *further]
    return LinearStructure("oscillator", parameters, oscillator_matrices, ["u"], ["y"])


def oscillation(size=1.0, noise=0.01, seed=0):
    """A record of the oscillator by the matrices of scipy, with outputs times `size`."""
    rng, n = np.random.default_rng(seed), 2000
    u = np.repeat(rng.choice([-1.0, 1.0], n // 10), 10)
    A, B = np.array([[0.0, 1.0], [-TRUE["k"], -TRUE["d"]]]), np.array([[0.0], [TRUE["g"]]])
    F, G, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), 0.01)
    x, y = np.zeros(2), np.empty(n)
    for i in range(n):
        y[i] = x[0]
        x = F @ x + G[:, 0] * u[i]
    y = size * (y + noise * y.std() * rng.standard_normal(n))
    return Recording({"u": u[:, None], "y": y[:, None]}, 0.01, name="oscillation")


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
@pytest.mark.parametrize("size", [1.0, 1e4, 1e6])
def test_an_estimate_far_from_its_bound_has_a_standard_deviation_in_every_unit(size, focus):
    result = fit(oscillator(), oscillation(size=8 * size), focus=focus)
    assert result.success
    assert not result.notes
    for name, true in {**TRUE, "g": TRUE["g"] * 8 * size}.items():
        assert 0 < result.std[name] < 0.01 * true
        assert abs(result.parameters[name] - true) < 4 * result.std[name]


@pytest.mark.parametrize("bounds", [(0.0, 10.0), (0.0, np.inf), (-np.inf, np.inf)])
def test_a_parameter_without_effect_is_not_determined_whatever_its_bounds(bounds):
    structure = oscillator(Parameter("z", 5.0, *bounds))
    result = fit(structure, oscillation(), focus="simulation", start={"g": 40.0}, window=None)
    assert result.status is FitStatus.NOT_DETERMINED
    assert any("the data do not determine z:" in note for note in result.notes)
    assert not any("lies on a bound" in note for note in result.notes)
    assert np.isnan(result.std["z"])


@pytest.mark.parametrize("size", [1.0, 1e6])
@pytest.mark.parametrize("beyond", [0.5, 5.0, 1000.0])
def test_a_bound_beyond_which_the_criterion_falls_holds_the_estimate(beyond, size):
    """The bound is so many standard deviations above the estimate without it."""
    record = oscillation(size=size)
    free = fit(oscillator(), record, focus="simulation")
    lowest = free.parameters["d"] + beyond * free.std["d"]
    result = fit(oscillator(), record, focus="simulation", start={"d": lowest + 0.3}, bounds={"d": (lowest, np.inf)})
    assert result.success
    assert "d lies on a bound: no standard deviation [GB101]" in result.notes
    assert 0 <= result.parameters["d"] - lowest < 0.1 * free.std["d"]
    assert np.isnan(result.std["d"])
    assert np.isfinite([result.std["k"], result.std["g"]]).all()


@pytest.mark.parametrize("below", [0.05, 0.5])
def test_a_bound_that_does_not_hold_the_estimate_is_not_named(below):
    """Half a standard deviation away, or a twentieth: the estimate is the one without the bound."""
    record = oscillation()
    free = fit(oscillator(), record, focus="simulation")
    lowest = free.parameters["d"] - below * free.std["d"]
    result = fit(oscillator(), record, focus="simulation", start={"d": lowest + 0.3}, bounds={"d": (lowest, np.inf)})
    assert result.success
    assert not result.notes
    assert result.parameters["d"] == pytest.approx(free.parameters["d"], abs=0.1 * free.std["d"])
    assert result.std["d"] == pytest.approx(free.std["d"], rel=1e-3)


def two_gains(upper):
    """Two gains of which only the sum acts, both between zero and `upper`."""

    def matrices(p):
        return oscillator_matrices({"k": p["k"], "d": p["d"], "g": p["g"] + p["h"]})

    gains = [Parameter(name, 15.0, lower=0.0, upper=upper) for name in ("g", "h")]
    return LinearStructure("two gains", [*oscillator().parameters[:2], *gains], matrices, ["u"], ["y"])


def test_of_two_parameters_of_which_only_the_sum_acts_none_lies_on_a_bound():
    """The optimum is a line between the bounds, on which the solver may stop anywhere."""
    result = fit(two_gains(100.0), oscillation(), focus="simulation", window=None)
    assert result.status is FitStatus.NOT_DETERMINED
    assert any("g, h separately" in note for note in result.notes)


def test_two_bounds_hold_two_parameters_of_which_only_the_sum_acts():
    """The sum cannot be as large as the data want it: at the optimum both are as large as they may be."""
    result = fit(two_gains(20.0), oscillation(), focus="simulation", window=None)
    assert result.success
    assert sum("lies on a bound" in note for note in result.notes) == 2
