"""Loops in the YAML: recordings of the rig under a controller, fits of loops, and problems."""

from types import SimpleNamespace

import numpy as np
import pytest
from experiment_files import printed_by, write_quick

import gbid as package  # the command line has its name
from gbid.control import controller_structure, p_controller, sample_controller
from gbid.core.files import share_folder
from gbid.core.tables import markdown_table, read_values
from gbid.experiment.controllers import early_design
from gbid.experiment.fields import InputError
from gbid.experiment.load import load_experiment
from gbid.experiment.recordings import recording_result
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages import loop as cost
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.experiment.stages.tune import TUNE
from gbid.experiment.structures import make_structure
from gbid.recording import load_recording
from gbid.structure import evaluate

UNSTABLE = """\
format: 1
name: unstable
rig:
  model: rotor.yaml
  operating_points: [{pressure_bar: 7.0, speed_rpm: 6000}]
  duration_s: 0.4
  settle_s: 0.2
  prbs: {recordings: 0}
  stationary: {recordings: 0}
  sensors: {noise_p_m: 1.0e-12, encoder_counts: null}
  loop: {structure: P, gains: {kappa_x: 1.2, kappa_y: 1.1}, recordings: 1, amplitude_m: 1.0e-6, runout: offline}
prefilter: {harmonics: 10}
fits:
  held: {structure: plant, options: {delay: exact, disturbance_gain: states}, loop: {}}
"""
TUNED = """\
format: 1
name: tuned
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  duration_s: 0.2
  loop: {controller: tuned}
controller:
  held: {structure: P, model: theisen2016, operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]}
fits:
  held: {structure: plant, loop: {}}
"""
GAINS = "structure: P, gains: {kappa_x: 1.2, kappa_y: 1.1}"
OFFLINE = f"{GAINS}, recordings: 1, amplitude_m: 1.0e-6, runout: offline"


def _unstable(folder, *changes):
    """The experiment beside a rotor with less damping than the published one, which is unstable without control."""
    text = (share_folder("models") / "theisen2016.yaml").read_text(encoding="utf-8")
    for old, new in (("d_xx: [-1.855e+05", "d_xx: [-1.455e+05"), ("d_yy: [-2.673e+05", "d_yy: [-2.273e+05")):
        assert old in text
        text = text.replace(old, new)
    path = write_quick(folder, *changes, text=UNSTABLE)
    (folder / "rotor.yaml").write_text(text.replace("name: theisen2016", "name: thin_film"), encoding="utf-8")
    return path


def _filtered(path):
    job = Job(load_experiment(path))
    for stage in (RIG, PREFILTER):
        assert all(outcome.state == "made" for outcome in run_stage(job, stage))
    return load_recording(job.experiment.results / "prefiltered" / "p7_n6000_loop1.h5")


def test_the_answers_of_an_unstable_rotor_to_runout_are_filtered(tmp_path):
    """The motion is that of a rotor without run-out and unbalance, which no linear filter could know."""
    shaken = _filtered(_unstable(tmp_path / "shaken"))
    smooth = "runout_amplitude_m: [[0.0], [0.0]], runout_phase_rad: [[0.0], [0.0]]}"
    quiet = f"encoder_counts: null, {smooth}\n  unbalance: {{eccentricity_m: 0.0}}"
    calm = _filtered(_unstable(tmp_path / "calm", ("encoder_counts: null}", quiet)))
    assert shaken.signal("p").std() > 1e-6
    for signal, largest in (("p", 20e-9), ("r", 20e-9), ("u", 150e-9)):  # u has its own noise
        assert np.abs(shaken.signal(signal) - calm.signal(signal)).max() < largest
    np.testing.assert_array_equal(shaken.signal("w"), calm.signal("w"))


def test_the_structure_of_a_fit_is_the_loop(tmp_path):
    plant = package.Plant(package.RotorBearing(delay="exact", disturbance_gain="states"))
    law = p_controller(1.2, 1.1)
    delayed = package.LinearModel(law.A, 0 * law.B, law.C, law.D, B_delayed=law.B, delay=np.array([3e-4, 3e-4]))
    wanted = {
        "loop: {}": package.ClosedLoop(plant, sample_controller(law, 2e-4)),
        f"loop: {{{GAINS}, computation_samples: 0, injected: set point}}": package.ClosedLoop(
            plant, sample_controller(law, 2e-4), computation_samples=0, injected="set point"
        ),
        f"loop: {{{GAINS}, sampled: false, pade_order: 2}}": package.ClosedLoop(plant, delayed, pade_order=2),
        "loop: {structure: P, gains: {kappa_x: 1.2}}": package.ClosedLoop(
            plant, controller_structure("P"), sample_time=2e-4
        ),
    }
    for entry, structure in wanted.items():
        result = make_structure(load_experiment(_unstable(tmp_path, ("loop: {}}", entry + "}"))), "held")
        values = {q.name: 1.0 + 0.1 * i for i, q in enumerate(structure.parameters)} | {"controller_kappa_x": 1.2}
        values = {q.name: values[q.name] for q in structure.parameters}
        one, other = evaluate(result, values), evaluate(structure, values)
        np.testing.assert_allclose(one.A, other.A, rtol=1e-12)
        np.testing.assert_allclose(one.K, other.K, rtol=1e-12)
    assert {q.name: q.fixed for q in result.gains} == {"controller_kappa_x": True, "controller_kappa_y": False}


