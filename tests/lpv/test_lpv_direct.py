"""Surfaces straight from recordings: against joint fits, finite differences and the rig's truth."""

from dataclasses import replace

import numpy as np
import pytest
from still_rig import EXACT, FIXED, recorded
from study_rig import PAPER, POINTS

import gbid
from gbid.core.errors import DataError, UsageError
from gbid.lpv import LPVModel
from gbid.structure import KEY_PARAMETERS, PiezoPair, RotorBearing


@pytest.fixture(scope="module")
def one_point():
    return [recorded((5.0, 4000.0), i) for i in range(3)]


@pytest.fixture(scope="module")
def scattered():
    rng = np.random.default_rng(1)
    return [recorded(p, i, n=400, scatter=0.01, rng=rng) for i, p in enumerate(np.repeat(POINTS, 2, axis=0).tolist())]


@pytest.fixture(scope="module")
def repeating(scattered):
    """Surfaces for a machine taken for one that repeats itself, and the steps to them."""
    steps = []
    options = {"structure": EXACT, "focus": "simulation", "fixed": FIXED, "scatter": False}
    return gbid.fit_lpv_direct(scattered, PAPER, progress=steps.append, **options), steps


def constant(values):
    return LPVModel("flat", {key: (values[key], 0, 0, 0, 0, 0) for key in KEY_PARAMETERS}, PAPER.domain)


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
def test_flat_surfaces_are_a_joint_fit(one_point, focus):
    """With the constant term alone, a machine that repeats itself has the shared parameters of an ordinary fit."""
    structure = RotorBearing(disturbance_gain="none" if focus == "simulation" else "full")
    gains = {} if focus == "simulation" else {"bd_xy": 0.0, "bd_yx": 0.0, "bd_yy": 0.0}
    noisy = one_point if focus == "simulation" else [_with_gusts(r, i) for i, r in enumerate(one_point)]
    joint = gbid.fit(structure, noisy, focus=focus, fixed=gains)
    assert joint.success
    start = constant({key: 1.01 * joint.parameters[key] for key in KEY_PARAMETERS})
    flat = gbid.fit_lpv_direct(noisy, start, structure=structure, focus=focus, fixed=gains, scatter=False)
    assert flat.success
    for key in KEY_PARAMETERS:
        assert flat.model.coefficients[key][0] == pytest.approx(joint.parameters[key], abs=0.03 * joint.std[key])
        assert flat.model.coefficients[key][1:] == (0, 0, 0, 0, 0)


def _with_gusts(recording, seed):
    """Add what a disturbed rotor shows, so that there is a gain to be found: slow noise on the position."""
    rng = np.random.default_rng(seed)
    gusts = np.cumsum(rng.normal(size=(recording.n_samples, 2)), axis=0) * 30e-9
    return replace(recording, signals={**recording.signals, "p": recording.signal("p") + gusts - gusts.mean(0)})


def test_delays_of_recordings_are_kept_from_below_zero(scattered, repeating):
    """No bound of an unknown says so: the solver has constraints for it, and finds one minimum from two starts."""
    computed, first = repeating
    shifted = {key: tuple(1.01 * c for c in values) for key, values in PAPER.coefficients.items()}
    start, steps = replace(PAPER, coefficients=shifted), []
    options = {"structure": EXACT, "focus": "simulation", "fixed": FIXED, "scatter": False}
    assert computed.success
    assert gbid.fit_lpv_direct(scattered, start, progress=steps.append, **options).success
    assert steps[-1].cost == pytest.approx(first[-1].cost, abs=1e-8)
    delays = [computed.model.key_parameters(*point)[key] for point in POINTS for key in ("tau_x", "tau_y")]
    lowest = next(q.lower for q in EXACT.parameters if q.name == "tau_y")
    assert lowest < min(delays) < lowest + 1e-8  # one of them is there


