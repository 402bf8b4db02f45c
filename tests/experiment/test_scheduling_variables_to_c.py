"""Surfaces over pressure and eccentricity: from recordings by YAML to a scheduled controller whose C runs."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from compilers import COMPILER, NEEDS_COMPILER
from experiment_files import gbid as run
from experiment_files import json_of, printed_by

import gbid
from gbid.control import exact_plant, load_controller
from gbid.lpv import Domain, LPVModel

PAPER = gbid.load_model("theisen2016")
NAMES = ("pressure_bar", "eccentricity")
POINTS = [(p, e) for p in (3.0, 5.0, 7.0) for e in (0.0, 0.2, 0.4)]
SPREAD = {"k": 0.3, "d": 0.1, "b": 0.05, "t": 0.0}


def truth() -> LPVModel:
    """Machine of the paper at rest, whose film stiffens with the square of the eccentricity."""
    rows = {}
    for key, (constant, slope, _, _, square, _) in PAPER.coefficients.items():
        rise = SPREAD[key[0]] * float(PAPER.key_parameters(5.0, 0.0)[key])
        rows[key] = (constant, slope, 0.0, 0.1 * rise, square, rise)
    return LPVModel("ball", rows, Domain((3.0, 7.0), (0.0, 0.4), variables=NAMES), actuators=PAPER.actuators)


YAML = """
format: 1
name: ball
machine: {moving_mass_kg: 4.7, piezo_travel_m: 45.0e-6, clearance_m: 25.0e-6}
import:
  folder:
    pattern: p{pressure_bar:g}_e{eccentricity:g}.csv
    more_conditions: [eccentricity]
    conditions: {speed_rpm: 0.0}
    sample_time_s: 2.0e-4
    signals:
      u: {columns: [u_x, u_y], unit: m}
      p: {columns: [p_x, p_y], unit: m}
fits:
  bearing: {structure: rotor_bearing, intersample: [foh]}
lpv: {fit: bearing, scheduling: [pressure_bar, eccentricity], actuators: theisen2016}
controller:
  plain: {design_for: sampled, sample_time_s: 2.0e-4, operating_points: domain}
  scheduled: {schedule: ["1", pressure_bar, eccentricity], design_for: sampled, sample_time_s: 2.0e-4}
"""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    random = np.random.default_rng(1)
    for p, e in POINTS:
        bearing = truth().at(p, e, pade_order=4)
        u = 4e-6 * np.repeat(random.choice([-1.0, 1.0], size=(300, 2)), 10, axis=0)
        disc = bearing.simulate(u, 2e-4, intersample="foh") + 2e-8 * random.normal(size=u.shape)
        rows = np.hstack([u, disc])
        np.savetxt(folder / f"p{p:g}_e{e:g}.csv", rows, delimiter=",", header="u_x,u_y,p_x,p_y", comments="")
    (folder / "ball.yaml").write_text(YAML)
    return folder / "ball.yaml"


def test_surfaces_over_eccentricity_become_a_scheduled_controller_in_c(experiment, capsys):
    results = json_of(capsys, "run", experiment)
    designs = {row["design"]: row for row in results["tuning"]}
    out = experiment.parent / "results" / "ball"
    model = gbid.load_model(out / "lpv" / "bearing.yaml")
    assert (model.scheduling, len(model.operating_points)) == (NAMES, 9)
    for name, value in truth().key_parameters(4.0, 0.3).items():
        assert float(model.key_parameters(4.0, 0.3)[name]) == pytest.approx(float(value), rel=0.05), name
    assert gbid.load(out / "lpv" / "bearing.h5").estimates.scheduling == NAMES
    assert "33 x 33 grid" in designs["plain"]["verified_on"]
    assert "eccentricity" in designs["scheduled"]["worst"]["where"]
    # the stored controller damps the true machine as promised, by loops closed here
    design = load_controller(out / "controller" / "scheduled.yaml")
    loops = [
        gbid.control.sampled_loop(exact_plant(truth(), *point), design.sampled_at(*point), 2e-4) for point in POINTS
    ]
    assert min(loop.damping for loop in loops) == pytest.approx(designs["scheduled"]["value"], abs=0.03)
    assert designs["scheduled"]["value"] > designs["plain"]["value"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Surfaces over pressure and eccentricity" in page
    assert "7 bar, eccentricity 0.4" in page


@NEEDS_COMPILER
def test_c_of_a_schedule_over_eccentricity_passes_its_self_test(experiment, capsys, tmp_path):
    assert run("run", experiment) == 0
    capsys.readouterr()
    printed_by(capsys, "export", experiment, "--to", "c", "--output", tmp_path)
    assert "_real eccentricity;" in (tmp_path / "controller_scheduled.h").read_text()
    sources = ["controller_scheduled.c", "controller_scheduled_selftest.c", "-DCONTROLLER_SCHEDULED_SELFTEST_MAIN"]
    subprocess.run([COMPILER, "-std=c99", *sources, "-o", "test"], cwd=tmp_path, check=True)
    assert "rows agree" in subprocess.run(["./test"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
