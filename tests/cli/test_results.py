"""One stage or those up to it by `gbid run`, and stored results: `gbid show` and `gbid diff`."""

import hashlib
import re
import shlex
import shutil
import sys

import casadi
import numpy as np
import pytest
from experiment_files import files_in, gbid, json_of, printed_by, write_spring

import gbid as package
from gbid.cli.options import STAGE_VERBS
from gbid.core.errors import UsageError
from gbid.experiment.engines import bare_job
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, no_tasks
from gbid.experiment.stages import registry


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """An experiment whose fits are made."""
    path = write_spring(tmp_path_factory.mktemp("spring"))
    assert gbid("run", path, "--until", "fit", "--quiet") == 0
    return path


def test_every_stage_can_be_named():
    known = {stage.name for stage in registry.STAGES}
    of_verbs = [name for verb in STAGE_VERBS.values() for name in verb.stages]
    assert set(of_verbs) <= known
    assert len(of_verbs) == len(set(of_verbs))
    assert known - set(of_verbs) == {"loop cost"} | {s.name for s in registry.STAGES if s.tasks is no_tasks}
    order = [stage.name for stage in registry.STAGES]
    assert sorted(of_verbs, key=order.index) == of_verbs  # the overview lists them in the order of a run


def test_until_runs_the_stages_before_and_no_more(spring):
    results = spring.parent / "results/spring"
    assert files_in(results) == [
        *("fits/spring/run1.h5", "fits/spring/run2.h5"),
        *("recordings/run1.h5", "recordings/run2.h5"),
    ]


def test_until_a_recording_draws_no_fit(spring, tmp_path, capsys):
    document = json_of(capsys, "run", spring, "--until", "import", "--results", tmp_path / "r")
    assert {outcome["stage"] for outcome in document["outcomes"]} == {"import"}
    plan = json_of(capsys, "run", spring, "--until", "fit", "--results", tmp_path / "r", "--dry-run")["plan"]
    assert [row["stage"] for row in plan] == ["import", "fit"]


@pytest.mark.parametrize("stage", ["import", "fit", "crossval"])
def test_only_a_stage_says_what_its_verb_says(spring, capsys, stage, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(spring.parent / "results/spring", results)
    assert gbid("crossval", spring, "--results", results, "--quiet") == 0
    by_verb = printed_by(capsys, stage, spring, "--results", results)
    by_option = printed_by(capsys, "run", spring, "--only", stage, "--results", results)
    assert by_option == by_verb
    assert f"{stage} " in by_verb.err


def test_only_takes_what_earlier_stages_left(spring, tmp_path, capsys):
    assert gbid("run", spring, "--only", "fit", "--results", tmp_path / "r") == 3
    assert "`gbid import` makes it" in capsys.readouterr().err
    assert not (tmp_path / "r/recordings").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--only", "fti"], "fti: no such stage; did you mean 'fit'? choose from rig, import, fit,"),
        (["--until", "figure"], "figure: no such stage"),
        (["--only", "rig"], "no section 'rig'; add one, or use `gbid run`"),
        (["--only", "lpv"], "no section 'lpv'"),
        (["--only", "fit", "--until", "fit"], "--only and --until contradict each other"),
    ],
)
def test_a_stage_that_cannot_run_is_refused(spring, capsys, options, words):
    assert words in printed_by(capsys, "run", spring, *options, code=2).err


def test_show_prints_what_a_file_holds(spring, capsys):
    file = spring.parent / "results/spring/fits/spring/run1.h5"
    fit = package.load(file)
    document = json_of(capsys, "show", file)
    assert (document["kind"], document["file"]) == ("FitResult", str(file))
    assert {row["parameter"]: row["estimate"] for row in document["parameters"]} == dict(fit.parameters)
    text = printed_by(capsys, "show", file).out
    assert re.search(r"^k +\d", text, re.MULTILINE)
    assert "damping" in text
    recording = spring.parent / "results/spring/recordings/run1.h5"
    assert printed_by(capsys, "show", recording).out.startswith(repr(package.load(recording)))
    assert json_of(capsys, "show", recording)["kind"] == "Recording"
    assert printed_by(capsys, "show", spring).out.strip() == spring.read_text().strip()


def test_show_refuses_what_it_cannot_read(spring, tmp_path, capsys):
    assert "give two folders to `gbid diff`" in printed_by(capsys, "show", tmp_path, code=2).err
    assert "no such file" in printed_by(capsys, "show", tmp_path / "none.h5", code=3).err
    (tmp_path / "a.h5").write_text("nothing")
    assert "not a readable HDF5 file" in printed_by(capsys, "show", tmp_path / "a.h5", code=3).err


