"""Identification-for-control cycle: what runs in the loop, what the surfaces are fitted to, and what is measured."""

from dataclasses import replace

import numpy as np
import pytest
from experiment_files import write_quick
from figure_cases import BlankPictures

import gbid
from gbid import load
from gbid.cli.stages import next_step
from gbid.control import exact_plant, load_controller, ringing_modes
from gbid.core.errors import UsageError
from gbid.core.tables import read_values, write_csv
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.cycle import CYCLE as CYCLE_STAGE
from gbid.experiment.stages.cycle import CycleRow, cycle_table, made_rows, modes_of_surfaces
from gbid.experiment.stages.fit import FIT
from gbid.experiment.stages.lpv import LPV
from gbid.experiment.stages.rig import RIG
from gbid.experiment.stages.tune import TUNE
from gbid.report.control_sections import cycle_section
from gbid.report.loop_pictures import plot_cycle
from gbid.report.read import Results

CYCLE = """\
format: 1
name: small
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  duration_s: 0.4
  settle_s: 0.2
  prbs: {recordings: 2}
  stationary: {recordings: 1}
fits:
  bearing: {structure: rotor_bearing, options: {pade_order: 1, disturbance_gain: diagonal}, trend: offset, stop: paper}
lpv: {fit: bearing, order: 0, weighting: fits, actuators: theisen2016}
controller:
  feedback: {operating_points: [{pressure_bar: 6.0, speed_rpm: 0}], starts: 1, peak_sensitivity: 2.0}
cycle:
  rounds: 1
  amplitude_m: 3.0e-6
  hold_s: 5e-3
  impacts: {repeats: 2, spacing_s: 0.3, lags: 1}
"""


@pytest.fixture(scope="module")
def cycled(tmp_path_factory):
    job = Job(load_experiment(write_quick(tmp_path_factory.mktemp("cycle"), text=CYCLE)))
    for stage in (RIG, FIT, LPV, TUNE, CYCLE_STAGE):
        assert {outcome.state for outcome in run_stage(job, stage)} == {"made"}
    return job


def test_gbid_run_leaves_out_a_cycle_that_waits_to_be_asked_for(tmp_path):
    requested, usual = (
        load_experiment(write_quick(tmp_path / name, ("  rounds: 1", f"  rounds: 1\n  in_run: {name}"), text=CYCLE))
        for name in ("false", "true")
    )
    assert [CYCLE_STAGE.in_run(experiment) for experiment in (requested, usual)] == [False, True]
    assert next_step(requested, "run").startswith("gbid cycle ")
    assert not next_step(usual, "run").startswith("gbid cycle ")


def test_rounds_are_recorded_in_the_loop_of_the_round_before_and_measured_on_the_rig(cycled):
    rows, results = made_rows(cycled), cycled.experiment.results
    assert [(row.round, row.recordings) for row in rows] == [(0, 2), (1, 3)]

    running = load_controller(results / "controller" / "feedback.yaml").sampled_at(6.0, 0.0)
    recording = gbid.load_recording(results / "recordings" / "round1_p6_n0_prbs1.h5")
    p, r, w = (recording.signal(name) for name in ("p", "r", "w"))
    np.testing.assert_allclose(np.abs(w), 3.0e-6)
    answer = r[1:] - w[1:]  # one sample is for the computation
    expected = running.simulate(p - p.mean(axis=0), 2e-4)[:-1]
    off = (answer - expected)[200:]  # after the unknown state at the start; its zero position is not the mean of p
    np.testing.assert_allclose(off, np.broadcast_to(off.mean(axis=0), off.shape), atol=1e-10)
    assert np.abs(answer).max() > 1e-6

    truth = exact_plant(gbid.load_model("theisen2016"), 6.0, 0.0)
    files = [results / "controller" / "feedback.yaml", results / "cycle" / "round1" / "controller" / "feedback.yaml"]
    for row, file in zip(rows, files, strict=True):
        true = ringing_modes(truth, load_controller(file).sampled_at(6.0, 0.0))
        assert row.converged
        measured = [(row.frequency_1_hz, row.damping_1), (row.frequency_2_hz, row.damping_2)]
        np.testing.assert_allclose(measured, true, rtol=0.03)  # a loop is more than two modes and a lag
        assert 0 < row.reached[1] < 0.03 * row.reached[0]
        assert row.reached[0] == min(row.damping_1, row.damping_2)


def test_nothing_is_made_twice_and_a_changed_cycle_is_refused(cycled):
    assert {outcome.state for outcome in run_stage(cycled, CYCLE_STAGE)} == {"kept"}
    spec = cycled.experiment.spec
    changed = spec.model_copy(update={"cycle": spec.cycle.model_copy(update={"amplitude_m": 2.0e-6})})
    job = replace(cycled, experiment=replace(cycled.experiment, spec=changed))
    with pytest.raises(UsageError, match="made with other settings"):
        run_stage(job, CYCLE_STAGE)
    assert made_rows(job) == []


def test_rows_are_read_as_written_and_shown(cycled, tmp_path):
    rows = made_rows(cycled)
    write_csv(cycle_table(rows), tmp_path / "cycle.csv")
    assert read_values(tmp_path / "cycle.csv", CycleRow) == rows
    axes = plot_cycle(rows)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["promised by the design", "6 bar, 0 rpm"]
    section = cycle_section(Results(cycled), BlankPictures())
    assert len(section.blocks[0].rows) == 2


def test_standard_deviations_of_modes_are_those_of_draws(cycled):
    fit = load(cycled.experiment.results / "cycle" / "round1" / "lpv" / "bearing.h5")
    _, std = modes_of_surfaces(fit, 6.0, 0.0)
    drawn = [model.at(6.0, 0.0).modes()[:2] for model in fit.draw(400, seed=1)]
    np.testing.assert_allclose(std, np.std(np.array(drawn).transpose(0, 2, 1).reshape(400, 4), axis=0), rtol=0.15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("lpv: {fit: bearing, order: 0, weighting: fits, actuators: theisen2016}\n", ""), "no section 'lpv'"),
        (("  rounds: 1\n", "  rounds: 1\n  design: other\n"), "no design 'other'"),
        (("  rounds: 1\n", "  rounds: 1\n  operating_points: [{pressure_bar: 9, speed_rpm: 0}]\n"), "pressure_bar"),
        (("starts: 1", "starts: 1, model: theisen2016"), "does not use the surfaces"),
    ],
)
def test_what_a_cycle_needs_is_checked(tmp_path, change, words):
    with pytest.raises(UsageError, match=words):
        load_experiment(write_quick(tmp_path, change, text=CYCLE))