def test_truth_lies_within_three_standard_deviations(scattered, repeating):
    """And a machine taken for one that repeats itself is off by far more: its moving resonance passes for damping."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(3, 7, 1000), rng.uniform(0, 6000, 1000)])
    mine = gbid.fit_lpv_direct(scattered, PAPER, structure=EXACT, focus="simulation", fixed=FIXED, name="mine")
    results = {True: mine, False: repeating[0]}
    truth = PAPER.key_parameters(*points.T)
    off, z = {}, {}
    for scatter, fit in results.items():
        assert fit.success
        model = fit.model.key_parameters(*points.T)
        std = np.sqrt(np.einsum("nii->ni", fit.uncertainty_at(*points.T)))
        error = np.stack([model[key] - truth[key] for key in KEY_PARAMETERS], axis=-1)
        off[scatter] = dict(zip(KEY_PARAMETERS, np.sqrt(np.mean(error**2, axis=0)), strict=True))
        z[scatter] = error / std
    assert (np.abs(z[True]) < 3).mean() > 0.95
    assert off[True]["d_xy"] < 0.5 * off[False]["d_xy"]
    assert results[True].model.name == "mine"
    assert results[True].model.actuators == PAPER.actuators
    scatter_std = np.sqrt(np.diag(results[True].scatter))
    middle = PAPER.key_parameters(5.0, 3000.0)
    assert scatter_std[0] == pytest.approx(0.01 * abs(middle["k_xx"]), rel=0.35)


def test_surfaces_through_fits_of_several_structures(one_point):
    """Piezo positions or references as inputs, six or four states: the surfaces are the weighted mean of the fits."""
    bearing = RotorBearing(disturbance_gain="none")
    fits = [
        gbid.fit(EXACT, one_point[0], focus="simulation", fixed=FIXED),
        *(gbid.fit(bearing, r, focus="simulation") for r in one_point[1:]),
    ]
    surfaces = gbid.fit_lpv(fits, [(5.0, 4000.0)] * 3, order=0, weighting="fits")
    places = [[each.free.index(key) for key in KEY_PARAMETERS] for each in fits]
    weights = [np.linalg.inv(each.covariance[np.ix_(at, at)]) for each, at in zip(fits, places, strict=True)]
    values = [np.array([each.parameters[key] for key in KEY_PARAMETERS]) for each in fits]
    mean = np.linalg.solve(sum(weights), sum(w @ v for w, v in zip(weights, values, strict=True)))
    np.testing.assert_allclose([surfaces.model.coefficients[key][0] for key in KEY_PARAMETERS], mean, rtol=1e-6)


def test_terms_of_the_start_are_those_of_the_surfaces():
    """At one speed only the pressure has terms; the estimates of the recordings are those of fits of each alone."""
    rng, terms = np.random.default_rng(4), ("1", "P")
    points = np.repeat([(3.0, 0.0), (7.0, 0.0)], 6, axis=0).tolist()
    recordings = [recorded(p, i, n=500, scatter=0.005, noise=1e-10, rng=rng) for i, p in enumerate(points)]
    fits = [gbid.fit(EXACT, r, focus="simulation", fixed=FIXED) for r in recordings]
    two = gbid.fit_lpv(fits, points, order=terms, actuators=PAPER.actuators)
    one = gbid.fit_lpv_direct(recordings, two, structure=EXACT, focus="simulation", fixed=FIXED)
    apart = np.abs(one.estimates.values - two.estimates.values) / np.sqrt(np.diag(two.scatter))
    assert apart.max() < 0.02
    std = np.sqrt(np.diag(two.covariance)).reshape(14, 6)[:, :2]
    assert np.abs((one.coefficients - two.coefficients)[:, :2] / std).max() < 0.05
    assert (one.coefficients[:, 2:] == 0).all()
    assert one.options["method"] == "direct"


def test_bad_input_is_refused(scattered):
    with pytest.raises(DataError, match="states no pressure_bar and speed_rpm"):
        gbid.fit_lpv_direct([replace(scattered[0], conditions={})], PAPER)
    with pytest.raises(DataError, match="do not determine the 6 terms"):
        gbid.fit_lpv_direct(scattered[:4], PAPER)
    with pytest.raises(UsageError, match="k_xx is a surface"):
        gbid.fit_lpv_direct(scattered, PAPER, fixed={"k_xx": 1.0})
    with pytest.raises(UsageError, match="'piezo_pair' has no k_xx"):
        gbid.fit_lpv_direct(scattered, PAPER, structure=PiezoPair())
    with pytest.raises(UsageError, match="is nonlinear; use fit_lpv"):
        gbid.fit_lpv_direct(scattered, PAPER, structure=RotorBearing(film="stiffening"))
    delayed = PAPER.coefficients["tau_x"]
    early = replace(PAPER, coefficients={**PAPER.coefficients, "tau_x": (delayed[0] - 1e-3, *delayed[1:])})
    with pytest.raises(DataError, match=r"tau_x = -0\.\d+ ms at .* bar, .* rpm, and no delay is negative"):
        gbid.fit_lpv_direct(scattered, early, structure=EXACT, fixed=FIXED)
