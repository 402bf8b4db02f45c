"""Controllers in the YAML for the models of a fit: any machine, from recordings to controller, C and co-simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from experiment_files import gbid as run
from experiment_files import json_of, printed_by
from scipy.signal import cont2discrete

import gbid
from gbid.control import MaxDamping, PeakSensitivity, controller_structure, load_controller

STRUCTURE = """
import gbid

def matrices(p):
    stiffness, damping = [[-p.k, p.c], [p.c, -p.k]], [[-p.d, 0], [0, -p.d]]
    A = [[0, 0, 1, 0], [0, 0, 0, 1], *(k + d for k, d in zip(stiffness, damping))]
    return {"A": A, "B": [[0, 0, 0], [0, 0, 0], [p.b, 0, p.e], [0, p.b, p.e]], "C": [[1, 0, 0, 0], [0, 1, 0, 0]]}

names = {"k": 9e3, "c": 1e3, "d": 3.0, "b": 9e3, "e": 4e3}
structure = gbid.LinearStructure("masses", [gbid.Parameter(*q) for q in names.items()], matrices, "u", "y")
"""
YAML = """
format: 1
name: masses
import:
  recordings:
    - &one
      name: one
      file: one.csv
      sample_time_s: 1.0e-3
      signals:
        u: {columns: [left, right, hammer], unit: N, stored_unit: N, channels: [left, right, hammer]}
        y: {columns: [a, b], unit: m, stored_unit: m, channels: [a, b]}
    - {<<: *one, name: two, file: two.csv}
fits:
  free: {structure: "masses.py:structure", focus: simulation}
controller:
  servo:
    structure: PD
    lowpass_hz: 100
    options: {axes: ["1", "2"], kd_limit_ms: 3.0}
    model: free
    inputs: [u_left, u_right]
    outputs: [y_a, y_b]
    sample_time_s: 1.0e-3
    design_for: sampled
    goals: [{goal: MaxDamping}, {goal: PeakSensitivity, limit: 2.6}]
  plain: {structure: P, options: {axes: ["1", "2"]}, model: free, inputs: [u_left, u_right], sample_time_s: 1.0e-4}
