"""A new effect of the rig is one class in effects.py: rig, YAML, checks and provenance find it there."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from experiment_files import QUICK, gbid
from rig_point import machine

from gbid.core.errors import UsageError
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import load_experiment
from gbid.recording import load_recording
from gbid.rig import Prbs, Stationary, effects, record, rig_effect, rig_effects
from gbid.rig.machine import RigEffect


@dataclass(frozen=True)
class FrameSlip(RigEffect):
    """Readings of x jump by `size_m` at `at_s`."""

    size_m: float = 1e-6
    at_s: float = 0.1
    name: str = field(default="frame_slip", init=False)

    def reading(self, run):
        return np.outer(run.time >= self.at_s, [self.size_m, 0.0])


POINT = {"pressure_bar": 5.0, "speed_rpm": 6000.0}


@pytest.fixture
def slip(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(effects, "FrameSlip", FrameSlip, raising=False)
    rig_effects.cache_clear()
    yield
    rig_effects.cache_clear()


def made(*parts, run=None, **options):
    return record(
        machine(effects=parts), run or Prbs(0.2), conditions=POINT, seed=3, name="one", settle_s=0.1, **options
    )


def test_it_is_found_and_changes_the_readings_only(slip) -> None:
    assert {"floor_vibration", "frame_slip", "mains_hum", "probe_drift"} == set(rig_effects())
    plain, slipped = made(), made(rig_effect("frame_slip", size_m=2e-6, at_s=0.1))
    shifted = slipped.signal("p") - plain.signal("p")
    np.testing.assert_allclose(shifted[:, 0], 2e-6 * (plain.time >= 0.1), atol=1e-15)
    np.testing.assert_array_equal(shifted[:, 1], 0.0)
    np.testing.assert_array_equal(slipped.signal("u"), plain.signal("u"))
    stored = json.loads(slipped.provenance["rig"])["effects"]["frame_slip"]
    assert (stored["size_m"], stored["at_s"]) == (2e-6, 0.1)


def test_the_yaml_knows_it(slip, tmp_path: Path) -> None:
    assert "rig:\n" in QUICK
    text = QUICK.replace("rig:\n", "rig:\n  effects: {frame_slip: {at_s: 0.05}}\n")
    path = tmp_path / "one.yaml"
    path.write_text(text, encoding="utf-8")
    assert load_experiment(path).spec.rig.effects == {"frame_slip": {"at_s": 0.05}}
    for wrong, reason in (
        (text.replace("frame_slip", "frame_slop"), "rig.effects.frame_slop: no effect 'frame_slop'; did you mean"),
        (text.replace("at_s", "time"), "unknown option time; choose from size_m, at_s"),
    ):
        path.write_text(wrong, encoding="utf-8")
        with pytest.raises(ExperimentError, match=reason) as caught:
            load_experiment(path)
        assert len(caught.value.problems) == 1


def test_effects_that_ship() -> None:
    quiet = made(run=Stationary(0.4), simulation="stepping").signal("p")
    t = 2e-4 * np.arange(2000)
    hum = (
        made(rig_effect("mains_hum", amplitude_m=1e-6), run=Stationary(0.4), simulation="stepping").signal("p") - quiet
    )
    wave = np.exp(2j * np.pi * 50 * t)
    assert 2 * np.abs(wave @ hum) / 2000 == pytest.approx([1e-6, 1e-6])
    drift = made(rig_effect("probe_drift", x_m_per_s=1e-5), run=Stationary(0.4)).signal("p")
    still = made(run=Stationary(0.4)).signal("p")
    np.testing.assert_allclose((drift - still)[:, 0], 1e-5 * t, atol=1e-15)
    # A vibration of the floor acts like a force: p'' - D p' - K p = a.
    shaken = made(
        rig_effect("floor_vibration", frequency_hz=10.0, acceleration=0.5, direction_deg=0.0), run=Stationary(0.4)
    )
    shifted = 2 * np.exp(-2j * np.pi * 10 * t) @ (shaken.signal("p") - quiet) / 2000
    s, rotor = 2j * np.pi * 10, machine().rotor_bearing
    expected = np.linalg.solve(s**2 * np.eye(2) - s * rotor.damping - rotor.stiffness, [0.5, 0.0])
    assert np.abs(shifted) == pytest.approx(np.abs(expected), rel=0.02)
    with pytest.raises(UsageError, match="amplitude_m = -1"):
        rig_effect("mains_hum", amplitude_m=-1.0)


def test_a_run_makes_it(tmp_path: Path) -> None:
    text = QUICK.replace("rig:\n", "rig:\n  effects: {probe_drift: {x_m_per_s: 1.0e-5}}\n")
    path = tmp_path / "one.yaml"
    path.write_text(text, encoding="utf-8")
    assert gbid("rig", path) == 0
    computed = next((tmp_path / "results").rglob("recordings/*prbs1.h5"))
    assert "probe_drift" in load_recording(computed).provenance["rig"]
