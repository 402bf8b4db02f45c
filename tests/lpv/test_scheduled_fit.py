"""Surfaces of any structure over any scheduling variables."""

from dataclasses import replace

import numpy as np
import pytest

import gbid
from gbid.core.errors import DataError, ExtrapolationWarning, UsageError
from gbid.core.files import share_folder
from gbid.lpv import Domain, LPVModel, save_model
from gbid.lpv.estimates import chosen_exponents
from gbid.structure import evaluate, load_structure
from gbid.structure.scheduling import exponents_of, term_name

ROTOR = load_structure("rigid_rotor.py:structure", share_folder("models"))
SPEEDS = (0.0, 4000.0, 8000.0, 12000.0)
FIXED = {"k_s": 1.5e5, "k_t": 3.2e5, "d_s": 12.0, "d_t": 15.0, "b_s": 0.5, "b_t": 1.1}
GYRO = 0.25 * 2 * np.pi / 60  # rad/s per rpm


def truth(speed):
    return {**FIXED, "g": GYRO * speed}


@pytest.fixture(scope="module")
def fits():
    results = []
    for seed, speed in enumerate(SPEEDS):
        rng = np.random.default_rng(seed)
        f = np.repeat(rng.choice([-5.0, 5.0], (75, 4)), 8, axis=0)
        q = evaluate(ROTOR, truth(speed)).simulate(f, sample_time=5e-4) + 1e-6 * rng.standard_normal((600, 4))
        rec = gbid.Recording({"f": f, "q": q}, 5e-4, name=f"{speed:g} rpm", units={"f": "N", "q": "m"})
        results.append(gbid.fit(ROTOR, rec, focus="simulation", start=truth(speed)))
    assert all(fit.success for fit in results)
    return results


def test_surfaces_of_a_rotor_over_speed(fits):
    surfaces = gbid.fit_lpv(fits, SPEEDS, structure=ROTOR, scheduling="speed_rpm", order=1)
    names = surfaces.estimates.parameters
    assert names == tuple(p.name for p in ROTOR.parameters)
    constant, slope = surfaces.coefficients.T
    std = np.sqrt(np.diag(surfaces.covariance)).reshape(-1, 2)
    expected = {**{name: (value, 0.0) for name, value in FIXED.items()}, "g": (0.0, GYRO)}
    z = np.array([((c, s) - np.array(expected[n])) / d for n, c, s, d in zip(names, constant, slope, std, strict=True)])
    assert np.abs(z).max() < 4
    model = surfaces.model.at(9000.0)
    np.testing.assert_allclose(model.modes(), evaluate(ROTOR, truth(9000.0)).modes(), rtol=2e-3)
    assert model.input_names == ("f_1", "f_2", "f_3", "f_4")
    assert "g" in repr(surfaces)
    frame = surfaces.to_frame()
    assert list(frame.columns) == ["1", "1 std", "speed_rpm", "speed_rpm std"]
    np.testing.assert_allclose(frame.to_numpy(), np.stack([constant, std[:, 0], slope, std[:, 1]], axis=-1))
    assert surfaces.uncertainty_at([0.0, 6000.0]).shape == (2, 7, 7)
    wider = surfaces.uncertainty_at(6000.0, scatter=True) - surfaces.uncertainty_at(6000.0)
    np.testing.assert_allclose(wider, surfaces.scatter, atol=1e-12 * surfaces.scatter.max())


def test_an_ordinary_fit_is_least_squares(fits):
    surfaces = gbid.fit_lpv(fits, SPEEDS, structure=ROTOR, scheduling=("speed_rpm",), order=("1", "speed_rpm^2"),
                         weighting="ordinary", parameters=("g", "k_t"))  # fmt: skip
    X = np.column_stack([np.ones(4), np.square(SPEEDS)])
    for name in ("g", "k_t"):
        expected = np.linalg.lstsq(X, [fit.parameters[name] for fit in fits], rcond=None)[0]
        np.testing.assert_allclose(surfaces.model.coefficients[name], expected, rtol=1e-6, atol=1e-9)
    held = surfaces.model.key_parameters(5000.0)["d_s"]
    assert held == pytest.approx(np.mean([fit.parameters["d_s"] for fit in fits]))
    assert surfaces.notes[-1] == "held at the mean of the fits: k_s, d_s, d_t, b_s, b_t [GB306]"