target: {limits: [2.0, 2.0], beyond: [1.0, 1.0], units: [m, N]}
"""


def truth() -> gbid.LinearModel:
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1e4, 900, -4, 0], [900, -1e4, 0, -4]], float)
    B = np.array([[0, 0, 0], [0, 0, 0], [1e4, 0, 5e3], [0, 1e4, 5e3]], float)
    return gbid.LinearModel(A, B, np.eye(2, 4), np.zeros((2, 3)))


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("masses")
    rng = np.random.default_rng(0)
    for name in ("one", "two"):
        u = np.repeat(rng.normal(size=(100, 3)), 10, axis=0)
        y = truth().simulate(u, 1e-3) + 1e-3 * rng.normal(size=(1000, 2))
        np.savetxt(
            folder / f"{name}.csv", np.hstack([u, y]), delimiter=",", header="left,right,hammer,a,b", comments=""
        )
    (folder / "masses.py").write_text(STRUCTURE)
    (folder / "masses.yaml").write_text(YAML)
    return folder / "masses.yaml"


def test_controllers_of_a_fit_from_the_command_line(experiment, capsys):
    designs = {row["design"]: row for row in json_of(capsys, "run", experiment)["tuning"]}
    results = experiment.parent / "results" / "masses"
    fits = {f"free_{name}": gbid.load(results / "fits" / "free" / f"{name}.h5") for name in ("one", "two")}
    assert designs["servo"]["plant"] == "free"
    structure = controller_structure("PD", axes=("1", "2"), lowpass_hz=100, kd_limit_ms=3.0)
    channels = {"inputs": ["u_left", "u_right"], "outputs": ["y_a", "y_b"]}
    goals = [MaxDamping(), PeakSensitivity(2.6)]
    by_hand = gbid.tune(fits, structure, goals=goals, sample_time=1e-3, **channels)
    assert designs["servo"]["value"] == pytest.approx(by_hand.value, rel=1e-6)
    assert designs["servo"]["worst"]["where"] in fits
    # the loop of the true masses, by eigenvalues of matrices written here
    design = load_controller(results / "controller" / "servo.yaml")
    F, G, *_ = cont2discrete((truth().A, truth().B[:, :2], truth().C, np.zeros((2, 2))), 1e-3)
    K = design.sampled_at()
    n, n_k = len(F), len(K.A)
    loop = np.block([
        [F, G, np.zeros((n, n_k))],  # the command acts one sample later
        [K.D @ truth().C, np.zeros((2, 2)), K.C],
        [K.B @ truth().C, np.zeros((n_k, 2)), K.A],
    ])  # fmt: skip
    z = np.log(np.linalg.eigvals(loop).astype(complex))
    lasting = z[(z.real > -1) & (np.abs(z.imag) > 1e-9)]
    assert (-lasting.real / np.abs(lasting)).min() == pytest.approx(by_hand.value, rel=2e-3)


def test_results_of_such_controllers_leave_gbid(experiment, capsys):
    assert run("run", experiment) == 0
    capsys.readouterr()
    out = experiment.parent / "out"
    words = printed_by(capsys, "export", experiment, "--to", "fmu", "--output", out, "--overwrite").out
    names = {Path(line).name for line in words.splitlines()}
    assert names == {
        "free_one.fmu",
        "free_two.fmu",
        *(f"controller_{d}_free_{m}_loop.fmu" for d in ("servo", "plain") for m in ("one", "two")),
    }
    assert run("export", experiment, "--to", "c", "--output", out, "--overwrite") == 0
    page = (experiment.parent / "results" / "masses" / "report.html").read_text(encoding="utf-8")
    assert "What the tuning found" in page
    assert page.count("continuous damping") == 2  # an assessment of each design
    assert "no controller was assessed" not in page
    assert "No loop can be closed" not in page


def test_a_sampled_design_says_that_no_target_can_run_it(experiment, capsys, tmp_path):
    for file in experiment.parent.iterdir():
        if file.suffix in (".py", ".csv"):
            (tmp_path / file.name).write_text(file.read_text())
    text = experiment.read_text().replace("lowpass_hz: 100", "lowpass_hz: 1000")
    path = tmp_path / "masses.yaml"
    path.write_text(text[: text.index("  plain:")] + text[text.index("target:") :])
    (servo,) = json_of(capsys, "run", path, "--until", "tune")["tuning"]
    refusal = "sample_time = 0.001 s is too slow for its pole at 1000 Hz; at most 0.0005 s, better a tenth of that"
    assert any(refusal in note for note in servo["notes"])
    assert refusal in printed_by(capsys, "export", path, "--to", "c", code=2).err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "model: free, inputs",
            "model: theisen2016, inputs",
            "controller.plain.inputs: chooses channels of the models",
        ),
        ("model: free, inputs", "model: lpv, inputs", "controller.plain.model: there is no section 'lpv'"),
        ("sample_time_s: 1.0e-4}", "sample_time_s: 1.0e-4, schedule: ['1', Omega]}", "plain.schedule: needs surfaces"),
        ("sample_time_s: 1.0e-4}", "sample_time_s: 1.0e-4, operating_points: domain}", "operating_points: needs surf"),
        ("focus: simulation}", "focus: simulation, loop: {controller: 'masses.py:structure'}}", "of a loop with its"),
    ],
)
def test_what_a_design_for_a_fit_cannot_have(experiment, capsys, tmp_path, old, new, words):
    for file in ("masses.py", "one.csv", "two.csv"):
        (tmp_path / file).write_text((experiment.parent / file).read_text())
    text = (experiment.parent / "masses.yaml").read_text()
    assert old in text
    (tmp_path / "masses.yaml").write_text(text.replace(old, new))
    assert words in printed_by(capsys, "check", tmp_path / "masses.yaml", code=2).err
