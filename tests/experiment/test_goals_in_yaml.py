"""Goals of a design in the controller section: every goal by name, limits over frequency, errors with their place."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from experiment_files import gbid as command
from experiment_files import write_quick

import gbid
from gbid import control, load
from gbid.control.assessment import TunedDesign
from gbid.core.errors import UsageError
from gbid.experiment.controllers import design_structure, made_goal, no_disturbance, peak_cap
from gbid.experiment.goal_schema import GOALS
from gbid.experiment.load import experiment_json_schema, load_experiment
from gbid.recording import load_recording

RIG = """\
format: 1
name: goals
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  prbs: {recordings: 0}
  stationary: {recordings: 1, duration_s: 0.6}
controller:
"""
ALL = """\
  every:
    goals:
      - {goal: MaxDamping, weight: 2.0}
      - {goal: MinDamping, limit: 0.1, low_hz: 50, high_hz: 300}
      - {goal: SlowestPole, rate: 20.0}
      - {goal: PeakSensitivity, limit: 2.4}
      - {goal: PeakComplementary, limit: {numerator: [3.0], denominator: [0.001, 1.0]}}
      - {goal: PeakControl, limit: [[50, 5.0], [500, 1.0]], soft: true, weight: 0.5}
      - {goal: StaticAmplification, limit: 2.5}
      - {goal: AxisSensitivity, limit: 3.0}
      - {goal: PeakResponse, sources: [f_x, f_y], targets: p_x, limit: 1.0, orders: [1, 2]}
      - {goal: RmsResponse, sources: [f_x, f_y], targets: p_x, limit: 1.0, spectrum: [[1, 2.0, 3.0], [99, 2.0, 4.0]]}
      - {goal: FastestPole, hz: 5000, whirl: forward, low_hz: 30}
      - {goal: RollOff, from_hz: 500, level: 1.0}
      - {goal: MinDiskMargin, alpha: 0.4, channel: 1}
      - {goal: MinGainMargin, factor: 1.2}
      - {goal: MinPhaseMargin, degrees: 20}
      - {goal: RmsPosition, limit_m: 1.0e-5, disturbance: "*still*"}
      - {goal: RmsControl, limit_m: 1.0e-5, disturbance: [p6_n0_still1]}
      - {goal: PiezoTravel, impact: {peak_n: 8.0}, travel_m: 3.0e-5}
  decay: {goals: [{goal: MaxDecay}]}
