"""Impacts on the rig: force scaling, closed-loop ring-downs, the paper's rows, the stage and its verb."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from experiment_files import gbid as command
from experiment_files import write_quick
from json_keys import assert_keys
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

import gbid
from gbid.control import (
    HalfSine,
    ImpactStudy,
    close_loop,
    controller_structure,
    exact_plant,
    p_controller,
    ringing_modes,
    sample_controller,
    sampled_loop,
    save_controller,
    study_impacts,
)
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import load, save
from gbid.lpv import load_machine
from gbid.rig import Hammer, Impact, Machine, SampledController, Stationary, record
from gbid.structure import LinearModel

MODEL = gbid.load_model("theisen2016")
PAPER = p_controller(1.125, 0.99)
SAMPLED = sample_controller(PAPER, 2e-4)
POINT = (6.0, 0.0)


@cache
def hit(axis: str, loop: str = "open", speed: float = 0.0, mass: float = 2.18, seed: int = 1, impacts: int = 3):
    machine = Machine.from_parameters(MODEL.key_parameters(6.0, speed), MODEL.actuators, moving_mass=mass)
    times = [0.1 + 0.25 * i + i * 7.3e-5 for i in range(impacts)]
    hammer = Hammer(tuple(Impact.along(axis, t, 12.0) for t in times), 0.1 + 0.25 * impacts)
    options = {"conditions": {"pressure_bar": 6.0, "speed_rpm": speed}, "seed": seed, "name": f"{axis}_{loop}"}
    controller = None
    if loop == "closed":
        zero = record(machine, Stationary(0.3), **options).signal("p").mean(axis=0)
        controller = SampledController(SAMPLED.A, SAMPLED.B, SAMPLED.C, SAMPLED.D, 2e-4, offset=zero)
    return record(machine, hammer, controller=controller, **options)


def off_by(found, true) -> np.ndarray:
    """Deviations of four modal numbers in standard deviations."""
    estimate = np.column_stack([found.frequency_hz, found.damping]).ravel()
    return (estimate - np.array([v for mode in true for v in mode])) / np.sqrt(np.diag(found.covariance))


def test_one_moving_mass_for_rig_and_reference_impact() -> None:
    """Disc and a third of the shaft, Table 1."""
    assert HalfSine().mass_kg == Machine.moving_mass == pytest.approx(1.5 + 2.04 / 3)


def test_expected_rows_of_tables_3_and_4() -> None:
    plant = MODEL.plant_at(*POINT)
    for controller, loop in ((None, "open"), (PAPER, "closed")):
        printed = next(
            m.modes for m in load_machine("theisen2016").reference_modes if (m.loop, m.kind) == (loop, "expected")
        )
        found = ringing_modes(plant, controller)
        assert [(round(f, 1), round(z, 3)) for f, z in found] == [tuple(mode) for mode in printed]


def test_ringing_modes_are_those_a_impact_excites() -> None:
    """The two of the bearing among all that a loop has, wherever filters put theirs."""
    everything = close_loop(MODEL.plant_at(*POINT), PAPER).modes()
    assert len(everything) > 2
    np.testing.assert_allclose(ringing_modes(MODEL.plant_at(*POINT), PAPER), everything[:2])
    running = sampled_loop(exact_plant(MODEL, *POINT), PAPER)
    np.testing.assert_allclose(ringing_modes(exact_plant(MODEL, *POINT), SAMPLED), running.modes[:2], rtol=1e-9)
    plant = MODEL.at(*POINT)
    slow = LinearModel(  # a filter that rings at 40 Hz and is hardly coupled to the disc
        block_diag(plant.A, [[0, 251.0], [-251.0, -5.0]]),
        np.vstack([plant.B, np.zeros((2, 2))]),
        np.hstack([plant.C, np.zeros((2, 2))]),
        plant.D,
    )
    np.testing.assert_allclose(ringing_modes(slow, entry=_entry(slow.n_states)), plant.modes(), rtol=1e-9)


def _entry(n: int) -> np.ndarray:
    entry = np.zeros((n, 2))
    positions = [int(np.flatnonzero(row)[0]) for row in MODEL.at(*POINT).C]
    for j, place in enumerate(positions):
        entry[int(np.flatnonzero(MODEL.at(*POINT).A[place])[0]), j] = 1.0
    return entry


@pytest.mark.parametrize("mass", [2.18, 3.0])
@pytest.mark.parametrize("speed", [0.0, 2050.0])
def test_force_scaling_is_one_over_the_mass(mass: float, speed: float) -> None:
    for axis in "xy":
        found = gbid.validate_impact(hit(axis, speed=speed, mass=mass), MODEL.at(6.0, speed))
        assert found.force_scale == pytest.approx(1 / mass, abs=3.5 * found.force_scale_std)
        assert found.force_scale_std < 0.004 / mass
        assert found.along_percent > 97
        assert found.axis == axis
        assert found.loop == "open loop"


def test_closed_loop_as_it_runs_explains_the_impact_and_the_continuous_one_does_less() -> None:
    """What the sampling and one sample of computation change is far beyond the noise."""
    running = gbid.validate_impact(hit("x", "closed"), exact_plant(MODEL, *POINT), SAMPLED)
    assert running.force_scale == pytest.approx(1 / 2.18, abs=3.5 * running.force_scale_std)
    assert running.along_percent > 98
    continuous = gbid.validate_impact(hit("x", "closed"), MODEL.plant_at(*POINT), PAPER)
    assert continuous.along_percent < 90
    early = gbid.validate_impact(hit("x", "closed"), exact_plant(MODEL, *POINT), SAMPLED, computation_s=0.0)
    assert early.along_percent < running.along_percent - 1


def test_continuous_loop_against_an_adaptive_integrator() -> None:
    """A noise-free force, one impact; the simulated response of 1 N/kg against DOP853 on the half-sine itself."""
    time = 2e-4 * np.arange(600)
    since = time - 0.01007
    f = np.where((since > 0) & (since < 2e-3), 12 * np.sin(np.pi * since / 2e-3), 0.0)
    loop = close_loop(MODEL.plant_at(*POINT), PAPER)
    E = np.zeros(loop.n_states)
    E[6] = 1.0

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        return loop.A @ x + E * 12 * np.sin(np.pi * t / 2e-3)

    first = solve_ivp(slope, (0, 2e-3), np.zeros(loop.n_states), "DOP853", rtol=1e-11, atol=1e-20, dense_output=True)
    after = solve_ivp(
        lambda _, x: loop.A @ x, (2e-3, 0.12), first.y[:, -1], "DOP853", rtol=1e-11, atol=1e-20, dense_output=True
    )
    x = np.array([first.sol(t) if t < 2e-3 else after.sol(t) if t > 0 else 0 * E for t in np.maximum(since, 0)])
    p = 0.4 * x @ loop.C.T
    rec = gbid.Recording({"p": p + 1e-6, "f": np.column_stack([f, 0 * f])}, 2e-4, name="smooth")
    found = gbid.validate_impact(rec, MODEL.plant_at(*POINT), PAPER)
    assert found.force_scale == pytest.approx(0.4, rel=2e-4)
    np.testing.assert_allclose(found.simulated, p, atol=3e-4 * np.abs(p).max())
    assert found.along_percent > 99.9


@pytest.mark.parametrize("speed", [0.0, 2050.0])
def test_ring_downs_agree_with_the_true_machine(speed: float) -> None:
    """Open loop with the bearing's modes; closed with those of the sampled loop, exact delays, unbalance left in."""
    opened = gbid.fit_ringdown([hit(axis, speed=speed) for axis in "xy"])
    assert (np.abs(off_by(opened, MODEL.at(6.0, speed).modes())) < 4).all()
    assert not opened.lag_rates.size
    assert opened.frequency_std.max() < 0.03
    closed = gbid.fit_ringdown([hit(axis, "closed", speed) for axis in "xy"])
    true = ringing_modes(exact_plant(MODEL, 6.0, speed), SAMPLED)
    assert (np.abs(off_by(closed, true)) < 4).all()
    assert closed.damping_std.max() < 0.02
    plain = gbid.fit_ringdown([hit(axis, "closed", speed) for axis in "xy"], lags=0)
    assert np.abs(off_by(plain, true)).max() > 10  # two modes alone, as in the paper, are biased in a loop


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["open", "closed"])
def test_intervals_on_the_rig_cover_the_truth(loop: str) -> None:
    true = MODEL.at(*POINT).modes() if loop == "open" else ringing_modes(exact_plant(MODEL, *POINT), SAMPLED)
    z = np.array([off_by(gbid.fit_ringdown([hit(a, loop, seed=s) for a in "xy"]), true) for s in range(40)])
    assert np.mean(np.abs(z) < 1.96) > 0.88
    assert (np.abs(z.mean(axis=0)) < 0.8).all()


