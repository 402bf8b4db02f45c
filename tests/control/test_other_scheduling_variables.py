"""Designs for models over one, two or three scheduling variables, of the bearing or of a structure of a user."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compilers import NEEDS_COMPILER

import gbid
from gbid.control import Uncertainty, controller_structure, load_controller, save_controller, scheduled
from gbid.core.errors import UsageError
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import ChainInput, PythonChain
from gbid.lpv import Domain, LPVModel
from gbid.structure.scheduling import exponents_of

PAPER = gbid.load_model("theisen2016")
TS = 2e-4
RANGES = {"pressure_bar": (3.0, 7.0), "eccentricity": (0.0, 0.4), "temperature_k": (290.0, 330.0)}


def machine(*names: str) -> LPVModel:
    """Machine of the paper at 5 bar and rest, with stiffness and damping linear in each variable."""
    middle = PAPER.key_parameters(5.0, 0.0)
    domain = Domain(*(RANGES[name] for name in names), variables=names)
    rows = {}
    for key, value in middle.items():
        rise = {"k": 0.1, "d": -0.1}.get(key[0], 0.0) * float(value)
        slopes = [rise / (high - low) for low, high in domain.bounds]
        rows[key] = (float(value) - sum(s * low for s, (low, _) in zip(slopes, domain.bounds, strict=True)), *slopes)
    corners = tuple(map(tuple, domain.corners.tolist()))
    about = {"actuators": PAPER.actuators, "machine": PAPER.machine, "operating_points": corners, "pade_order": 3}
    return LPVModel("other", rows, domain, exponents=exponents_of(1, len(names)), **about)


@pytest.mark.parametrize("names", [("eccentricity",), ("pressure_bar", "eccentricity"), tuple(RANGES)])
def test_design_over_any_number_of_variables_reaches_its_c(names, tmp_path):
    model = machine(*names)
    law = scheduled(controller_structure("P"), ("1", "eccentricity"), model.domain)
    result = gbid.tune(model, law, sample_time=TS, starts=0)
    assessment = gbid.assess(model, result)
    assert assessment.points[-1].place == dict(zip(names, model.operating_points[-1], strict=True))
    assert min(q.sampled_damping for q in assessment.points) == pytest.approx(result.value, rel=1e-6)
    saved = tmp_path / "other.yaml"
    save_controller(saved, result, provenance={"piezo_travel_m": 45e-6, "clearance_m": 25e-6})
    design = load_controller(saved)
    point = [0.5 * sum(RANGES[name]) for name in names]
    gains = result.controller.gains(result.gains, *point)
    assert design.at(*point).static_gain()[0, 0] == pytest.approx(gains["kappa_x"])
    assert design.at(**dict(zip(names, point, strict=True))).static_gain()[0, 0] == pytest.approx(gains["kappa_x"])
    chain = chain_of(design, name="other", options=ChainOptions(fade_s=TS, ramp_s=TS))
    row = chain.row(chain.controller, [dict(zip(names, point, strict=True)).get(q, 0.0) for q in chain.scheduling])
    exact = design.sampled_at(*point)
    entries = np.concatenate([np.hstack([exact.C, exact.D]).ravel(), np.hstack([exact.A, exact.B]).ravel()])
    assert all(np.abs(entries - value).min() < 1e-3 * np.abs(entries).max() for value in row[:4])


@NEEDS_COMPILER
def test_c_and_python_agree_to_the_bit_over_three_variables():
    model = machine(*RANGES)
    law = scheduled(controller_structure("P"), ("1", "eccentricity temperature_k", "pressure_bar^2"), model.domain)
    random = np.random.default_rng(0)
    gains = {p.name: float(random.uniform(-1, 1)) for p in law.parameters}
    design = gbid.control.ControllerDesign("three", law, gains, TS)
    options = ChainOptions(stroke_m=45e-6, disc_limit_m=20e-6, fade_s=TS, ramp_s=TS)
    chain = chain_of(design, name="other", options=options)
    assert chain.scheduling == ("pressure_bar", "speed_rpm", "eccentricity", "temperature_k")
    samples = [
        ChainInput(
            tuple(3e-6 * random.normal(size=2)),
            pressure_bar=random.uniform(2, 8),
            further=(random.uniform(0, 0.5), random.uniform(280, 340)),
        )
        for _ in range(400)
    ]
    assert CompiledChain(chain).run(samples) == PythonChain(chain).run(samples)


def test_design_holds_for_drawn_plants_of_such_a_model():
    model = machine("pressure_bar", "eccentricity")
    small = 1e-6 * np.diag([c**2 for row in model.coefficients.values() for c in row])
    result = gbid.tune(model, uncertainty=Uncertainty(small, draws=2), starts=0)
    assert result.value <= gbid.tune(model, starts=0).value + 1e-9
    with pytest.raises(UsageError, match="covariance of 84 coefficients, a model with 3 terms"):
        gbid.tune(model, uncertainty=Uncertainty(np.eye(84)))


def test_surfaces_of_a_plant_structure_are_tuned_as_they_are():
    """The actuators are parameters of the structure; `tune` said that the model had none."""
    bearing, plant = machine("pressure_bar", "eccentricity"), gbid.Plant()
    held = {**bearing.actuators, **{q.name: 0.0 for q in plant.parameters if q.name.startswith("bd")}}
    channels = {"input_names": ("r_x", "r_y"), "output_names": ("u_x", "u_y", "p_x", "p_y")}
    model = replace(bearing, structure=plant, actuators={}, held=held, **channels)
    assert gbid.tune(model, starts=0).value == pytest.approx(gbid.tune(bearing, starts=0).value, rel=1e-6)
    exact = [gbid.tune(each, sample_time=TS, starts=0).value for each in (model, bearing)]
    assert exact[0] == pytest.approx(exact[1], rel=1e-6)


def test_other_variables_are_refused_where_pressure_and_speed_are_needed():
    model = machine("pressure_bar", "eccentricity")
    with pytest.raises(
        UsageError, match="scheduled over pressure_bar, speed_rpm, model 'other' over pressure_bar, ecc"
    ):
        gbid.tune(model, scheduled(controller_structure("P")))
    with pytest.raises(UsageError, match=r"terms = .*choose from '1', 'eccentricity'"):
        scheduled(controller_structure("P"), ("1", "P"), machine("eccentricity").domain)
    notch = controller_structure("resonant")
    with pytest.raises(UsageError, match="follows speed_rpm; the scheduling variables are eccentricity"):
        scheduled(notch, ("1",), machine("eccentricity").domain).at(0.1).matrices(None)
    law = scheduled(controller_structure("P"), ("1",), Domain((0.0, 1.0), variables=("mode",)))
    design = gbid.control.ControllerDesign("m", law, {"kappa_x_1": 1.0, "kappa_y_1": 1.0}, TS)
    with pytest.raises(UsageError, match="the input of the chain has mode already"):
        chain_of(design)