"""


def test_every_goal_has_its_entry_and_its_arguments(tmp_path: Path) -> None:
    experiment = load_experiment(write_quick(tmp_path, text=RIG + ALL))
    every, decay = (experiment.spec.controller[name].goals for name in ("every", "decay"))
    assert every is not None
    assert decay is not None
    assert {entry.goal for entry in (*every, *decay)} == set(GOALS)
    public = {name for name in control.__all__ if isinstance(getattr(control, name), type)}
    bases = {"Goal", "Wanted", "ResponseGoal", "RmsGoal"}
    goals = {name for name in public if issubclass(getattr(control, name), control.Goal)}
    assert goals - bases == set(GOALS)
    made = {entry.goal: made_goal(entry, no_disturbance) for entry in every}
    assert made["MinDiskMargin"] == control.MinDiskMargin(0.4, channel=1)
    assert made["PeakControl"] == control.PeakControl(((50, 5.0), (500, 1.0)), soft=True, weight=0.5)
    path = {"sources": ("f_x", "f_y"), "targets": ("p_x",)}
    assert made["FastestPole"] == control.FastestPole(5000.0, whirl="forward", low_hz=30.0)
    np.testing.assert_array_equal(made["RmsResponse"].spectrum.density[1], np.diag([2.0, 4.0]))
    np.testing.assert_array_equal(made["RmsResponse"].spectrum.frequency_hz, [1.0, 99.0])
    assert made["PeakResponse"] == control.PeakResponse(**path, limit=1.0, orders=(1.0, 2.0))
    assert made["PiezoTravel"] == control.PiezoTravel(control.HalfSine(8.0), travel_m=3e-5)
    lag = made["PeakComplementary"].limit.frequency_response(np.array([1000 / (2 * np.pi)]))
    assert abs(lag[0, 0, 0]) == pytest.approx(3 / np.sqrt(2))
    assert peak_cap(experiment.spec.controller["every"]) == 2.4
    again = pickle.loads(pickle.dumps(experiment.spec.controller["every"]))  # workers get the experiment this way
    assert again.goals == every
    section = experiment_json_schema()["$defs"]["PeakControlSection"]
    assert set(section["required"]) == {"goal", "limit"}


def test_options_of_a_structure_are_numbers_words_and_lists(tmp_path: Path) -> None:
    options = '{notch_orders: [1.0], gain_sets: ["", ""], coupling: gyroscopic, derivative_khz: [0.1, 2.0], order: 0}'
    path = write_quick(tmp_path, text=f"{RIG}  p: {{structure: PD, options: {options}}}\n")
    experiment = load_experiment(path)
    structure = design_structure(experiment, experiment.spec.controller["p"]).base
    assert (structure.coupling, structure.notch_orders, structure.derivative_khz) == ("gyroscopic", (1.0,), (0.1, 2.0))
    write_quick(tmp_path, text=f"{RIG}  p: {{structure: PD, options: {{coupling: gyro}}}}\n")
    with pytest.raises(UsageError, match="coupling"):
        load_experiment(path)


IMPROPER = "{numerator: [1, 0], denominator: [1]}"
STILL = "{goal: RmsPosition, limit_m: 1.0e-6, disturbance: stil}"


@pytest.mark.parametrize(
    ("section", "line", "words"),
    [
        ("[{goal: PeakSensitivty}]", "goals[0]", "did you mean 'PeakSensitivity'"),
        ("[{limit: 2}]", "goals[0]", "expected a goal with its arguments"),
        ("[{goal: MaxDamping}, {goal: RollOff, level: 1}]", "goals[1].from_hz", "is missing"),
        ("[{goal: PeakControl, limit: [[1, x]]}]", "goals[0].limit", "breakpoints as [[frequency_hz, limit]"),
        (
            "[{goal: RmsResponse, sources: f_x, targets: p_x, limit: 1, spectrum: [[1, 2], [3]]}]",
            "goals[0]",
            "1 sources",
        ),
        ("[{goal: PeakControl, limit: -1}]", "goals[0]", "give a positive number"),
        ("[{goal: PeakControl, limit: [[9, 1], [5, 2]]}]", "goals[0]", "rising frequencies"),
        (f"[{{goal: PeakControl, limit: {IMPROPER}}}]", "goals[0]", "of a higher order than the denominator"),
        ("[{goal: MaxDamping}, {goal: MaxDecay}]", "goals", "either MaxDamping or MaxDecay"),
        ("[{goal: PeakSensitivity, limit: 2}]", "goals", "none of them is an objective"),
        ("[{goal: MaxDamping}], objective: decay", "objective", "write it as a goal, too"),
        (f"[{{goal: MaxDamping}}, {STILL}]", "goals[1].disturbance", "no recording 'stil'"),
        ("[{goal: MaxDamping}], robust: {}", "robust", "needs the surfaces"),
    ],
)
def test_wrong_goals_are_named_with_their_place(tmp_path: Path, section: str, line: str, words: str) -> None:
    path = write_quick(tmp_path, text=f"{RIG}  p: {{goals: {section}}}\n")
    with pytest.raises(UsageError) as caught:
        load_experiment(path)
    first = next(text for text in str(caught.value).splitlines() if f"controller.p.{line}: " in text)
    assert first.startswith(f"{path}:8:")
    assert words in first


def test_a_design_keeps_the_rms_that_a_recording_shows(tmp_path: Path) -> None:
    text = RIG + (
        "  p:\n    operating_points: [{pressure_bar: 6, speed_rpm: 0}]\n"
        "    goals: [{goal: MaxDamping}, {goal: RmsControl, limit_m: LIMIT, disturbance: p6_n0_still1}]\n"
        "    pareto: [1.5]\n"
    )
    model, structure = gbid.load_model("theisen2016"), gbid.controller_structure("P")
    path = write_quick(tmp_path, ("LIMIT", "1.0"), text=text)
    assert command("rig", path) == 0
    recording = load_recording(tmp_path / "results/goals/recordings/p6_n0_still1.h5")
    limit = 0.5 * float(control.recorded_disturbance(recording).rms.max())
    path = write_quick(tmp_path, ("LIMIT", repr(limit)), text=text)
    assert command("tune", path) == 0
    design = load(tmp_path / "results/goals/controller/p.h5", TunedDesign)
    figure = next(goal for goal in design.result.goals if goal.name == "rms of r")
    assert figure.excess == pytest.approx(0.0, abs=1e-5)
    # the rms from the spectrum and the response of an independent loop
    disturbance = control.recorded_disturbance(recording)
    loop = gbid.sensitivities(model.plant_at(6, 0), control.controller_model(structure, dict(design.result.gains)))
    M = loop.response("control", disturbance.frequency_hz)
    power = np.einsum("kij,kjl,kil->k", M, disturbance.density, M.conj()).real
    assert np.sqrt((power * disturbance.widths).sum()) == pytest.approx(limit, rel=0.01)
    assert design.front[0].result.peak_sensitivity == pytest.approx(1.5, abs=1e-6)