def test_a_tuned_controller_is_known_before_it_is_tuned(tmp_path):
    job = Job(load_experiment(write_quick(tmp_path, text=TUNED)))
    (task,) = TUNE.tasks(job)
    assert task.key == early_design(job.experiment, "held").key
    assert make_structure(job.experiment, "held", planned=True).inputs == ("w",)
    with pytest.raises(InputError, match="gbid tune"):
        make_structure(job.experiment, "held")
    other = load_experiment(write_quick(tmp_path, ("theisen2016,", "theisen2016, starts: 2,"), text=TUNED))
    keys, others = (
        {name: recording_result(experiment, planned).key for name, planned in experiment.recordings.items()}
        for experiment in (job.experiment, other)
    )
    assert {name: keys[name] != others[name] for name in keys} == {name: "loop" in name for name in keys}
    assert [q.name for q in other.fit_recordings("held")] == ["p6_n0_loop1", "p6_n0_loop2"]


@pytest.mark.parametrize(
    ("changes", "place", "words"),
    [
        ([("prbs: {recordings: 0}", "prbs: {recordings: 1}")], "rig", "so that all are made in the loop"),
        ([(OFFLINE, GAINS)], "rig.loop.runout", "write runout: offline"),
        ([("kappa_x: 1.2, ", "")], "rig.loop.structure", "no value for kappa_x"),
        ([("kappa_x: 1.2", "kapa: 1.2")], "rig.loop.gains", "no gain 'kapa'"),
        ([("1.2, kappa_y: 1.1", "0.01, kappa_y: 0.01")], "rig.loop.structure", "makes the rotor unstable"),
        ([(OFFLINE, "controller: tuned, runout: offline")], "rig.loop.controller", "no section 'controller'"),
        ([("loop: {}", "loop: {beside: hold}")], "fits.held.loop.beside", "did you mean 'held'"),
        ([("loop: {}", "loop: {beside: held}")], "fits.held.loop.beside", "is in a loop itself"),
        ([("loop: {}", "loop: {controller: nix.yaml}")], "fits.held.loop.controller", "no such controller file"),
        ([("loop: {}", "loop: {controller: paper, gains: {a: 1.0}}")], "fits.held.loop", "gains is for structure:"),
        ([("loop: {}", f"loop: {{{GAINS}, delay_s: 1.0e-4}}")], "fits.held.loop", "sampled: false"),
        ([("structure: plant", "structure: rotor_bearing")], "fits.held.loop", "write structure: plant"),
    ],
)  # fmt: skip
def test_problems_of_loops_name_place_and_remedy(tmp_path, capsys, changes, place, words):
    said = " ".join("".join(printed_by(capsys, "check", _unstable(tmp_path, *changes), code=2)).split())
    assert f" {place}: " in said
    assert words in said


def test_the_price_of_a_loop_is_the_ratio_of_the_standard_deviations(tmp_path, monkeypatch):
    text = UNSTABLE + "  open: {structure: plant}\n"
    path = _unstable(tmp_path)
    path.write_text(text.replace("loop: {}", "loop: {beside: open}").replace("recordings: 0", "recordings: 3"))
    path.write_text(path.read_text().replace("model: rotor.yaml", "model: theisen2016"))
    job = Job(load_experiment(path))
    stds = {"held": ({"k": 6.0, "fixed": 0.0},), "open": ({"k": 1.0}, {"k": 2.0}, {"k": 9.0})}

    def entry(name, std):
        options, units = SimpleNamespace(outputs=("u", "p")), {"k": "m"}
        result = SimpleNamespace(success=True, std=std, units=units, recordings=(name,), options=options)
        return SimpleNamespace(model=name, recordings=(name,), result=result)

    def entries(_job, name):
        word = "loop" if name == "held" else "prbs"
        return [entry(f"p7_n6000_{word}{i}", std) for i, std in enumerate(stds[name], start=1)]

    peaks = {"loop1": 3e-6, "prbs1": 1e-6, "prbs2": 4e-6, "prbs3": 2e-6}

    def recording(_job, planned):
        return package.Recording({"p": np.array([[0.0, 0.0], [0.0, -peaks[planned.name[-5:]]]])}, 0.5, units={"p": "m"})

    monkeypatch.setattr(cost, "fit_entries", entries)
    monkeypatch.setattr(cost, "load_fit_input", recording)
    cost._write(job, tmp_path / "held.csv", "held", "open")
    (row,) = read_values(tmp_path / "held.csv", cost.LoopCostRow)
    assert (row.parameter, row.std, row.std_beside, row.recordings_beside) == ("k", 6.0, 2.0, 3)
    assert (row.peak, row.peak_beside, row.duration_s) == (3e-6, 2e-6, 1.0)
    (table,) = cost.cost_tables([row])
    assert table.rows[0][-1] == 3.0
    assert "3.0 µm" in markdown_table(table)
