"""Designs on identified models: fits of several recordings, surfaces, and robust designs tried on fresh draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import ACTUATORS, simulated

import gbid
from gbid.control import MaxDamping, PeakSensitivity, controller_model, sensitivities, smallest_damping, tune_robust
from gbid.identify.result import FitStatus
from gbid.lpv import Estimates, LPVFit, fit_lpv
from gbid.structure import KEY_PARAMETERS, evaluate

MODEL = gbid.load_model("theisen2016")
GOALS = [MaxDamping(), PeakSensitivity(2.0)]


@pytest.fixture(scope="module")
def surfaces() -> LPVFit:
    """Surfaces through estimates with known errors and a known scatter between recordings, of 3 % each."""
    rng = np.random.default_rng(3)
    points = np.repeat(np.array(MODEL.operating_points), 3, axis=0)
    values = np.column_stack([MODEL.key_parameters(*points.T)[key] for key in KEY_PARAMETERS])
    size = 0.03 * np.abs(values).mean(axis=0)
    values += size * rng.standard_normal(values.shape) + size * rng.standard_normal(values.shape)
    names = tuple(f"r{i}" for i in range(len(points)))
    result = fit_lpv(Estimates(names, points, values, np.array([np.diag(size**2)] * len(points))))
    return replace(result, model=replace(result.model, actuators=MODEL.actuators))


def test_fits_of_two_recordings_share_a_design() -> None:
    structure = gbid.Plant(gbid.RotorBearing(1, disturbance_gain="none"), gbid.PiezoPair(), outputs="p")  # as the model
    r = 4.5e-6 * np.random.default_rng(0).choice([-1.0, 1.0], (40, 2)).repeat(20, axis=0)
    fits = []
    for pressure in (5.0, 6.0):
        true = {**ACTUATORS, **MODEL.key_parameters(pressure, 0.0)}
        fits.append(gbid.fit(structure, simulated(structure, true, r, h=2e-4), fixed=ACTUATORS, focus="simulation"))
    assert all(computed.success for computed in fits)
    both = gbid.tune(fits, goals=GOALS, starts=1)
    named = gbid.tune({"low": fits[0], "high": fits[1]}, goals=GOALS, start=both.gains, starts=0)
    assert named.worst.where in ("low", "high")
    assert named.value == pytest.approx(both.value, rel=1e-5)
    machine = replace(MODEL, actuators=ACTUATORS)
    known = gbid.tune(machine, goals=GOALS, operating_points=[(5.0, 0.0), (6.0, 0.0)], starts=1)
    assert both.value == pytest.approx(known.value, rel=1e-5)
    assert dict(both.gains) == pytest.approx(dict(known.gains), rel=1e-3)
    assert not any("converge" in note for note in both.notes)
    stopped = fits[0].changed(status=FitStatus.ITERATION_LIMIT)
    told = gbid.tune(stopped, goals=GOALS, start=both.gains, starts=0).notes
    assert sum("did not converge" in note for note in told) == 1


def test_robust_design_on_surfaces_holds_on_plants_drawn_anew(surfaces: LPVFit) -> None:
    robust = tune_robust(
        surfaces, goals=GOALS, probability=0.9, draws=30, fresh=50, starts=1, operating_points=[(6.0, 0.0)]
    )
    assert robust.result.success
    # plants drawn here from covariance and scatter, one by one
    terms = np.array([1.0, 6.0, 0.0, 0.0, 36.0, 0.0])
    per_point = np.kron(np.eye(len(KEY_PARAMETERS)), terms)
    spread = per_point @ surfaces.covariance @ per_point.T + surfaces.scatter
    rng, n = np.random.default_rng(11), 60
    nominal = np.array([*surfaces.model.key_parameters(6.0, 0.0).values()], float)
    K, held, kept = controller_model(robust.result.controller, robust.result.gains), 0, 0
    for values in rng.multivariate_normal(nominal, spread, n):
        drawn = {key: (value, *5 * (0.0,)) for key, value in zip(KEY_PARAMETERS, values, strict=True)}
        loop = sensitivities(replace(surfaces.model, coefficients=drawn).plant_at(6.0, 0.0), K)
        held += smallest_damping(loop.model("output")) >= robust.promised
        kept += loop.peak("output").value <= 2.0 * np.exp(1e-3)
    noise = 2.5 * np.sqrt(0.09 / n)
    assert held / n > 0.9 - noise
    assert kept / n > robust.keeps_limits - noise
    nominal_design = gbid.tune(surfaces, goals=GOALS, operating_points=[(6.0, 0.0)], starts=1)
    assert robust.promised < nominal_design.value


def arm(k: float, seed: int) -> gbid.FitResult:
    """Fit of ``x'' + d x' + k x = b u`` from a short recording."""
    names = [gbid.Parameter(*given) for given in (("k", 90.0), ("d", 0.6), ("b", 80.0))]
    structure = gbid.LinearStructure(
        "arm", names, lambda p: {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}, "u", "x"
    )
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (60, 1)).repeat(10, axis=0)
    x = evaluate(structure, {"k": k, "d": 0.4, "b": 100.0}).simulate(u, sample_time=5e-3)
    x += 0.3 * rng.standard_normal(x.shape)
    return gbid.fit(structure, gbid.Recording({"u": u, "x": x}, 5e-3, name=f"k{k:g}"), focus="simulation")


def test_robust_design_on_single_fits_holds_on_models_drawn_anew() -> None:
    fits = [arm(100.0, 1), arm(140.0, 2)]
    form = gbid.controller_structure("PD", axes=("",), lower=-2.0, upper=0.9, kd_limit_ms=60.0, lowpass_hz=20.0)
    robust = tune_robust(fits, form, goals=GOALS, probability=0.9, draws=30, fresh=100)
    assert robust.result.success
    K = controller_model(form, robust.result.gains)
    rng, n, held = np.random.default_rng(5), 60, 0
    for _ in range(n):
        reached = []
        for fit in fits:
            drawn = rng.multivariate_normal([fit.parameters[name] for name in fit.free], fit.covariance)
            values = dict(zip(fit.free, drawn, strict=True))
            model = gbid.LinearModel([[0, 1], [-values["k"], -values["d"]]], [[0], [values["b"]]], [[1, 0]], [[0]])
            named = replace(K, input_names=model.output_names, output_names=model.input_names)
            reached.append(smallest_damping(sensitivities(model, named).model("output")))
        held += min(reached) >= robust.promised
    assert held / n > 0.9 - 2.5 * np.sqrt(0.09 / n)
    nominal = gbid.tune(fits, form, goals=GOALS)
    assert robust.promised < nominal.value
    assert robust.fresh.value.max() - robust.fresh.value.min() > 1e-3
    with pytest.raises(gbid.core.errors.UsageError, match="give fits of linear structures"):
        tune_robust([MODEL, fits[0]], form, goals=GOALS)
