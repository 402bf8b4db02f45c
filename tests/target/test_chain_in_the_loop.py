"""Software in the loop: the compiled chain on the rig in place of its matrices, measured by impacts."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from chain_cases import design
from experiment_files import gbid as command

import gbid
from gbid import load
from gbid.control import ImpactStudy
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.experiment.stages.impact import planned_impacts, recording_result
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.rig import Hammer, Impact, Machine, ProgramController, SampledController, record

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
EXPERIMENT = """\
format: 1
name: loop
rig:
  model: theisen2016
  controller: {controller}
  operating_points: [{{pressure_bar: 6.0, speed_rpm: {speed}}}]
  duration_s: 1.0
  prbs: {{recordings: 0}}
  sensors: {{noise_p_m: {noise}}}
impacts:
  loops: [closed]
  controller: {word}
  repeats: {repeats}
  lags: 2
  operating_points: [{{pressure_bar: 6.0, speed_rpm: {speed}}}]
"""


def test_on_the_rig_the_chain_is_the_sampled_controller() -> None:
    model = gbid.load_model("theisen2016")
    machine = Machine.from_parameters(model.key_parameters(6.0, 0.0), model.actuators)
    controller = design("P")
    sampled = controller.sampled_at()
    zero = (2.0e-6, -3.0e-6)
    parts = [np.array(getattr(sampled, letter)) for letter in "ABCD"]
    matrices = SampledController(*parts, 2e-4, offset=zero)
    chain = chain_of(controller, options=ChainOptions(ramp_s=0.02, fade_s=0.02, zero_m=zero))
    program = ProgramController(CompiledChain(chain), 2e-4)
    hammer = Hammer((Impact.along("x", 0.02),), 0.4)
    options = {"conditions": {"pressure_bar": 6.0, "speed_rpm": 0.0}, "seed": 1, "name": "impact", "settle_s": 0.2}
    runs = [record(machine, hammer, controller=each, **options) for each in (matrices, program)]
    assert runs[1].signal("r").std() > 1e-6
    for signal in ("r", "p", "u"):
        np.testing.assert_allclose(
            runs[1].signal(signal), runs[0].signal(signal), rtol=0, atol=2e-11
        )  # transient of the fade
    assert "program" in runs[1].provenance["controller"]


def run(folder: Path, **words: object) -> list[tuple[float, float, float, float]]:
    """Return measured and designed frequency and damping of each mode."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "loop.yaml"
    path.write_text(EXPERIMENT.format(**words), encoding="utf-8")
    assert command("impact", path) == 0
    (stored,) = (folder / "results" / "loop" / "impacts").glob("*.h5")
    study = load(stored, ImpactStudy)
    return [(*m, *e) for m, e in zip(study.ringdown.modes(), study.expected_sampled, strict=True)]


def test_impacts_on_the_compiled_chain_show_the_designed_damping(tmp_path: Path) -> None:
    words = {"speed": 2050, "noise": 3e-9, "repeats": 2, "word": "paper"}
    for _, damping, _, designed in run(tmp_path, controller="compiled", **words):
        assert damping == pytest.approx(designed, rel=0.01)
        assert designed > 0.4


def test_the_key_knows_what_closes_the_loop(tmp_path: Path) -> None:
    path = tmp_path / "loop.yaml"
    keys = []
    for controller, target in (("python", ""), ("compiled", ""), ("compiled", "target: {median: 3}\n")):
        text = EXPERIMENT.format(controller=controller, speed=0, noise=3e-9, repeats=2, word="paper")
        path.write_text(text + target, encoding="utf-8")
        experiment = Job(load_experiment(path)).experiment
        keys.append(recording_result(experiment, next(iter(planned_impacts(experiment).values()))).key)
    assert len(set(keys)) == 3
