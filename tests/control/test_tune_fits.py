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
from gbid.structure import KEY_PARAMETERS

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
    found = fit_lpv(Estimates(names, points, values, np.array([np.diag(size**2)] * len(points))))
    return replace(found, model=replace(found.model, actuators=MODEL.actuators))


def test_fits_of_two_recordings_share_a_design() -> None:
    structure = gbid.Plant(gbid.RotorBearing(1, disturbance_gain="none"), gbid.PiezoPair(), outputs="p")  # as the model
    r = 4.5e-6 * np.random.default_rng(0).choice([-1.0, 1.0], (40, 2)).repeat(20, axis=0)
    fits = []
    for pressure in (5.0, 6.0):
        true = {**ACTUATORS, **MODEL.key_parameters(pressure, 0.0)}
        fits.append(gbid.fit(structure, simulated(structure, true, r, h=2e-4), fixed=ACTUATORS, focus="simulation"))
    assert all(found.success for found in fits)
    both = gbid.tune(fits, goals=GOALS, starts=1)
    machine = replace(MODEL, actuators=ACTUATORS)
    known = gbid.tune(machine, goals=GOALS, operating_points=[(5.0, 0.0), (6.0, 0.0)], starts=1)
    assert both.value == pytest.approx(known.value, rel=1e-5)
    assert dict(both.gains) == pytest.approx(dict(known.gains), rel=1e-3)
    assert not any("converge" in note for note in both.notes)
    stopped = replace(fits[0], status=FitStatus.ITERATION_LIMIT)
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
