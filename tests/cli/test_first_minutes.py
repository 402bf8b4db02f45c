"""The first five minutes: help that shows the way, a schema for editors, completion, files to take along."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from experiment_files import gbid, json_of, printed_by, write_quick, write_spring
from places import ROOT
from scipy.io import loadmat

from gbid.cli.files import Template
from gbid.cli.main import app
from gbid.cli.options import GROUPS, complete_experiment, complete_source
from gbid.core.yaml_file import read_yaml
from gbid.experiment.load import experiment_json_schema

EXPERIMENTS = [
    path
    for path in sorted((ROOT / "experiments").rglob("*.yaml"))
    if "results" not in path.relative_to(ROOT).parts and path.stem != "theisen2016_numbers"
]
COMMANDS = {command.name: command for command in app.registered_commands}
VERBS = list(COMMANDS)
CALLED = ("new", "check", "rig", "import", "fit", "batch", "crossval", "lpv", "tune", "report", "run", "bench")
"""Verbs that programs outside of gbid call."""


@pytest.fixture(scope="module")
def validator():
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed: pip install jsonschema")
    schema = experiment_json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """An experiment whose fits are made."""
    path = write_spring(tmp_path_factory.mktemp("spring"))
    assert gbid("import", path, "--quiet") == 0
    assert gbid("fit", path, "--quiet") == 0
    return path


def test_help_lists_the_verbs_in_groups_with_whole_sentences(capsys):
    text = printed_by(capsys, "-h").out
    shown = [line[:-1] for line in text.splitlines() if re.fullmatch(r"\w+:", line)]
    groups = [name for name in shown if name in GROUPS]
    assert groups == ["Start", "Results", "Help", "Stages"]
    assert "Other:" not in text, "a verb without a group"
    assert "..." not in text.partition("Start:")[2]
    for verb, command in COMMANDS.items():
        assert bool(re.search(rf"^  {verb} +\w", text, re.MULTILINE)) != command.hidden, verb
    assert sum(not command.hidden for command in COMMANDS.values()) == 19
    assert COMMANDS.keys() >= set(CALLED)
    assert "\n    gbid new rig1 " in text


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_shows_examples_that_name_real_options(verb, capsys):
    text = printed_by(capsys, verb, "-h").out
    examples = [line.strip() for line in text.partition("Examples:")[2].splitlines() if line.strip()]
    assert examples, verb
    assert len([line for line in examples if line.startswith(f"gbid {verb}")]) == len(examples)
    for option in re.findall(r" (--[\w-]+)", " ".join(examples)):
        assert re.search(rf"{option}\b", text.partition("Examples:")[0]), f"{verb} has no {option}"


def test_new_has_the_options_of_templates_and_init_those_of_measured_files(capsys):
    assert set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", printed_by(capsys, "new", "-h").out, re.MULTILINE)) == {
        *("--template", "--list", "--debug", "--help"),
    }
    assert "--moving-mass" in printed_by(capsys, "init", "-h").out


def test_bench_times_fits_on_this_machine(capsys):
    told = json_of(capsys, "bench", "--samples", 2000)
    assert told["samples"] == 2000
    assert 0 < told["best_s"] <= told["first_s"]
    assert "fastest of three" in printed_by(capsys, "bench", "--samples", 2000).out


def test_new_lists_templates_and_says_what_comes_next(tmp_path, capsys):
    lines, schema = printed_by(capsys, "new", "--list").out.splitlines(), experiment_json_schema()
    assert [line.split()[0] for line in lines] == [template.value for template in Template]
    for line in lines:
        folder = tmp_path / line.split()[0]
        captured = printed_by(capsys, "new", folder, "--template", folder.name)
        assert f"next: gbid run {folder / 'experiment.yaml'}" in captured.err
        first, rest = (folder / "experiment.yaml").read_text().split("\n", 1)
        assert first == "# yaml-language-server: $schema=experiment.schema.json"
        source = ROOT / "experiments" / folder.name.replace("-", "_")
        source = source / "experiment.yaml" if source.is_dir() else source.with_suffix(".yaml")
        assert rest == source.read_text()
        assert json.loads((folder / "experiment.schema.json").read_text()) == schema


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda p: p.name)
def test_shipped_experiments_hold_to_the_schema(path, validator):
    assert not [(e.json_path, e.message) for e in validator.iter_errors(read_yaml(path).data)]


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (("  seed: 3", "  sede: 3"), "$.rig"),
        (("duration_s: 1.0", "duration_s: -1.0"), "$.rig.duration_s"),
        (("stop: paper", "stop: never"), "$.fits.bearing.stop"),
        (("stop: paper", "window: 1"), "$.fits.bearing.window"),
        (("stop: paper", "initial_state: there"), "$.fits.bearing.initial_state"),
        (("on: cyclic", "on: []"), "$.crossval.bearing.on"),
        (("{structure: piezo_pair}", "{}"), "$.fits.piezos"),
    ],
)
def test_schema_finds_what_the_check_finds(change, where, tmp_path, validator, capsys):
    path = write_quick(tmp_path, change)
    assert where in [e.json_path for e in validator.iter_errors(read_yaml(path).data)]
    assert printed_by(capsys, "check", path, code=2).err


@pytest.mark.parametrize(
    "change",
    [("stop: paper", "window: one"), ("stop: paper", "inputs: u"), ("stop: paper", "intersample: [zoh, foh]"),
     ("stop: paper", "initial_state: [0.0, 0, 0, 0]"), ("on: cyclic", "on: [p5_n6000_prbs1]")],
)  # fmt: skip
def test_schema_takes_what_the_check_takes(change, tmp_path, validator, capsys):
    path = write_quick(tmp_path, change)
    assert not list(validator.iter_errors(read_yaml(path).data))
    assert gbid("check", path) == 0, capsys.readouterr().err


def test_schema_tells_what_keys_mean():
    schema = experiment_json_schema()
    assert schema["$schema"].endswith("2020-12/schema")
    sections = schema["$defs"]
    assert all(section["description"] for section in sections.values())
    fit = sections["FitSection"]["properties"]
    assert fit["criterion"]["description"].startswith("Mean squared error")
    assert "`" not in json.dumps(schema, ensure_ascii=False)


def test_schema_goes_to_a_file_once(tmp_path, capsys):
    path = tmp_path / "schema.json"
    assert "yaml-language-server: $schema=schema.json" in printed_by(capsys, "schema", "--output", path).err
    assert json.loads(printed_by(capsys, "schema").out) == json.loads(path.read_text())
    assert "exists already" in printed_by(capsys, "schema", "--output", path, code=2).err


def test_completion_offers_experiments_and_folders(tmp_path, monkeypatch):
    for name in ("a.yaml", "b.yml", "c.txt", "d.h5", ".hidden.yaml", "rigs/e.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    assert complete_experiment("") == ["a.yaml", "b.yml", "rigs/"]
    assert complete_experiment("ri") == ["rigs/"]
    assert complete_experiment("rigs/") == ["rigs/e.yaml"]
    assert complete_experiment(".h") == [".hidden.yaml"]
    assert complete_experiment(f"{tmp_path}/a") == [f"{tmp_path}/a.yaml"]
    assert complete_experiment("nowhere/x") == []
    assert "d.h5" in complete_source("")


@pytest.mark.parametrize(("words", "offered"), [("gbid pap", "paper"), ("gbid run ri", "rig1.yaml")])
def test_bash_completes_verbs_and_files(tmp_path, monkeypatch, capsys, words, offered):
    (tmp_path / "rig1.yaml").touch()
    monkeypatch.chdir(tmp_path)
    for name, value in (("_GBID_COMPLETE", "complete_bash"), ("COMP_WORDS", words), ("COMP_CWORD", words.count(" "))):
        monkeypatch.setenv(name, str(value))
    assert printed_by(capsys).out.split() == [offered]


def test_export_writes_the_fits_of_an_experiment(spring, tmp_path, capsys):
    for kind, ending in (("matlab", "mat"), ("csv", "csv"), ("yaml", "yaml")):
        document = json_of(capsys, "export", spring, "--to", kind, "--output", tmp_path / kind)
        assert document["left_out"] == []
        files = [Path(p) for p in document["files"]]
        assert all(p.is_file() for p in files)
        assert {"spring_run1", "spring_run2"} <= {p.stem.removesuffix("_parameters") for p in files}
        assert any(p.suffix == f".{ending}" for p in files)
    assert gbid("export", spring, "--output", tmp_path / "matlab") == 0  # the same files again
    (tmp_path / "matlab" / "spring_run1.mat").write_bytes(b"mine")
    assert "exists already" in printed_by(capsys, "export", spring, "--output", tmp_path / "matlab", code=2).err
    assert gbid("export", spring, "--output", tmp_path / "matlab", "--overwrite") == 0
    data = loadmat(tmp_path / "matlab" / "spring_run1.mat")
    numbers = dict(
        zip([str(n[0]) for n in data["parameter_name"].ravel()], data["parameter_value"].ravel(), strict=True)
    )
    assert data["A"][1, 0] == pytest.approx(-numbers["k"], rel=1e-12)


def test_export_of_an_experiment_takes_its_lpv_models_along(spring, capsys):
    results = spring.parent / "results" / "spring"
    (results / "lpv").mkdir()
    published = (ROOT / "models" / "theisen2016.yaml").read_text()
    (results / "lpv" / "machine.yaml").write_text(published)
    lines = printed_by(capsys, "export", spring, "--overwrite").out.splitlines()
    assert str(results / "export" / "machine.mat") in lines
    assert gbid("export", results / "fits" / "spring" / "run1.h5", "--output", results / "one") == 0
    assert (results / "one" / "spring_run1.mat").is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ("experiment.yaml", 3, ["no models and no controllers in", "run `gbid run experiment.yaml` first"]),
        ("fit.h5 --at 6 0", 2, ["--at is for LPV models and controllers"]),
        ("theisen2016 --to mat", 2, ["no such target; choose from c, csv", "matlab"]),
        ("theisen2016 --to csv --number float", 2, ["--number is for --to c"]),
        ("theisen2016 --to c --mass 2", 2, ["--mass is for --to ross"]),
        ("theisen2016 --to c", 2, ["takes controllers; here are only LPV models"]),
        ("nothing.yaml", 2, ["no such file"]),
        ("nothing", 2, ["there are: theisen2016"]),
        ("theisen2016 --at 9 0", 2, ["domain"]),
    ],
)
def test_export_says_what_it_cannot_do(tmp_path, monkeypatch, capsys, arguments, code, words):
    write_spring(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert gbid("export", *arguments.split()) == code
    err = capsys.readouterr().err
    assert [word for word in words if word not in err] == []


def test_export_of_a_model_at_a_point(tmp_path, capsys):
    assert gbid("export", "theisen2016", "--at", 6, 0, "--to", "csv", "--output", tmp_path) == 0
    names = sorted(Path(line).name for line in capsys.readouterr().out.splitlines())
    kinds = ("bearing_matrices", "bearing_response", "plant_matrices", "plant_response")
    assert names == [f"theisen2016_p6_n0_{kind}.csv" for kind in kinds]


@pytest.mark.parametrize(
    ("arguments", "text", "hint"),
    [
        (["run"], None, "check its name"),
        (["check"], "fits: [", "correct it here"),
        (["check"], "- 1\n", "write lines as"),
        (["fit"], "format: 1\nname: a\nrig: {operating_points: [{pressure_bar: 5, speed_rpm: 0}]}\n", "add one"),
        (["crossval"], "format: 1\nname: a\nrig: {operating_points: [{pressure_bar: 5, speed_rpm: 0}]}\n", "add one"),
        (["import"], "format: 1\nname: a\nrig: {operating_points: [{pressure_bar: 5, speed_rpm: 0}]}\n", "add one"),
    ],
)
def test_errors_end_in_what_to_do_next(arguments, text, hint, tmp_path, capsys):
    path = tmp_path / "a.yaml"
    if text is not None:
        path.write_text(text)
    (line,) = printed_by(capsys, *arguments, path, code=2).err.splitlines()
    assert line.startswith("gbid: error: ")
    assert hint in line.rpartition(";")[2], line