def test_study_round_trip(tmp_path) -> None:
    study = study_impacts([hit("x", "closed")], MODEL, PAPER, SAMPLED, lags=0)
    save(study, tmp_path / "study.h5")
    again = load(tmp_path / "study.h5", ImpactStudy)
    assert (again.loop, again.model, again.controller) == ("closed", MODEL.name, PAPER.name)
    assert again.expected == study.expected
    assert again.ringdown.modes() == study.ringdown.modes()
    assert again.ringdown.recordings == study.ringdown.recordings
    one, other = study.validations[0], again.validations[0]
    np.testing.assert_array_equal(other.simulated, one.simulated)
    assert (other.impacts, other.windows, other.force_scale) == (one.impacts, one.windows, one.force_scale)
    with pytest.raises(UsageError, match="exists"):
        save(study, tmp_path / "study.h5")


def test_bad_models() -> None:
    rec = hit("x")
    with pytest.raises(UsageError, match="has exact delays"):
        gbid.validate_impact(rec, exact_plant(MODEL, *POINT), PAPER)
    with pytest.raises(UsageError, match="is unstable"):
        gbid.validate_impact(rec, MODEL.plant_at(*POINT), p_controller(4.0, 4.0))
    with pytest.raises(UsageError, match="expected"):
        gbid.validate_impact(rec, MODEL.plant_at(*POINT), entry=np.zeros((3, 2)))
    single = gbid.Recording({"p": rec.signal("p")[:, :1], "f": rec.signal("f")}, 2e-4)
    with pytest.raises(DataError, match="an impact needs two"):
        gbid.validate_impact(single, MODEL.at(*POINT))
    still = replace(rec, signals={**rec.signals, "f": 0 * rec.signal("f")})
    with pytest.raises(DataError, match="no impact"):
        gbid.validate_impact(still, MODEL.at(*POINT))


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


