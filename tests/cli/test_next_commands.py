"""Commands that gbid proposes after `next:` can be given: parsed for all shipped experiments, run for a small one."""

import shlex

import pytest
from experiment_files import gbid, write_spring
from figure_cases import BlankPictures
from places import ROOT
from typer.main import get_command

from gbid.cli.main import HIDDEN, VERBS, app
from gbid.cli.stages import next_step
from gbid.experiment.load import load_experiment

SHIPPED = [
    *(path for path in (ROOT / "experiments").glob("*.yaml") if path.stem != "theisen2016_numbers"),
    *(ROOT / "experiments").glob("*/experiment.yaml"),
]
ALL = {*HIDDEN, *(verb for group in VERBS.values() for verb in group)}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem if path.stem != "experiment" else path.parent.name)
def test_proposals_for_shipped_experiments_are_complete_commands(path):
    experiment, verbs = load_experiment(path, form_only=True), get_command(app)
    for verb in sorted(ALL):
        words = shlex.split(next_step(experiment, verb))[1:]
        if words:
            with verbs.make_context("gbid", words[:1]) as context:
                name, command, rest = verbs.resolve_command(context, words)
                command.make_context(name, rest)  # refuses unknown options, values and missing arguments


@pytest.mark.parametrize("first", [["check"], ["import"], ["new"]])
def test_proposals_lead_to_the_end(tmp_path, capsys, monkeypatch, first):
    monkeypatch.setattr("gbid.report.write.Pictures", BlankPictures)
    words = [*first, tmp_path / "rig" if first == ["new"] else write_spring(tmp_path)]
    given = []
    while words:
        given.append(words[0])
        assert gbid(*words) == 0, words
        told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("next: gbid ")]
        words = shlex.split(told[-1])[2:] if told else []
        if words[:1] == ["run"] and first == ["new"]:
            break  # the run of a template is a test of its own
    assert given[-1] == "new" or given[-2:] == ["report", "export"] or given[-2:] == ["run", "export"]
