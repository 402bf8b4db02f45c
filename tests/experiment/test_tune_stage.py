"""Controllers in an experiment: section, stage, verb and files."""

import json
import re

import numpy as np
import pytest
from experiment_files import SMALL, json_of, printed_by, write_quick
from experiment_files import gbid as command
from json_keys import assert_keys
from typer.testing import CliRunner

import gbid
from gbid import load
from gbid.cli.main import app
from gbid.control import compare_designs
from gbid.control.assessment import TunedDesign
from gbid.core.files import share_folder
from gbid.experiment.controllers import controller_at, design_structure
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.tune import PUBLISHED, TUNE
from gbid.report.loop_pictures import plot_robustness_price

MODEL = gbid.load_model("theisen2016")
RIG = """\
format: 1
name: designs
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  prbs: {recordings: 0}
  stationary: {recordings: 0}
"""
FEEDBACK = """\
controller:
  feedback:
    operating_points: [{pressure_bar: 6, speed_rpm: 0}]
    peak_sensitivity: 2.28317
    pareto: [2.6, 1.6]
"""
OWN = """\
import numpy as np
import gbid

def matrices(p):
    return {"A": np.zeros((0, 0)), "B": np.zeros((0, 2)), "C": np.zeros((2, 0)), "D": [[p.k, 0], [0, p.k]]}

structure = gbid.LinearStructure("same", [gbid.Parameter("k", 0.0, 0.0, 2.0)], matrices, ("p_x", "p_y"), ("r_x", "r_y"))
"""


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    path = write_quick(tmp_path_factory.mktemp("tuned"), text=RIG + FEEDBACK)
    result = CliRunner().invoke(app, ["tune", str(path), "--json"])
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert_keys("tuning", document)
    return path, document["tuning"][0]


def test_the_papers_damping_at_the_papers_cap(tuned):
    _, document = tuned
    assert document["status"] == "optimal"
    assert document["value"] == pytest.approx(0.318, abs=5e-4)
    assert document["peak_sensitivity"] <= 2.28317 * (1 + 1e-6)
    own, published = document["performance"]
    assert (own["name"], published["name"]) == ("feedback", PUBLISHED)
    assert published["gains"] == {"kappa_x": 1.125, "kappa_y": 0.99}
    controller = gbid.control.p_controller(**document["gains"])
    loop = gbid.close_loop(MODEL.plant_at(6, 0), controller)
    assert own["worst"]["damping"]["value"] == pytest.approx(min(zeta for _, zeta in loop.modes()), abs=1e-12)
    assert [row["cap"] for row in document["pareto"]] == [1.6, 2.6]
    low, high = (row["value"] for row in document["pareto"])
    assert low < document["value"] < high


def test_table_is_that_of_compare_designs(tuned, capsys):
    path, document = tuned
    result = printed_by(capsys, "tune", path)
    assert "kept" in result.err
    structure = gbid.controller_structure("P")
    assessed = [
        gbid.assess(MODEL, structure, performance["gains"], [(6, 0)], name=performance["name"])
        for performance in document["performance"]
    ]
    compared = compare_designs(assessed)
    lines = result.out.splitlines()
    for i, heading in enumerate(compared.columns[1:], 1):
        line = next(entry for entry in lines if entry.startswith(heading))
        assert line.removeprefix(heading).split() == [row[i] for row in compared.rows]
    for word in ("damping 0.318", "peak of S_o at", "checked", "peak 1.6", "feedback.yaml"):
        assert word in result.out


