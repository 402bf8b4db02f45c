"""Rotor bearing whose film stiffens: equations, fit from data alone, and what comes of the result."""

import numpy as np
import pytest
from shaken_rig import NO_RUNOUT, PUBLISHED, TRUE, shaken

import gbid
from gbid.core.errors import UsageError
from gbid.rig import FilmStiffening, Machine, Prbs, Unbalance, record
from gbid.structure import evaluate, nonlinear_model
from gbid.structure.kinds import equations_of

FILM = FilmStiffening(0.9e-6)
STRUCTURE = gbid.RotorBearing(film="stiffening", delay="exact", disturbance_gain="none")
GAINS = {"bd_xx": 200.0, "bd_xy": 0.0, "bd_yx": 50.0, "bd_yy": 100.0}
TRUTH = {**TRUE, "stiffening": FILM.inverse_square_length}


@pytest.fixture(scope="module")
def found():
    """Fit to one second of the rig: its integration in C and its exact delays are independent of the structure."""
    return gbid.fit(STRUCTURE, shaken(seconds=1.0, stiffening=FILM))


def test_stiffness_stiffening_and_delays_of_the_rig_are_found_from_data_alone(found):
    assert found.success
    assert found.parameters["stiffening"] == pytest.approx(TRUTH["stiffening"], rel=0.02)
    for name in ("k_xx", "k_yy", "b_xx", "b_yy"):
        assert found.parameters[name] == pytest.approx(TRUTH[name], rel=0.003)
    assert found.parameters["tau_x"] == pytest.approx(TRUTH["tau_x"], rel=0.002)  # Padé of first order: 2 %
    assert found.parameters["tau_y"] == pytest.approx(TRUTH["tau_y"], abs=3 * found.std["tau_y"])
    linear = gbid.fit(gbid.RotorBearing(disturbance_gain="none"), shaken(seconds=1.0, stiffening=FILM))
    assert abs(linear.parameters["k_xx"] / TRUTH["k_xx"] - 1) > 0.03
    assert (found.fit_percent > linear.fit_percent + 5).all()


@pytest.mark.parametrize("delay", ["pade", "exact"])
def test_linear_part_is_that_of_the_linear_bearing(delay):
    options = {"delay": delay, "disturbance_gain": "none"}
    film = nonlinear_model(equations_of(gbid.RotorBearing(film="stiffening", **options)), TRUTH)
    at_rest, linear = (
        film.linearise(np.zeros(film.n_states), np.zeros(2)),
        evaluate(gbid.RotorBearing(**options), TRUTH),
    )
    for part in ("A", "B", "C", "D", *(["B_delayed", "delay"] if delay == "exact" else [])):
        np.testing.assert_allclose(getattr(at_rest, part), getattr(linear, part), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_delayed_inputs_act_as_in_the_exact_discretisation_with_an_error_of_fourth_order(hold):
    """tau_x is near whole samples and tau_y within the first one; the film is taken away."""
    u = np.cumsum(np.random.default_rng(0).normal(size=(300, 2)), axis=0)
    exact = evaluate(gbid.RotorBearing(delay="exact"), {**TRUTH, "tau_x": 6.001e-4, **GAINS})
    wanted = exact.simulate(u, 2e-4, intersample=hold), exact.predict(u, u, 2e-4, intersample=hold)
    off = []
    for steps in (1, 4):
        values = {**TRUTH, "tau_x": 6.001e-4, "stiffening": 0.0, **GAINS}
        model = nonlinear_model(equations_of(gbid.RotorBearing(film="stiffening", delay="exact")), values, steps=steps)
        made = model.simulate(u, 2e-4, intersample=hold), model.predict(u, u, 2e-4, intersample=hold)
        off.append([np.abs(a - b).max() / np.abs(b).max() for a, b in zip(made, wanted, strict=True)])
    assert (np.array(off[0]) < 1e-4).all()
    assert (np.array(off[0]) > 100 * np.array(off[1])).all()


def test_slopes_away_from_the_centre_are_those_of_the_film():
    model = nonlinear_model(equations_of(STRUCTURE), TRUTH)
    q = np.array([3e-6, -5e-6])
    K = np.array([[TRUTH["k_xx"], TRUTH["k_xy"]], [TRUTH["k_yx"], TRUTH["k_yy"]]])

    def tangent_at(p):
        return K * (1 + TRUTH["stiffening"] * p @ p) + 2 * TRUTH["stiffening"] * np.outer(K @ p, p)

    np.testing.assert_allclose(model.linearise([*q, 0, 0], np.zeros(2)).A[2:4, :2], tangent_at(q), rtol=1e-12)
    spread = np.array([3e-6, 5e-6, 0.1, 0.1])
    of_amplitude = model.linearise([*q, 0, 0], np.zeros(2), amplitude=spread)
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)  # means over normal distributions, exact here
    mean = (
        sum(
            a * b * tangent_at(q + spread[:2] * (i, j))
            for i, a in zip(nodes, weights, strict=True)
            for j, b in zip(nodes, weights, strict=True)
        )
        / weights.sum() ** 2
    )
    np.testing.assert_allclose(of_amplitude.A[2:4, :2], mean, rtol=1e-9)


def test_with_the_unbalance_in_the_fit_the_film_is_found_about_the_centre_while_the_shaft_turns():
    """The rig's rotor turns on an orbit of its unbalance; no prefilter has subtracted it here."""
    true = PUBLISHED.key_parameters(6.0, 6000.0)
    machine = Machine.from_parameters(true, PUBLISHED.actuators, Unbalance(1.5e-6, 0.7), NO_RUNOUT, stiffening=FILM)
    made = record(machine, Prbs(0.6), conditions={"pressure_bar": 6.0, "speed_rpm": 6000.0}, seed=3, name="turning")
    structure = gbid.RotorBearing(film="stiffening", delay="exact", disturbance_gain="none", unbalance=True)
    result = gbid.fit(structure, gbid.recording.with_unbalance(made))
    assert result.success
    for name, value in {**true, "stiffening": FILM.inverse_square_length}.items():
        if name in ("k_xx", "k_yy", "b_xx", "b_yy", "tau_x", "stiffening"):
            assert result.parameters[name] == pytest.approx(value, rel=0.005)
    mass = result.parameters["e_cos"] + 1j * result.parameters["e_sin"]
    assert mass == pytest.approx(1.5e-6 * np.exp(0.7j), rel=0.005)


def test_film_is_for_fits_of_the_bearing_alone():
    with pytest.raises(UsageError, match="film = 'cubic'; choose 'linear' or 'stiffening'"):
        gbid.RotorBearing(film="cubic")
    with pytest.raises(UsageError, match="fits of the bearing alone"):
        gbid.Plant(STRUCTURE)
    with pytest.raises(UsageError, match="is nonlinear; use fit_lpv"):
        gbid.fit_lpv_direct(
            [gbid.Recording({"u": np.ones((9, 2)), "p": np.ones((9, 2))}, 1e-3, name="a")],
            gbid.load_model("theisen2016"),
            structure=STRUCTURE,
        )
