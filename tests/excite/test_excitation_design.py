"""Excitations: information against brute force, optima in closed form, limits kept, deviations as of a fit."""

import numpy as np
import pytest

import gbid
from gbid.core.errors import UsageError
from gbid.excite import ExcitationLimits, KnownModel, PossibleMachine, known_model
from gbid.excite.goal import LineModel, expected_covariance, goal_of, quantities_of, simulated_outputs
from gbid.excite.signals import optimal_spectrum
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, RotorBearing, evaluate

DT = 1e-3
TRUTH = {"k": 2.0e4, "d": 9.0, "b": 3.0e3, "g": 2000.0}


def spring(gain=True):
    """A mass on a spring, 22 Hz, damping factor 0.032; noise enters the velocity as well."""

    def matrices(p):
        K = {"K": [[0], [p.g]]} if gain else {}
        return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]], **K}

    names = ["k", "d", "b", *(["g"] if gain else [])]
    return LinearStructure("spring", [Parameter(name, TRUTH[name]) for name in names], matrices, "u", "y")


LIMITS = ExcitationLimits(peaks={"u": 1.0, "y": 0.4})
KNOWN = KnownModel(spring(), {}, 1e-3)


@pytest.fixture(scope="module")
def multisine():
    return gbid.design_excitation(KNOWN, duration=3.0, sample_time=DT, limits=LIMITS)


@pytest.fixture(scope="module")
def fitted(multisine):
    errors = 1e-3 * np.random.default_rng(5).standard_normal((multisine.n_samples, 1))
    u = multisine.signals["u"]
    recording = Recording({"u": u, "y": simulated_outputs(KNOWN, u, DT, errors)}, DT, name="first")
    return gbid.fit(spring(), recording, fixed={"g": TRUTH["g"]})


def test_information_of_lines_is_that_of_differences():
    """Independent way: central differences of the simulation by each parameter, over whole periods at rest."""
    structure = RotorBearing(delay="exact", disturbance_gain="none")
    names = [q.name for q in structure.parameters]
    values = dict(
        zip(names, [-6e5, -5e3, -7e3, -7e5, -60, -3, -5, -50, 1.6e5, 2e3, 5e3, 2e5, 5.7e-4, 1.2e-4], strict=True)
    )
    dt, period = 2e-4, 500
    line_model = LineModel.of(KnownModel(structure, values, [2e-8, 3e-8]), dt)
    bins = np.array([5, 12, 13])
    spectrum = 1e-6 * np.array([[1, 0.5j], [0.3, 1 - 1j], [1j, 1]])
    time = np.arange(8 * period)
    u = np.real(np.exp(2j * np.pi * np.outer(time, bins) / period) @ spectrum)
    slopes = []
    for name in names:
        step = 1e-5 * abs(values[name])
        above, below = (
            evaluate(structure, {**values, name: values[name] + sign * step}).simulate(u, dt, intersample="foh")
            for sign in (1, -1)
        )
        slopes.append(((above - below) / (2 * step))[-period - 1 : -1] / [2e-8, 3e-8])
    flat = np.array(slopes).reshape(len(names), -1)
    expected = flat @ flat.T
    computed = line_model.at(bins / (period * dt)).information(spectrum, period)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(computed / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-4)


def test_information_with_a_disturbance_gain_is_that_of_a_fit():
    """The errors move the states through the gain: lines and noise together are the sums of a fit.

    What the errors themselves say of the gain depends on their draw: two hundred samples of the predictor's memory.
    """
    n, bins = 6000, np.array([30, 132, 150, 420])
    spectrum = np.array([[0.2], [0.05j], [0.05], [0.3]])
    u = np.real(np.exp(2j * np.pi * np.outer(np.arange(n), bins) / n) @ spectrum)
    line_model = LineModel.of(KNOWN, DT)
    information = line_model.at(bins / (n * DT)).information(spectrum, n) + line_model.noise_information(n)
    by_lines = np.sqrt(np.diag(np.linalg.inv(information)))
    by_fit = np.sqrt(np.diag(expected_covariance(KNOWN, u, DT).covariance))
    np.testing.assert_allclose(by_lines[:3], by_fit[:3], rtol=0.03)
    assert by_lines[3] == pytest.approx(by_fit[3], rel=0.2)


def test_a_fit_reports_the_deviations_that_were_expected(multisine, fitted):
    assert fitted.success
    known = KnownModel(spring(), {}, 1e-3, fixed=("g",))
    computed = expected_covariance(known, multisine.signals["u"], DT)
    expected = dict(zip(computed.free, np.sqrt(np.diag(computed.covariance)), strict=True))
    for name in "kdb":
        assert fitted.std[name] == pytest.approx(expected[name], rel=0.05)
        assert abs(fitted.parameters[name] - TRUTH[name]) < 4 * multisine.std[name]
    assert fitted.modes_std[0, 1] == pytest.approx(multisine.std["damping_1"], rel=0.05)