def test_controller_file_has_the_gains_and_runs_in_the_impacts(tuned):
    path, document = tuned
    design = gbid.load_controller(document["controller"])
    assert dict(design.gains) == document["gains"]
    assert (design.name, design.plant, design.sample_time) == ("feedback", "theisen2016", 2e-4)
    assert design.provenance["cap_peak_sensitivity"] == 2.28317
    hit = path.with_name("hit.yaml")
    for word in ("tuned", "tuned:feedback"):
        hit.write_text(
            RIG
            + FEEDBACK
            + f"impacts: {{controller: '{word}', operating_points: [{{pressure_bar: 6, speed_rpm: 0}}]}}\n"
        )
        experiment = load_experiment(hit)
        running = controller_at(experiment, experiment.spec.impacts.operating_points[0])
        np.testing.assert_array_equal(running.continuous.C, design.at().C)
    (path.parent / "law.py").write_text("from gbid.control import p_controller\n\nlaw = p_controller(0.5, 0.4)\n")
    hit.write_text(hit.read_text().replace("tuned:feedback", "law.py:law"))
    experiment = load_experiment(hit)
    running = controller_at(experiment, experiment.spec.impacts.operating_points[0])
    np.testing.assert_array_equal(running.continuous.C, gbid.control.p_controller(0.5, 0.4).C)


def test_limits_that_contradict_are_an_outcome_with_the_least_violating_design(tmp_path, capsys):
    path = write_quick(
        tmp_path,
        ("peak_sensitivity: 2.28317", "goals: [{goal: MaxDamping}, {goal: SlowestPole, rate: 2000}]"),
        text=RIG + FEEDBACK,
    )
    result = printed_by(capsys, "tune", path, "--json", code=4)
    assert "infeasible" in result.err
    document = json.loads(result.out)
    design, (computed, file) = document["tuning"][0], document["outcomes"]
    assert not design["success"]
    assert design["violation"] > 0
    assert (computed["converged"], computed["state"], file["stage"]) == (False, "made", "controller")
    assert gbid.load_controller(design["controller"]).provenance["status"] == "infeasible"
    assert command("tune", path) == 4  # kept, and still said


def test_bounds_without_a_stabilising_gain_name_point_and_mode(tmp_path, capsys):
    text = RIG + (
        "controller:\n"
        "  none: {bounds: {kappa_x: [-3, -1], kappa_y: [-3, -1]}, operating_points: "
        "[{pressure_bar: 3, speed_rpm: 0}, {pressure_bar: 7, speed_rpm: 0}]}\n"
    )
    path = write_quick(tmp_path, text=text)
    result = printed_by(capsys, "tune", path, "--json", code=4)
    assert "no stabilising gains" in result.err
    design = json.loads(result.out)["tuning"][0]
    poles = {n: gbid.close_loop(MODEL.plant_at(n, 0), gbid.control.p_controller(-1, -1)).poles() for n in (3, 7)}
    bar = max(poles, key=lambda n: poles[n].real.max())
    worst = poles[bar][poles[bar].real.argmax()]
    assert f"{bar} bar, 0 rpm" in design["notes"][-1]
    mode = f"{abs(worst) / (2 * np.pi):.4g} Hz and damping {-worst.real / abs(worst):.4g}"
    assert mode in design["notes"][-1]
    assert design["notes"][-1] in " ".join(printed_by(capsys, "tune", path, code=4).out.split())


def test_unstable_open_loop_is_said(tmp_path, capsys):
    text = (share_folder("models") / "theisen2016.yaml").read_text(encoding="utf-8")
    assert text.count("d_xx: [-1.855e+05,") == 1
    (tmp_path / "growing.yaml").write_text(text.replace("d_xx: [-1.855e+05,", "d_xx: [-0.555e+05,"), encoding="utf-8")
    text = RIG + ("controller:\n  p: {model: growing.yaml, operating_points: [{pressure_bar: 6, speed_rpm: 0}]}\n")
    printed = printed_by(capsys, "tune", write_quick(tmp_path, text=text)).out
    assert "the open loop is not stable at 6 bar, 0 rpm" in printed


