"""Designs do not depend on the units of a plant, and bounds in other units than its own are named as the reason."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import gbid
from gbid.control import MaxDamping, PeakSensitivity, scheduled
from gbid.core.errors import UsageError
from gbid.lpv import Domain

PD = gbid.controller_structure("PD", axes=("",))
GOALS = [MaxDamping(), PeakSensitivity(4.0)]


def unstable_plant(seed: int, scale: float) -> gbid.LinearModel:
    """Random plant of two states with a pole of 90 1/s, input and output each in units of the root of a scale."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((2, 2))
    A -= (np.linalg.eigvals(A).real.max() - 0.3) * np.eye(2)
    B, C = np.sqrt(scale) * rng.standard_normal((2, 1)), np.sqrt(scale) * rng.standard_normal((1, 2))
    return gbid.LinearModel(300 * A, 300 * B, C, np.zeros((1, 1)))


def designed(seed: int, scale: float) -> gbid.GainResult:
    bounds = dict.fromkeys(("kappa", "kd"), (-50 / scale, 50 / scale))
    return gbid.tune(unstable_plant(seed, scale), PD, goals=GOALS, bounds=bounds)


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 12), marks=pytest.mark.slow)])
def test_a_plant_in_other_units_has_the_same_design(seeds):
    for seed in seeds:
        known = designed(seed, 1.0)
        for scale in (1e-9, 1e9):
            design = designed(seed, scale)
            assert design.status == known.status
            if known.keeps_limits:
                assert design.value == pytest.approx(known.value, rel=1e-6)
                assert design.value == pytest.approx(design.worst.damping, rel=1e-9)


@pytest.mark.parametrize(("stiffness", "damping"), [(25.0, 0.4), (0.0, 20.0), (0.0, 0.0)])
def test_default_bounds_of_a_derivative_gain_follow_the_plant(stiffness, damping):
    bounds, reached = [], []
    for slower in (1.0, 100.0):
        A = np.array([[0.0, 1.0], [-stiffness, -damping]])
        plant = gbid.LinearModel(A / slower, np.array([[0.0], [20.0]]) / slower, np.eye(1, 2), np.zeros((1, 1)))
        law = gbid.controller_structure("PD", axes=("",), feedback="negative", upper=100.0, lowpass_hz=150 / slower)
        design = gbid.tune(plant, law, objective="decay")
        bounds.append(design.controller.parameters[1].upper / slower)
        reached.append(design.gains["kd"] / slower)
    assert bounds[0] == pytest.approx(bounds[1])
    assert min(reached) > 1e3 * 2 / 150  # far above the 3 ms of the bearing, and inside
    assert max(reached) < 0.99 * bounds[0]


def test_bounds_in_other_units_are_named_as_the_reason():
    design = gbid.tune(unstable_plant(0, 1e-9), PD, goals=GOALS)
    assert design.status == "no stabilising gains"
    assert "give bounds= in the units of the plant" in " ".join(design.notes)
    far = gbid.tune(unstable_plant(0, 1.0), PD, goals=GOALS, bounds={"kappa": (-1e-1, 0.1), "kd": (-1e-1, 0.1)})
    assert far.status == "no stabilising gains"
    assert "give bounds=" not in " ".join(far.notes)


def test_bounds_of_a_constant_coefficient_widen_those_of_its_gain():
    structure = scheduled(gbid.controller_structure("P", axes=("",)), ("1", "Omega"), Domain((0.0, 0.0), (0.0, 6000.0)))
    designs = []
    for scale in (1.0, 1e-3):
        models = [gbid.LinearModel([[0, 1], [-(w**2), -6]], [[0], [w**2]], [[scale, 0]], [[0]]) for w in (300, 400)]
        bounds = {p.name: (p.lower / scale, p.upper / scale) for p in structure.parameters}
        designs.append(gbid.tune(models, structure, goals=[MaxDamping()], speeds_rpm=[0, 6000], bounds=bounds))
    plain, small = designs
    assert small.value == pytest.approx(plain.value, rel=1e-6)
    assert abs(small.gains["kappa_1"]) > max(parameter.upper for parameter in structure.parameters)


def test_a_structure_without_states_says_so():
    plant = gbid.LinearModel([[0, 1], [-9e4, -6]], [[0], [9e4]], [[0, 1e-3]], [[0]])
    gain = gbid.Parameter("k", 0.0, -1.0, 1.0, unit="s")
    none = {"A": ca.SX(0, 0), "C": ca.SX(1, 0)}
    law = gbid.LinearStructure("static", [gain], lambda p: {**none, "D": [[p["k"]]]}, ("p",), ("r",))
    design = gbid.tune(plant, law, goals=[MaxDamping()])
    # s^2 + (6 - 90 k) s + 300^2 has the damping (6 - 90 k) / 600, largest at the lower bound
    assert design.value == pytest.approx(96 / 600)
    assert design.design(sample_time=1e-4).sampled_at().D.item() == pytest.approx(-1.0)
    short = gbid.LinearStructure("short", [gain], lambda p: {"D": [[p["k"]]]}, ("p",), ("r",))
    with pytest.raises(UsageError, match="give A and C; without states SX"):
        gbid.tune(plant, short, goals=[MaxDamping()])