def test_diff_counts_in_standard_deviations(spring, tmp_path, capsys):
    mine, other = spring.parent / "results/spring", tmp_path / "other"
    shutil.copytree(mine, other)
    assert json_of(capsys, "diff", mine, other)["parameters"] == []
    # The fit of the second recording in place of that of the first: the same settings, other data.
    shutil.copyfile(mine / "fits/spring/run2.h5", other / "fits/spring/run1.h5")
    (other / "fits/spring/run2.h5").unlink()
    document = json_of(capsys, "diff", mine, other)
    a, b = (package.load(folder / "fits/spring/run1.h5") for folder in (mine, other))
    rows = {row["parameter"]: row for row in document["parameters"]}
    assert set(rows) == {"k", "d", "b"}
    for name, row in rows.items():
        expected = (b.parameters[name] - a.parameters[name]) / max(a.std[name], b.std[name])
        assert row["in_std"] == pytest.approx(expected, rel=1e-12)
    assert [(row["what"], row["a"], row["b"]) for row in document["settings"]] == [("recordings", ["run1"], ["run2"])]
    assert (document["only_in_a"], document["only_in_b"]) == (["fits/spring/run2"], [])
    text = printed_by(capsys, "diff", mine, other).out
    assert "parameters that differ: 3, of 1 fits" in text
    assert "only in A: fits/spring/run2" in text


def test_diff_refuses_folders_without_results(spring, tmp_path, capsys):
    mine = spring.parent / "results/spring"
    assert "no such folder" in printed_by(capsys, "diff", mine, tmp_path / "none", code=2).err
    assert "no fit and no design in common" in printed_by(capsys, "diff", mine, tmp_path, code=2).err


def test_a_result_says_what_it_was_made_with(spring, tmp_path, capsys):
    results = spring.parent / "results/spring"
    origin = json_of(capsys, "show", results / "fits/spring/run1.h5")["made_with"]
    data = spring.parent / "data/run1.csv"
    assert origin["data"] == {"data/run1.csv": hashlib.sha256(data.read_bytes()).hexdigest()}
    assert origin["experiment"] == {"file": spring.name, "sha256": hashlib.sha256(spring.read_bytes()).hexdigest()}
    assert origin["command"].endswith(shlex.join(sys.argv[1:]))
    assert [origin[name] for name in ("gbid", "numpy", "casadi")] == [
        *(package.__version__, np.__version__, casadi.__version__)
    ]
    assert {"python", "platform", "scipy", "seeds"} <= set(origin)
    page = tmp_path / "report.html"
    assert gbid("report", spring, "--output", page) == 0
    end = page.read_text().partition('id="origin"')[2]
    assert str(spring.parent) not in page.read_text()
    for words in (origin["platform"], origin["experiment"]["sha256"], *origin["data"].values()):
        assert words in end


def test_set_gives_a_key_another_value_in_one_command(spring, tmp_path, capsys):
    before = spring.read_bytes()
    changes = ("name=feder", "fits.spring.together=true", "crossval={}")
    other = ("--results", tmp_path / "other", *(word for change in changes for word in ("--set", change)))
    assert json_of(capsys, "check", spring, *other)["experiment"] == "feder"
    with pytest.raises(UsageError, match="expected KEY=VALUE"):
        load_experiment(spring, changes=["name"])
    for change, words in (
        ("fits.spring.tgether=true", "fits.spring.tgether"),
        ("fits.spring.together=often", "fits.spring.together"),
        ("name.first=a", "is a key within a value"),
        ("import.recordings.7.name=a", "count from 0"),
        ("fits: [", "expected KEY=VALUE"),
        ("fits=[", "not valid YAML"),
    ):
        assert words in printed_by(capsys, "check", spring, "--set", change, code=2).err
    assert spring.read_bytes() == before


def test_a_saved_value_says_its_versions_and_no_experiment(tmp_path, capsys):
    package.save(package.Recording({"u": np.zeros((8, 2))}, 1e-3, name="still"), tmp_path / "a.h5")
    origin = json_of(capsys, "show", tmp_path / "a.h5")["made_with"]
    assert set(origin) == {"gbid", "python", "numpy", "scipy", "casadi", "platform"}


def test_a_worker_writes_the_command_of_the_run(spring):
    job = Job(load_experiment(spring), command="gbid run a.yaml")
    assert bare_job(job).command == job.command