def test_own_structure_scheduled_gains_and_whole_rectangle(tmp_path, capsys):
    text = RIG + (
        "controller:\n"
        "  own: {structure: 'own.py:structure', starts: 1, goals: [{goal: MaxDamping}, "
        "{goal: PeakSensitivity, limit: 2.6}, {goal: PiezoTravel, impact: {peak_n: 10.0}}], "
        "operating_points: [{pressure_bar: 6, speed_rpm: 0}]}\n"
        "  follows: {schedule: ['1', P], starts: 1, operating_points: [{pressure_bar: 5, speed_rpm: 0}, "
        "{pressure_bar: 6, speed_rpm: 0}]}\n"
        "  everywhere: {operating_points: domain, starts: 1, sample_time_s: 1e-4}\n"
    )
    path = write_quick(tmp_path, text=text)
    (tmp_path / "own.py").write_text(OWN)
    outcomes = run_stage(Job(load_experiment(path)), TUNE)
    assert [o.state for o in outcomes] == ["made"] * 6
    folder = tmp_path / "results" / "designs" / "controller"
    controller = gbid.load_controller(folder / "own.yaml")
    assert controller.structure is None
    k = controller.gains["k"]
    np.testing.assert_array_equal(controller.at().D, [[k, 0], [0, k]])
    follows = gbid.load_controller(folder / "follows.yaml")
    np.testing.assert_allclose(follows.at(5, 0).C, follows.models[5.0, 0.0].C)
    everywhere = load(folder / "everywhere.h5", TunedDesign)
    assert everywhere.sample_time == 1e-4
    assert load(folder / "own.h5", TunedDesign).impact.peak_n == 10.0
    assert len(everywhere.result.points) >= 9
    # The text of a structure of one's own decides its design.
    (tmp_path / "own.py").write_text(OWN.replace("2.0)", "1.0)"))
    assert "own.h5 was made with other settings" in printed_by(capsys, "tune", path, code=2).err


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("{p: {structure: Q}}", ("controller.p.structure", "choose from P, PD, PI, PID, PPF, biquad")),
        ("{p: {structure: filter, options: {filter_ordr: 6}}}", ("controller.p.options", "option filter_ordr")),
        ("{p: {structure: 'a.py:b'}}", ("controller.p.structure", "no file")),
        ("{p: {model: lpv}}", ("controller.p.model", "no section 'lpv'")),
        ("{p: {model: nosuch}}", ("controller.p.model", "no model 'nosuch'")),
        ("{p: {uncertainty: {}}}", ("controller.p.uncertainty", "write model: lpv")),
        ("{p: {bounds: {kapa_x: [0, 1]}}}", ("bounds.kapa_x", "did you mean 'kappa_x'")),
        ("{p: {bounds: {kappa_x: [1, 0]}}}", ("bounds.kappa_x", "lower bound 1 is not below")),
        ("{p: {start: {gain: 1}}}", ("start.gain", "choose from kappa_x, kappa_y")),
        ("{p: {schedule: [P]}}", ("controller.p.schedule", "'1' among them")),
        ("{p: {operating_points: []}}", ("controller.p.operating_points", "or a list of operating points")),
        ("{p: {operating_points: all}}", ("controller.p.operating_points: expected the word model or domain", "'all'")),
        ("{p: {operating_points: [{pressure_bar: 9, speed_rpm: 0}]}}", ("points[0].pressure_bar", "3 to 7")),
        ("{p: {operating_points: [{pressure_bar: 6, speed_rpm: 0, speed: 1}]}}", ("points[0].speed:", "unknown key")),
        ("{p: {tune_corner: true, order: 0}}", ("controller.p.tune_corner", "tune_corner needs a low-pass")),
        (
            "{p: {}, q: {}}\nimpacts: {controller: tuned, operating_points: [{pressure_bar: 6, speed_rpm: 0}]}",
            ("impacts.controller", "write tuned:NAME with NAME out of p, q"),
        ),
        (
            "{p: {}}\nimpacts: {controller: 'tuned:q', operating_points: [{pressure_bar: 6, speed_rpm: 0}]}",
            ("impacts.controller", "no design 'q'"),
        ),
    ],
)
def test_wrong_sections_are_named(tmp_path, section, words, capsys):
    (line,) = printed_by(
        capsys, "check", write_quick(tmp_path, text=f"{RIG}controller: {section}\n"), code=2
    ).err.splitlines()
    for word in words:
        assert word in line


