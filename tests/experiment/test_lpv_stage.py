"""Surfaces in an experiment: section, stage, verb and files."""

from contextlib import closing

import numpy as np
import pytest
from experiment_files import SMALL, copy_results, json_of, printed_by
from experiment_files import gbid as command
from json_keys import assert_keys

import gbid
from gbid.experiment.engines import ProcessPool
from gbid.experiment.load import load_experiment
from gbid.experiment.run import InTurn, Job, run_stage
from gbid.experiment.stages.crossval import CROSSVAL, NOMINAL
from gbid.experiment.stages.lpv import LPV

PIEZOS = "  piezos: {structure: piezo_pair, recordings: p3*prbs*}\n"
CAMPAIGN = SMALL.replace("lpv:", f"{PIEZOS}lpv:").replace("2016}", "2016, direct: true}")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    path = folder / "experiment.yaml"
    path.write_text(CAMPAIGN)
    for verb in ("rig", "fit"):
        assert command(verb, path, "--results", folder / "out", "--engine", "serial") == 0
    return path, folder / "out"


def test_verb_draws_and_keeps_surfaces(campaign, capsys):
    path, out = campaign
    document = json_of(capsys, "lpv", path, "--results", out)
    assert_keys("lpv", document)
    two, one = document["lpv"]
    assert (two["item"], one["item"]) == ("bearing", "bearing_direct")
    assert (two["recordings"], two["operating_points"]) == (8, 4)
    assert [row["name"] for row in two["deviations"][:4]] == ["tau_x", "tau_y", "omega_1", "omega_2"]
    assert two["deviations"][2]["published_rms"] == 1.13
    assert one["options"]["method"] == "direct"
    again = json_of(capsys, "lpv", path, "--results", out)
    assert {o["state"] for o in again["outcomes"]} == {"kept"}
    assert again["lpv"] == document["lpv"]
    shown = printed_by(capsys, "lpv", path, "--results", out).out
    for word in ("two-step", "direct", "omega_1", "coefficients", "bearing_direct.yaml"):
        assert word in shown

    fit = gbid.load(out / "lpv" / "bearing.h5")
    published = gbid.load_model("theisen2016")
    assert fit.model.actuators == published.actuators
    computed, true = (m.at(3, 6000).modes() for m in (gbid.load_model(out / "lpv" / "bearing_direct.yaml"), published))
    np.testing.assert_allclose(np.array(computed)[:2], np.array(true)[:2], rtol=0.02)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("{fit: bearings}", ("lpv.fit", "no fit of this name", "bearing")),
        ("{fit: piezos}", ("lpv.fit", "has no parameters k_xx")),
        ("{fit: bearing}", ("lpv.order", "4 operating points for 6 terms")),
        (
            "{fit: bearing, order: 3}",
            ("lpv.order: order = 3; choose 0, 1, 2, 'auto'", "terms out of 1, P, Omega"),
        ),
        ("{fit: bearing, order: [P, Q]}", ("lpv.order: order = ('P', 'Q'): 'Q' is not a term", "choose from 1, P")),
        ("{fit: bearing, order: 1, actuators: nominel}", ("lpv.actuators: expected the word nominal", "theisen2016")),
        ("{fit: bearing, order: 1, actuators: nominal}", ("lpv.actuators", "no section 'nominal'")),
        ("{fit: bearing, order: 1, weighting: fits, robust: true}", ("lpv.robust", "needs weighting")),
    ],
)
def test_wrong_sections_are_named(tmp_path, section, words, capsys):
    path = tmp_path / "experiment.yaml"
    path.write_text(CAMPAIGN[: CAMPAIGN.index("lpv:")] + f"lpv: {section}\n")
    printed = printed_by(capsys, "check", path, code=2).err
    for word in words:
        assert word in printed


FILES = ("crossval/piezos.csv", "crossval/piezos_summary.csv", "nominal/piezos.yaml", "lpv/bearing.yaml")


def test_processes_give_the_same_files(campaign, tmp_path):
    """Tables, nominal actuator and surfaces made by worker processes and in this process are equal."""
    _, out = campaign
    path = tmp_path / "experiment.yaml"
    text = CAMPAIGN.replace("theisen2016, direct: true", "nominal")  # the direct ones take their time
    path.write_text(text + "crossval: {piezos: {on: point}}\nnominal: {fit: piezos}\n")
    made = {}
    with closing(ProcessPool(1)) as pool:
        for name, engine in (("serial", InTurn()), ("pool", pool)):
            job = Job(load_experiment(path, tmp_path / name), engine=engine)
            for folder in ("recordings", "prefiltered", "fits"):
                copy_results(out / folder, tmp_path / name / folder)
            for stage in (CROSSVAL, NOMINAL, LPV):
                assert {outcome.state for outcome in run_stage(job, stage)} == {"made"}
            made[name] = {file: (tmp_path / name / file).read_bytes() for file in FILES}
    assert made["serial"] == made["pool"]


def test_a_missing_fit_is_no_fault_of_the_surfaces(tmp_path, capsys):
    """It is not remembered: the surfaces are drawn as soon as the fits are there."""
    path = tmp_path / "experiment.yaml"
    path.write_text(CAMPAIGN)
    (outcome,) = json_of(capsys, "lpv", path, code=3)["outcomes"]
    assert (outcome["item"], outcome["cause"]) == ("bearing uncertainty", "input")
    assert "fit 'bearing' has no results" in outcome["text"]
    assert not (tmp_path / "results/small/failed").exists()
