"""Structures and their options in the controller section of an experiment."""

from __future__ import annotations

from pathlib import Path

import pytest
from experiment_files import QUICK

import gbid
from gbid.control import Scheduled
from gbid.core.errors import UsageError
from gbid.experiment.controllers import design_structure
from gbid.experiment.load import load_experiment

DESIGNS = """
controller:
  tall: {model: theisen2016, structure: filter, options: {filter_order: 6, frequency_khz: [0.05, 1.0]}}
  turning: {model: theisen2016, structure: resonant}
  coupled: {model: theisen2016, structure: full biquad}
"""


def test_structures_by_name_with_options(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(QUICK + DESIGNS, encoding="utf-8")
    experiment, domain = load_experiment(path), gbid.load_model("theisen2016").domain
    found = {name: design_structure(experiment, s, domain) for name, s in experiment.spec.controller.items()}
    assert len(found["tall"].parameters) == 2 * 13
    assert next(p for p in found["tall"].parameters if p.name == "frequency_2_x").upper == 1.0
    assert isinstance(found["turning"], Scheduled)
    assert found["turning"].domain == domain
    assert len(found["coupled"].parameters) == 16


def test_an_unknown_option_is_named_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(QUICK + DESIGNS.replace("filter_order", "filter_ordr"), encoding="utf-8")
    with pytest.raises(UsageError, match=r"one.yaml:\d+:\d+: controller.tall.options: .*unknown option filter_ordr"):
        load_experiment(path)