def test_best_line_for_a_lag_is_that_of_the_closed_form():
    """For b/(s + a) with limited input power ``det M`` is ``w^2 / (w^2 + a^2)^4``: one line at a/sqrt(3)."""
    a = 2 * np.pi * 30.0
    lag = LinearStructure(
        "lag", [Parameter("a", a), Parameter("b", a)], lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1]]}
    )
    line_model = LineModel.of(KnownModel(lag, {}, 0.01), 1e-4)
    frequency = np.arange(1.0, 101.0)
    at = line_model.at(frequency)
    costs = np.ones((1, len(frequency), 1, 1), complex)
    goal = goal_of(line_model, quantities_of(line_model), None)
    computed = optimal_spectrum(goal, at.sensitivity, costs, 1000)
    power = computed.cross[:, 0, 0].real
    assert power.sum() == pytest.approx(1.0, rel=1e-6)
    assert power @ frequency == pytest.approx(30 / np.sqrt(3), abs=0.5)
    assert abs(computed.gap) < 1e-2
    flat = optimal_spectrum(goal, at.sensitivity[40:], costs[:, 40:], 1000)
    assert np.argmax(flat.cross[:, 0, 0].real) == 0, "without the best line the nearest one"


@pytest.mark.parametrize("kind", ["multisine", "prbs"])
def test_limits_are_kept_and_the_one_reached_is_named(kind, multisine):
    """Simulated for another length, from rest, and in the other machine as well."""
    machine = PossibleMachine({"d": 4.0}, taken=0.05)
    limits = ExcitationLimits(peaks={"u": 1.0, "y": 0.4}, clearance=0.5, disc="y", taken=0.02, machines=(machine,))
    excitation = gbid.design_excitation(KNOWN, duration=3.0, sample_time=DT, limits=limits, kind=kind)
    u = excitation.signals["u"]
    assert np.abs(u).max() <= 1.0
    true_response, other = (
        evaluate(spring(), {**TRUTH, **p}).simulate(np.tile(u, (4, 1)), DT) for p in ({}, {"d": 4.0})
    )
    assert np.abs(true_response[len(u) :]).max() <= 0.4
    assert np.abs(other[3 * len(u) :]).max() <= 0.45
    assert excitation.reached
    assert max(excitation.use.values()) == pytest.approx(0.98, abs=2e-3)
    if kind == "prbs":
        assert set(np.unique(np.abs(u)).round(12)) == {round(excitation.sequence.amplitude, 12)}
    else:
        assert "clearance in all machines" in excitation.reached, "half the damping, twice the motion"
        assert "y" in multisine.reached, "without the other machine, the limit of the output itself"


def test_a_clearance_alone_is_kept_less_what_is_taken():
    limits = ExcitationLimits(peaks={"u": 1.0}, clearance=0.3, disc="y", taken=0.02)
    excitation = gbid.design_excitation(KNOWN, duration=3.0, sample_time=DT, limits=limits)
    u = excitation.signals["u"]
    motion = np.abs(evaluate(spring(), TRUTH).simulate(np.tile(u, (4, 1)), DT)[len(u) :]).max()
    assert motion == pytest.approx(0.98 * 0.28, rel=5e-3)
    assert "clearance" in excitation.reached


def test_what_counts_becomes_better(multisine):
    chosen = gbid.design_excitation(KNOWN, duration=3.0, sample_time=DT, limits=LIMITS, focus="damping_1")
    assert chosen.counted == ("damping_1",)
    assert chosen.std["damping_1"] < 0.97 * multisine.std["damping_1"]
    weighed = gbid.design_excitation(KNOWN, duration=3.0, sample_time=DT, limits=LIMITS, focus={"k": 1.0})
    assert weighed.std["k"] < min(chosen.std["k"], 0.7 * multisine.std["k"]), "one number alone: c-optimal"


def test_a_fit_is_a_model_whose_information_counts(fitted, multisine):
    """The tangent has the information of the structure; with the first recording every deviation is smaller."""
    u = multisine.signals["u"]
    known = KnownModel(spring(), fitted.parameters, np.sqrt(fitted.error_covariance[0]), fixed=("g",))
    a, b = (expected_covariance(model, u, DT).covariance for model in (known, known_model(fitted)))
    np.testing.assert_allclose(a, b, rtol=1e-6)
    following = gbid.design_excitation(fitted, duration=3.0, sample_time=DT, limits=LIMITS)
    for name in ("k", "d", "b"):
        assert following.std_together[name] < min(following.std[name], fitted.std[name])
    assert multisine.std_together is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "chirp"}, "choose 'prbs' or 'multisine'"),
        ({"limits": {"y": 1.0}}, "input u has no limit"),
        ({"limits": {"u": 1.0, "z": 1.0}}, "no signal 'z'"),
        ({"limits": {"u": -1.0}}, "a number above 0"),
        ({"focus": "tau_*"}, "nothing matches 'tau_\\*'"),
        ({"focus": ("k", "frequency_1", "damping_1", "d")}, "depend on each other"),
        ({"duration": 0.05}, "at least 200"),
        ({"model": spring()}, "give FitResult or KnownModel"),
    ],
)
def test_wrong_arguments_are_named(change, words):
    model = change.pop("model", KNOWN)
    with pytest.raises(UsageError, match=words):
        gbid.design_excitation(model, **{"duration": 3.0, "sample_time": DT, "limits": LIMITS, **change})


def test_a_clearance_without_room_and_a_noise_of_zero_are_refused():
    with pytest.raises(UsageError, match="no room to excite"):
        ExcitationLimits(peaks={"u": 1.0}, clearance=1e-5, taken=2e-5)
    with pytest.raises(UsageError, match="one positive standard deviation"):
        KnownModel(spring(), {}, 0.0)
