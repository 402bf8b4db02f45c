"""Performance of designs: the paper's design and its printed figures."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import gbid
from gbid.control import MaxDamping, scheduled
from gbid.control.assessment import FIGURES, DesignFigures, comparison_table, conditions_words
from gbid.control.controllers.built_in import PStructure
from gbid.core.errors import UsageError
from gbid.export import chain_of
from gbid.structure import LinearModel

MACHINE = gbid.load_model("theisen2016")
GAINS = {"kappa_x": 1.125, "kappa_y": 0.99}


@pytest.fixture(scope="module")
def paper() -> object:
    return gbid.assess(MACHINE, "P", GAINS, name="paper")


def test_the_papers_design_at_six_bar() -> None:
    (point,) = gbid.assess(MACHINE, "P", GAINS, [(6, 0)]).points
    modes = [(round(f, 1), round(zeta, 3)) for f, zeta in point.modes[:2]]
    assert modes == [(99.9, 0.318), (105.1, 0.424)]  # Tables 3 and 4, "expected from model"
    assert round(point.damping, 3) == 0.318
    assert round(point.peak_output.value, 3) == 2.283
    assert point.stable
    assert not point.exceeds_travel


def test_the_papers_design_over_the_operating_points(paper: object) -> None:
    worst = paper.worst  # type: ignore[attr-defined]
    assert round(worst["damping"][0], 3) == 0.279
    assert round(worst["peak_output"][0], 2) == 2.62
    assert list(worst) == list(FIGURES)
    assert len(paper.points) == 15  # type: ignore[attr-defined]
    for name, (value, point) in worst.items():
        assert value == point.figures()[name]
        others = [p.figures()[name] for p in paper.points]  # type: ignore[attr-defined]
        assert value in (min(others), max(others))


def test_no_feedback_is_the_open_loop() -> None:
    (point,) = gbid.assess(MACHINE, "P", {"kappa_x": 0.0, "kappa_y": 0.0}, [(6, 0)]).points
    assert point.damping == pytest.approx(MACHINE.at(6, 0).modes()[1][1], rel=1e-9)
    assert point.peak_output.value == pytest.approx(1.0, abs=1e-7)
    assert point.peak_control.value == 0.0
    assert point.disk.alpha == pytest.approx(2.0, rel=1e-12)
    assert point.stiffness_ratio == pytest.approx((1.0, 1.0), rel=1e-12)
    assert point.stack_travel_m == 0.0
    assert point.sampled_damping == pytest.approx(point.damping, abs=1e-9)


def test_an_unstable_design_is_worst_in_everything() -> None:
    (point,) = gbid.assess(MACHINE, "P", {"kappa_x": 2.0, "kappa_y": 2.0}, [(6, 0)]).points
    assert not point.stable
    assert not point.sampled_stable
    assert point.damping == -1.0
    assert point.slowest_decay_hz < 0
    assert point.static_amplification == np.inf
    assert point.disk.alpha == 0.0
    assert point.exceeds_travel


def test_scheduled_gains_are_taken_at_each_point() -> None:
    structure = scheduled(PStructure(), ("1", "P"), MACHINE.domain)
    gains = {"kappa_x_1": 1.0, "kappa_x_P": 0.2, "kappa_y_1": 0.9, "kappa_y_P": -0.1}
    assessment = gbid.assess(MACHINE, structure, gains, [(3, 0), (7, 0)])
    for point, kappa in zip(assessment.points, ((0.8, 1.0), (1.2, 0.8)), strict=True):
        fixed = gbid.assess(MACHINE, "P", dict(zip(GAINS, kappa, strict=True)), [(point.pressure_bar, 0)]).points[0]
        assert point.figures() == pytest.approx(fixed.figures(), rel=1e-9)


def test_designs_side_by_side(paper: object) -> None:
    weaker = gbid.assess(MACHINE, "P", {"kappa_x": 0.5, "kappa_y": 0.5}, name="half as much")
    table = gbid.compare_designs([paper, weaker])  # type: ignore[list-item]
    assert [row[0] for row in table.rows] == ["paper", "half as much"]
    assert table.columns[:4] == ("design", "continuous damping", "peak S_o", "peak K S_o")
    assert table.rows[0][1:3] == ("0.279", "2.621")
    lines = str(table).splitlines()
    assert len(lines) == 3
    assert len({len(line) for line in lines}) == 1
    elsewhere = gbid.assess(MACHINE, "P", GAINS, [(6, 0)])
    with pytest.raises(UsageError, match="assess both with the same options"):
        gbid.compare_designs([paper, elsewhere])  # type: ignore[list-item]
    with pytest.raises(UsageError, match="no designs"):
        gbid.compare_designs([])


def test_bad_input() -> None:
    with pytest.raises(UsageError, match="no operating points; give points"):
        gbid.assess(MACHINE, "P", GAINS, [])
    with pytest.raises(UsageError, match="lies outside its domain"):
        gbid.assess(MACHINE, "P", GAINS, [(8, 0)])
    with pytest.raises(UsageError, match="no value for kappa_y"):
        gbid.assess(MACHINE, "P", {"kappa_x": 1.0}, [(6, 0)])


def test_a_controller_with_integrators_is_assessed() -> None:
    gains = {"kappa_x": 0.2, "kappa_y": 0.2, "ki_x": -20.0, "ki_y": -20.0}
    assessment = gbid.assess(MACHINE, "PI", gains, [(6, 0)])
    assert assessment.worst["static_amplification"][0] == pytest.approx(0.0, abs=1e-8)
    assert assessment.worst["stiffness_ratio"][0] == np.inf  # no deflection is left under a steady force


def test_figures_of_an_impact_need_the_moving_mass_of_this_machine() -> None:
    def assessed(**known: float) -> gbid.Assessment:
        model = replace(MACHINE, machine=gbid.lpv.MachineData(**known))
        return gbid.assess(model, "P", GAINS, [(6, 0)], name="own")

    heavy = assessed(moving_mass_kg=4.36, piezo_travel_m=1e-6)
    (published,) = gbid.assess(MACHINE, "P", GAINS, [(6, 0)]).points
    assert 2 * heavy.points[0].impact_p_m == pytest.approx(published.impact_p_m, rel=1e-12)
    assert heavy.points[0].exceeds_travel
    assert not published.exceeds_travel
    unknown = assessed()
    assert unknown.impact.mass_kg is None
    assert np.isnan(unknown.points[0].impact_p_m)
    of_impacts = {"disc [µm]", "stack [µm]", "decay [ms]"}
    assert of_impacts <= set(gbid.compare_designs([heavy]).columns)
    assert not of_impacts & set(gbid.compare_designs([unknown]).columns)
    table = comparison_table("own", [DesignFigures.of(unknown)], conditions_words(unknown.impact, 2e-4, "tustin"))
    assert not of_impacts & {row[0] for row in table.rows}
    assert "left out: moving mass not known" in str(table)


def test_the_verdict_of_a_sampled_design_is_that_of_its_loop() -> None:
    w = 300.0
    plant = gbid.LinearModel([[0.0, 1.0], [-(w**2), 2.0]], [[0.0], [w**2]], [[1.0, 0.0]], [[0.0]])
    gain, none = gbid.Parameter("k", 0.0, -0.5, 0.5, unit="m/m"), {"A": ca.SX(0, 0), "C": ca.SX(1, 0)}
    law = gbid.LinearStructure("static", [gain], lambda p: {**none, "D": [[p["k"]]]}, ("p",), ("r",))
    design = gbid.tune(plant, law, goals=[MaxDamping()], sample_time=5e-4)
    assessment = gbid.assess(plant, design)
    # without its delay a static gain moves the frequency only: the modes of s^2 - 2 s + w^2 (1 - k) grow
    assert (assessment.continuous_stable, assessment.sampled_stable, assessment.stable) == (False, True, True)
    assert "sampled loop stable, continuous loop not stable" in repr(assessment)
    continuous = gbid.assess(plant, law, design.gains, sample_time=5e-4)
    assert continuous.sampled_stable
    assert not continuous.stable


def test_a_plant_with_more_channels_is_assessed_as_it_was_tuned() -> None:
    A, B = [[0.0, 1.0], [-900.0, -2.0]], [[0.0, 0.0], [50.0, 1.0]]
    plant = gbid.LinearModel(A, B, [[1.0, 0.0]], np.zeros((1, 2)), input_names=("coil", "push"), output_names=("gap",))
    law, gains = gbid.controller_structure("P", axes=("",), feedback="negative"), {"kappa": 1.0}
    with pytest.raises(UsageError, match="choose channels by inputs= and outputs="):
        gbid.assess(plant, law, gains, sample_time=1e-3)
    design = gbid.assess([plant, plant], law, gains, sample_time=1e-3, inputs=["coil"], outputs=["gap"])
    alone = gbid.LinearModel(A, np.array(B)[:, :1], [[1.0, 0.0]], [[0.0]])
    assert design.points[0].damping == pytest.approx(gbid.assess(alone, law, gains, sample_time=1e-3).points[0].damping)
    assert [point.label for point in design.points] == ["model (1)", "model (2)"]
    assert "nan" not in str(design)
    with pytest.raises(UsageError, match="an LPV model has r and p"):
        gbid.assess(gbid.load_model("theisen2016"), "P", GAINS, inputs=["r_x"])


def test_a_continuous_design_needs_no_sample_time_and_a_loop_without_oscillation_has_damping_one() -> None:
    lag = LinearModel([[-1.0]], [[1.0]], [[1.0]], [[0.0]], input_names=("r",), output_names=("p",))
    law = gbid.controller_structure("P", axes=("",), order=0, feedback="negative")
    result = gbid.tune(lag, law, peak_sensitivity=None)
    alone, both = gbid.assess(lag, result), gbid.assess(lag, result, sample_time=1e-3)
    assert result.value == alone.points[0].damping == both.points[0].damping == both.points[0].sampled_damping == 1.0
    assert alone.sample_time is alone.points[0].sampled_stable is None
    assert alone.stable
    assert np.isnan(alone.worst["sampled_damping"][0])
    assert "sampled damping" not in gbid.compare_designs([alone]).columns
    assert "sampled damping" in gbid.compare_designs([both]).columns
    design = result.design(name="lag")
    assert (design.sample_time, design.at().D.tolist()) == (None, [[-result.gains["kappa"]]])
    for wanted in (design.sampled_at, lambda: chain_of(design), lambda: gbid.save_controller("lag.yaml", result)):
        with pytest.raises(UsageError, match="give sample_time"):
            wanted()
    with pytest.raises(UsageError, match="computation_s and method are those of a sampled loop"):
        gbid.assess(lag, result, computation_s=0.0)