def test_drawn_models_have_the_covariance_and_stay_within_the_bounds(fits):
    surfaces = gbid.fit_lpv(fits, SPEEDS, structure=ROTOR, scheduling="speed_rpm", order=1)
    drawn = surfaces.draw(300, seed=0)
    g = np.array([one.key_parameters(6000.0)["g"] for one in drawn])
    place = surfaces.estimates.parameters.index("g")
    assert g.std() == pytest.approx(np.sqrt(surfaces.uncertainty_at(6000.0)[place, place]), rel=0.15)
    narrow = tuple(replace(p, lower=p.start * (1 - 1e-12), upper=p.start * (1 + 1e-12)) if p.name == "d_s" else p
                   for p in ROTOR.parameters)  # fmt: skip
    tight = replace(
        surfaces, model=replace(surfaces.model, structure=gbid.LinearStructure("r", narrow, ROTOR.matrices))
    )
    with pytest.raises(UsageError, match="only 0 of 40 draws are within the bounds"):
        tight.draw(2, seed=0)


def test_wrong_use_is_refused(fits):
    with pytest.raises(UsageError, match=r"the surfaces need k_xx.*give structure="):
        gbid.fit_lpv(fits, SPEEDS, scheduling="speed_rpm")
    with pytest.raises(UsageError, match=r"give the \(speed_rpm\) of each of the 4 fits; there are 2"):
        gbid.fit_lpv(fits, SPEEDS[:2], structure=ROTOR, scheduling="speed_rpm")
    with pytest.raises(UsageError, match=r"points: give \(gap, bias\) as numbers"):
        gbid.fit_lpv(fits, SPEEDS, structure=ROTOR, scheduling=("gap", "bias"))
    with pytest.raises(UsageError, match="parameters: k_q; choose from k_s"):
        gbid.fit_lpv(fits, SPEEDS, structure=ROTOR, scheduling="speed_rpm", parameters=("k_q",))
    with pytest.raises(UsageError, match="the fits are of rigid_rotor; give fits of the structure 'rotor_bearing'"):
        gbid.fit_lpv(fits, SPEEDS, structure=gbid.RotorBearing(), scheduling="speed_rpm")
    other = fits[0].changed(parameters={key: v for key, v in fits[0].parameters.items() if key != "g"})
    with pytest.raises(UsageError, match="the structure has g, which not all fits have"):
        gbid.fit_lpv([other, *fits[1:]], SPEEDS, structure=ROTOR, scheduling="speed_rpm", parameters=("k_t",), order=1)
    with pytest.raises(DataError, match="4 operating points for 10 terms"):
        gbid.fit_lpv(fits, [(v, v) for v in SPEEDS], structure=ROTOR, scheduling=("a", "b"), order=3)
    with pytest.raises(UsageError, match="actuators belong to the model of a gas bearing"):
        gbid.fit_lpv(fits, SPEEDS, structure=ROTOR, scheduling="v", actuators={})


def test_the_domain_of_a_scheduled_model(tmp_path):
    linear = {"structure": ROTOR, "exponents": ((0,), (1,)), "held": FIXED}
    model = LPVModel("m", {"g": (0.0, 2.0)}, Domain((0.0, 10.0), variables=("v",)), **linear)
    np.testing.assert_allclose(model.key_parameters([1.0, 2.0])["g"], [2.0, 4.0])
    with pytest.raises(UsageError, match=r"v = 11 lies outside its domain \[0, 10\]"):
        model.at(11.0)
    with pytest.warns(ExtrapolationWarning, match="v = 11 lies outside"):
        assert model.key_parameters(11.0, extrapolate=True)["g"] == 22.0
    with pytest.raises(UsageError, match="give v; got 2 values"):
        model.at(1.0, 2.0)
    with pytest.raises(UsageError, match="give one operating point"):
        model.at([1.0, 2.0])  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="not finite"):
        model.at(np.nan)
    with pytest.raises(UsageError, match=r"coefficients: k_s, .* missing; give a value for each of k_s"):
        LPVModel("m", {"g": (0.0, 2.0)}, model.domain, **{**linear, "held": {}})
    with pytest.raises(UsageError, match="'m' is one of 'rigid_rotor'; this needs the model of a gas bearing"):
        save_model(model, tmp_path / "m.yaml")


def test_terms_of_other_scheduling_variables():
    assert exponents_of(2, 1) == ((0,), (1,), (2,))
    names = [term_name(e, ("a", "b", "c")) for e in exponents_of(2, 3)]
    assert names == ["1", "a", "b", "c", "a^2", "a b", "a c", "b^2", "b c", "c^2"]
    assert chosen_exponents(("a^2", "1"), ("a",)) == ((0,), (2,))
    with pytest.raises(UsageError, match="'P' is not a term; choose from 1, a, a"):
        chosen_exponents(("P",), ("a",))
