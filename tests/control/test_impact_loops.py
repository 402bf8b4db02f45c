"""Further loops in the impacts: each controller runs sampled on the rig, with figures of what an impact does."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from experiment_files import gbid as command
from experiment_files import write_quick
from hypothesis import given, settings
from hypothesis import strategies as st

import gbid
from gbid import report
from gbid.control import (
    ImpactStudy,
    controller_structure,
    exact_plant,
    p_controller,
    ringing_modes,
    sample_controller,
    save_controller,
    scheduled,
    study_impacts,
)
from gbid.control.impact.study import _decay
from gbid.core.errors import UsageError
from gbid.core.hdf5 import load, save
from gbid.rig import Hammer, Impact, Machine, SampledController, SensorChain, Stationary, record

MODEL = gbid.load_model("theisen2016")
PAPER = p_controller(1.125, 0.99)
SAMPLED = sample_controller(PAPER, 2e-4)
POINT = (6.0, 0.0)
YAML = """\
format: 1
name: hits
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  prbs: {recordings: 0}
  stationary: {recordings: 0}
impacts:
  controller: paper
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  repeats: 2
  spacing_s: 0.25
"""
BESIDE = "  controller: paper\n  beside: {soft: soft.yaml, follows: follows.yaml}\n"


def save_beside(folder) -> None:
    """Save a biquad, and a P controller whose gains follow the pressure."""
    soft = {"b0": 0.9, "b1": -0.5, "b2": -1.0, "frequency": 0.5, "damping": 0.7}
    gains = {f"{name}_{axis}": value for name, value in soft.items() for axis in "xy"}
    save_controller(folder / "soft.yaml", controller_structure("biquad"), gains)
    follows = scheduled(controller_structure("P"), ("1", "P"), MODEL.domain)
    rising = {q.name: 0.5 if q.name.endswith("_1") else 0.1 for q in follows.parameters}
    save_controller(folder / "follows.yaml", follows, rising, points=[POINT])


def test_further_loops_run_sampled_on_the_rig(tmp_path, capsys) -> None:
    save_beside(tmp_path)
    path = write_quick(tmp_path, ("  controller: paper\n", BESIDE), text=YAML)
    assert command("impact", path, "--json", "--engine", "serial") == 0
    document = json.loads(capsys.readouterr().out)
    studies = {d["loop"]: d for d in document["impacts"]}
    assert list(studies) == ["open", "closed", "soft", "follows"]
    assert studies["soft"]["published"] == {}
    folder = tmp_path / "results" / "hits" / "impacts"
    assert (folder / "recordings" / "p6_n0_soft_x.h5").is_file()
    for loop in ("soft", "follows"):
        design = gbid.load_controller(tmp_path / f"{loop}.yaml")
        sampled = design.sampled_at(*POINT)
        expected = ringing_modes(exact_plant(MODEL, *POINT), sampled)
        for row, (frequency, damping) in zip(studies[loop]["modes"], expected, strict=True):
            assert row["running_frequency [Hz]"] == pytest.approx(frequency)
            assert row["running_damping"] == pytest.approx(damping)
        # what ran on the rig is the sampled controller: its r follows from the p that it measured
        rec = gbid.load_recording(folder / "recordings" / f"p6_n0_{loop}_x.h5")
        A, B, C, D = (np.array(m) for m in (sampled.A, sampled.B, sampled.C, sampled.D))
        p = rec.signal("p") - rec.signal("p")[:900].mean(axis=0)
        x, r = np.zeros(len(A)), np.zeros_like(p)
        for k in range(len(p) - 1):
            r[k + 1] = C @ x + D @ p[k]
            x = A @ x + B @ p[k]
        after = slice(950, 1200)
        assert np.abs((r - rec.signal("r"))[after]).max() < 0.05 * np.abs(rec.signal("r")).max()
    assert command("impact", path) == 0
    out = capsys.readouterr().out
    for words in ("6 bar, 0 rpm: soft", "6 bar, 0 rpm: follows", "piezo up to"):
        assert words in out


def test_a_further_loop_without_its_controller_leaves_the_others(tmp_path, capsys) -> None:
    text = YAML.replace("  controller: paper\n", "  beside: {best: tuned}\n") + "controller: {feedback: {}}\n"
    path = write_quick(tmp_path, text=text)
    assert command("impact", path, "--json") == 3
    captured = capsys.readouterr()
    assert "impact best: " in captured.err
    assert "`gbid tune` makes it" in captured.err
    document = json.loads(captured.out)
    assert [d["loop"] for d in document["impacts"]] == ["open", "closed"]


@pytest.mark.parametrize(
    ("beside", "words"),
    [
        ("{open: paper}", ("impacts.beside.open", "is reserved; choose another")),
        ("{closed: paper}", ("impacts.beside.closed", "choose another")),
        ("{a: none.yaml}", ("impacts.beside.a", "none.yaml: no such controller file")),
        ("{a: 'tuned:q'}", ("impacts.beside.a", "no section 'controller'")),
        ("{a/b: paper}", ("impacts.beside",)),
        ("{a: 3}", ("impacts.beside.a",)),
        ("[paper]", ("impacts.beside",)),
    ],
)
def test_bad_further_loops_are_named(tmp_path, capsys, beside: str, words: tuple[str, ...]) -> None:
    path = write_quick(tmp_path, ("controller: paper", f"beside: {beside}"), text=YAML)
    assert command("check", path) == 2
    err = " ".join(capsys.readouterr().err.split())
    for word in words:
        assert word in err


@cache
def quiet_hit(axis: str, closed: bool) -> gbid.Recording:
    """Hit a rig whose sensors have no noise."""
    sensors = SensorChain(noise_p_m=0.0, noise_u_m=0.0, noise_f_n=0.0, resolution_p_m=0.0, resolution_u_m=0.0)
    machine = Machine.from_parameters(MODEL.key_parameters(*POINT), MODEL.actuators, sensors=sensors)
    options = {"conditions": {"pressure_bar": POINT[0], "speed_rpm": POINT[1]}, "seed": 1, "name": axis}
    running = None
    if closed:
        zero = record(machine, Stationary(0.2), **options).signal("p").mean(axis=0)
        running = SampledController(SAMPLED.A, SAMPLED.B, SAMPLED.C, SAMPLED.D, 2e-4, offset=zero)
    impacts = tuple(Impact.along(axis, 0.2 + 0.3 * i, 12.0) for i in range(3))
    return record(machine, Hammer(impacts, 1.1), controller=running, **options)


@cache
def study(closed: bool):
    recordings = [quiet_hit(axis, closed) for axis in "xy"]
    return study_impacts(recordings, MODEL, PAPER if closed else None, SAMPLED if closed else None)


@pytest.mark.parametrize("closed", [False, True])
def test_figures_of_impacts_are_those_of_the_rig(closed: bool) -> None:
    # the rig integrates disc and stacks by itself, step by step; the other side is the model's sampled loop
    for found, axis in zip(study(closed).figures, "xy", strict=True):
        assert found.peak_m == pytest.approx(found.peak_simulated_m, rel=0.01)
        assert found.decay_s == pytest.approx(found.decay_simulated_s, rel=0.01)
        assert found.piezo_m == pytest.approx(found.piezo_simulated_m, rel=0.01, abs=1e-9)
        assert found.peak_std_m < 0.01 * found.peak_m
        u = quiet_hit(axis, closed).signal("u")
        assert found.piezo_m == pytest.approx(np.abs(u - u[:900].mean(axis=0)).max() / 2, rel=0.01, abs=1e-9)
    assert (found.piezo_m > 5e-6) == closed


def test_figures_without_a_signal_of_the_piezos_are_not_there() -> None:
    rec = quiet_hit("x", True)
    bare = gbid.Recording({n: v for n, v in rec.signals.items() if n not in ("u", "r")}, 2e-4, rec.conditions)
    found = study_impacts([bare], MODEL, PAPER, SAMPLED).figures[0]
    assert np.isnan(found.piezo_m)
    assert found.piezo_simulated_m == pytest.approx(study(True).figures[0].piezo_simulated_m, rel=1e-3)


def test_loop_and_figures_are_kept(tmp_path) -> None:
    named = study_impacts([quiet_hit("x", True)], MODEL, PAPER, SAMPLED, lags=0, loop="soft")
    save(named, tmp_path / "soft.h5")
    again = load(tmp_path / "soft.h5", ImpactStudy)
    assert (again.loop, again.figures) == ("soft", named.figures)


def test_loops_are_averaged_over_their_impacts() -> None:
    data = report.impact_loops_data({"open": study(False), "closed": study(True)}, duration_s=0.04)
    assert data.time[0] == pytest.approx(-5e-3)
    assert data.time[-1] == pytest.approx(0.04 - 2e-4)
    for word, closed in (("open", False), ("closed", True)):
        p = quiet_hit("x", closed).signal("p")[:, 0]
        start = study(closed).validations[0].windows[0][0]
        first = p[start - 25 : start + 200] - p[:900].mean()
        np.testing.assert_allclose(data.mean[word][:, 0], first, atol=2e-7)
        assert data.spread[word].max() < 2e-7
    assert report.plot_impact_loops(data) is not None
    with pytest.raises(UsageError, match="at one operating point"):
        report.impact_loops_data({})


@given(rate=st.floats(30, 300), noise=st.floats(0.0, 0.1))
@settings(max_examples=20, deadline=None)
def test_decay_of_an_exponential(rate: float, noise: float) -> None:
    """The sum of the noise energy is known within its own scatter, which the last 5 % of the energy must hold."""
    n = 2000
    time = 2e-4 * np.arange(n)
    random = np.random.default_rng(1).standard_normal(n) * noise
    size = 4 * np.exp(-rate * time)
    found = 2e-4 * _decay(np.sqrt(size**2 + random**2), noise**2)
    off = 4 * noise**2 * np.sqrt(2 * n) / np.sum(size**2)
    earliest, latest = (-np.log(1 - share) / (2 * rate) for share in (0.95 - off, 0.95 + off))
    assert 0.97 * earliest < found < 1.03 * latest
