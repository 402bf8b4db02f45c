"""Controllers of fixed structure: against their transfer functions, written out."""

from __future__ import annotations

import numpy as np
import pytest
from own_controller import own

import gbid
from gbid.control import Scheduled, controller_at, controller_model, p_controller, scheduled
from gbid.control.controllers.built_in import PStructure
from gbid.core.errors import UsageError
from gbid.lpv import Domain
from gbid.structure import LinearModel

FREQUENCIES = np.array([0.0, 10.0, 150.0, 900.0, 4000.0])
S = 2j * np.pi * FREQUENCIES


def test_tuned_corner_is_the_fixed_one() -> None:
    fixed = controller_model(PStructure(lowpass_hz=400.0), {"kappa_x": 1.0, "kappa_y": 2.0})
    tuned = controller_model(PStructure(tune_corner=True), {"kappa_x": 1.0, "kappa_y": 2.0, "lowpass_khz": 0.4})
    np.testing.assert_allclose(
        tuned.frequency_response(FREQUENCIES), fixed.frequency_response(FREQUENCIES), rtol=1e-13, atol=1e-16
    )


def test_structure_of_ones_own() -> None:
    structure = gbid.controller_structure(own())
    model = controller_model(structure, {"low": 1.2, "high": 0.4})
    pole = 2 * np.pi * 800.0
    expected = 1.2 + 0.4 * S / (S + pole)
    np.testing.assert_allclose(model.frequency_response(FREQUENCIES)[:, 0, 0], expected, rtol=1e-12)
    with pytest.raises(UsageError, match="options order belong to built-in structures"):
        gbid.controller_structure(own(), order=2)


def test_scheduled_gains_are_polynomials_over_the_scaled_domain() -> None:
    terms = ("1", "P", "Omega", "Omega P", "Omega^2")
    structure = scheduled(PStructure(), terms, Domain((3, 7), (0, 6000)))
    names = [p.name for p in structure.parameters]
    rng = np.random.default_rng(3)
    gains = dict(zip(names, rng.normal(size=len(names)), strict=True))
    assert names[:5] == ["kappa_x_1", "kappa_x_P", "kappa_x_Omega", "kappa_x_OmegaP", "kappa_x_Omega2"]
    P, Omega = 4.5, 1234.0
    p, w = (P - 5) / 2, (Omega - 3000) / 3000
    c = [gains[name] for name in names]
    expected = {f"kappa_{a}": float(np.dot(c[5 * i : 5 * i + 5], [1, p, w, w * p, w * w])) for i, a in enumerate("xy")}
    assert structure.gains(gains, P, Omega) == pytest.approx(expected, rel=1e-13)
    model = controller_at(structure, gains, P, Omega)
    np.testing.assert_allclose(model.C, p_controller(expected["kappa_x"], expected["kappa_y"]).C, rtol=1e-12)
    at = structure.at(P, Omega)
    np.testing.assert_allclose(controller_model(at, gains).C, model.C, rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gbid.controller_structure("PIDD"), "controller = 'PIDD'; choose 'P', 'PD'"),
        (lambda: gbid.controller_structure(3), "kind = 3; give a text or Structure"),
        (lambda: gbid.controller_structure("P", corner=3), "unknown option corner; choose from lowpass_hz, order"),
        (lambda: gbid.controller_structure("P", lowpass_hz=-1.0), "lowpass_hz = -1.0; give a number above 0"),
        (lambda: gbid.controller_structure("P", order=1.5), "order = 1.5; give a whole number"),
        (lambda: gbid.controller_structure("PD", order=0), "without a low-pass it is not proper"),
        (lambda: gbid.controller_structure("P", order=0, tune_corner=True), "tune_corner needs a low-pass"),
        (lambda: gbid.controller_structure("P", lowpass_hz=1e4, tune_corner=True), "it must start in 50 to 2500"),
        (lambda: gbid.controller_structure("biquad", damping=(1.0, 0.5)), r"damping = \(1, 0.5\); give two numbers"),
        (lambda: gbid.controller_structure("biquad", gain_limit=0.0), "gain_limit = 0.0; give a number above 0"),
        (lambda: gbid.controller_structure("P", lower=2.0, upper=1.0), "'P': lower = 2.0 must be below upper = 1.0"),
        (lambda: gbid.controller_structure("PD", kd_limit_ms=-1.0), "kd_limit_ms = -1.0; give a number above 0"),
        (lambda: gbid.controller_structure("P", upper=np.inf), "upper = inf; give a number"),
        (lambda: gbid.controller_structure("P", upper="3"), "upper = '3'; give a number"),
        (lambda: gbid.controller_structure("P", lowpass_hz="1 kHz"), "lowpass_hz = '1 kHz'"),
        (lambda: gbid.controller_structure("biquad", damping=0.5), "damping = 0.5; give two positive"),
        (lambda: gbid.controller_structure("P", axes=(1, 2)), "give each axis a name"),
        (lambda: controller_model(PStructure(), {"kappa_x": 1.0}), "no value for kappa_y"),
        (lambda: controller_model(PStructure(), {"kappa_x": 1.0, "kappa_y": 1, "kd": 1}), "no gain kd; choose from"),
        (
            lambda: controller_model(PStructure(), {"kappa_x": np.nan, "kappa_y": 1}),
            "'kappa_x': nan, .*; give a",
        ),
        (lambda: scheduled(PStructure(), ("P",)), "choose from '1', 'P'"),
        (lambda: scheduled(PStructure(), ("1", "P^3")), "choose from '1', 'P'"),
        (lambda: scheduled(PStructure()).gains({}, 5.0, 0.0), "no value for kappa_x_1"),
        (lambda: at_point(9.0), r"pressure_bar = 9 lies outside its domain \[3, 7\]"),
    ],
)
def test_bad_input(make: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()  # type: ignore[operator]


def at_point(pressure: float) -> LinearModel:
    structure: Scheduled = scheduled(PStructure())
    return controller_at(structure, {p.name: 0.0 for p in structure.parameters}, pressure, 0.0)