def test_verb_makes_tables_and_files(tmp_path, capsys) -> None:
    path = write_quick(tmp_path, text=YAML)
    assert command("impact", path) == 0
    out = capsys.readouterr().out
    for words in (
        "natural frequencies",
        "damping factors",
        "expected from model",
        "obtained from the impacts",
        "126.3",
    ):
        assert words in out
    folder = tmp_path / "results" / "hits" / "impacts"
    with (folder / "impacts.csv").open() as file:
        lines = list(file)
    assert any(line.startswith("# content_key: ") for line in lines)
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [(row["loop"], row["mode"]) for row in rows] == [
        ("open", "1"),
        ("open", "2"),
        ("closed", "1"),
        ("closed", "2"),
    ]
    assert float(rows[2]["expected_damping"]) == pytest.approx(0.318, abs=5e-4)
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*.*")}
    assert len(before) == 8
    assert command("impact", path, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert_keys("impacts", document)
    assert [d["name"] for d in document["impacts"]] == ["p6_n0_open", "p6_n0_closed"]
    assert document["impacts"][1]["published"]["measured"] == [[89.9, 0.658], [111.6, 0.446]]
    assert {o["state"] for o in document["outcomes"]} == {"kept"}
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*.*")} == before
    write_quick(tmp_path, ("repeats: 2", "repeats: 3"), text=YAML)
    assert command("impact", path) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_controller_of_a_file_runs(tmp_path, capsys) -> None:
    save_controller(tmp_path / "mine.yaml", controller_structure("P"), {"kappa_x": 0.5, "kappa_y": 0.4})
    path = write_quick(tmp_path, ("paper", "mine.yaml"), ("  repeats", "  loops: [closed]\n  repeats"), text=YAML)
    assert command("impact", path, "--json") == 0
    document = json.loads(capsys.readouterr().out)["impacts"][0]
    damping = [row["running_damping"] for row in document["modes"]]
    obtained = [row["obtained_damping"] for row in document["modes"]]
    np.testing.assert_allclose(obtained, damping, rtol=0.05)
    assert document["published"] == {}  # the paper ran another controller


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("controller: paper", "controller: none.yaml", "none.yaml: no such controller file"),
        ("  repeats: 2", "  model: lpv", "there is no section 'lpv'"),
        ("  repeats: 2", "  model: nowhere", "nowhere"),
        ("speed_rpm: 0}]\n  repeats", "speed_rpm: 99999}]\n  repeats", "lies outside the domain"),
        ("spacing_s: 0.25", "spacing_s: 0.005", "too short for impacts"),
        ("spacing_s: 0.25", "impact_s: 0.0003", "less than 4 samples"),
        ("repeats: 2", "repeats: 0", "impacts.repeats"),
    ],
)
def test_bad_sections(tmp_path, capsys, old: str, new: str, text: str) -> None:
    path = write_quick(tmp_path, (old, new), text=YAML)
    assert command("check", path) == 2
    assert text in " ".join(capsys.readouterr().err.split())


def test_tuned_controller_that_is_not_there(tmp_path, capsys) -> None:
    path = write_quick(tmp_path, ("paper", "tuned"), text=YAML)
    assert command("check", path) == 2
    assert "no section 'controller'" in capsys.readouterr().err
    path = write_quick(tmp_path, ("paper", "tuned"), text=f"{YAML}controller: {{feedback: {{}}}}\n")
    assert command("check", path) == 0
    assert command("impact", path) == 2
    assert "gbid tune" in capsys.readouterr().err