DESIGNS = """\
controller:
  robust: {peak_sensitivity: 2.0, starts: 1, uncertainty: {draws: 2, seed: 1}}
  sure:
    starts: 1
    operating_points: [{pressure_bar: 6, speed_rpm: 0}]
    goals: [{goal: MaxDamping}, {goal: PeakSensitivity, limit: 2.0}]
    robust: {probability: 0.8, draws: 12, fresh: 40}
  each:
    starts: 1
    operating_points: [{pressure_bar: 6, speed_rpm: 0}]
    goals: [{goal: MaxDamping}, {goal: MinDiskMargin, alpha: 0.7}]
    uncertainty: {plants: recordings}
"""
SURFACES = re.sub(".*speed_rpm: 6000}\n", "", SMALL).replace(", Omega, Omega P", "") + DESIGNS


def test_design_on_the_surfaces_of_the_experiment_and_their_uncertainty(tmp_path, capsys):
    path = write_quick(tmp_path, text=SURFACES)
    assert "no surfaces 'bearing' made from the present fits" in printed_by(capsys, "tune", path, code=3).err
    for verb in ("rig", "fit", "lpv"):
        assert command(verb, path, "--engine", "serial") == 0
    document, sure, each = json_of(capsys, "tune", path)["tuning"]
    assert document["plant"] == "small"
    assert len(document["points"]) == 2
    assert document["verified_on"].endswith("6 loops")  # two points, the surfaces and two drawn plants
    assert document["performance"][1]["name"] == PUBLISHED
    assert document["performance"][0]["worst"]["peak_output"]["value"] <= 2.0 * (1 + 1e-6)
    assert each["verified_on"].endswith("5 loops")  # one point, the surfaces and the fits of four recordings
    assert each["goals"][0]["excess"] <= 1e-6
    (promise,) = sure["promises"]
    assert 0 < promise["promised"] < promise["nominal"]
    assert (promise["probability"], promise["fresh"]) == (0.8, 40)
    shown = printed_by(capsys, "tune", path).out
    assert re.search(r"^sure +0.8 ", shown[shown.index("Robust designs") :], re.MULTILINE)
    picture = plot_robustness_price({"sure": load(sure["path"], TunedDesign)})
    assert next(line.get_label() for line in picture.lines) == "sure"
    bare = write_quick(tmp_path / "bare", (", actuators: theisen2016", ""), text=SURFACES)
    assert "add lpv: actuators" in printed_by(capsys, "check", bare, code=2).err


def test_structures_by_name_with_options(tmp_path):
    text = RIG + (
        "controller:\n"
        "  tall: {structure: filter, options: {filter_order: 6, frequency_khz: [0.05, 1.0]}}\n"
        "  turning: {structure: resonant}\n"
        "  coupled: {structure: full biquad}\n"
        "  scheduled: {schedule: ['1', Omega], bounds: {kappa_x_Omega: [0, 1]}}\n"
    )
    experiment = load_experiment(write_quick(tmp_path, text=text))
    structures = {name: design_structure(experiment, s, MODEL.domain) for name, s in experiment.spec.controller.items()}
    assert len(structures["tall"].parameters) == 2 * 13
    assert next(p for p in structures["tall"].parameters if p.name == "frequency_2_x").upper == 1.0
    assert isinstance(structures["turning"], gbid.control.Scheduled)
    assert structures["turning"].domain == MODEL.domain
    assert len(structures["coupled"].parameters) == 16
    scheduled = [q.name for q in structures["scheduled"].parameters]
    assert scheduled == ["kappa_x_1", "kappa_x_Omega", "kappa_y_1", "kappa_y_Omega"]
