"""Study of random plants: its stored figures, and one plant of each kind."""

import json

import pytest

from tests.benchmarks import random_plants
from tests.benchmarks.random_plants import PLANTS, judged, summary
from tests.benchmarks.running import DOCS

STORED = json.loads((DOCS / "random-plants.json").read_text(encoding="utf-8"))


def test_none_of_500_plants_fails():
    assert STORED["plants"] == sum(STORED["statuses"].values()) == 500
    assert "exception" not in STORED["statuses"]
    assert STORED["failures"] == []
    assert "failures: 0" in summary(STORED)


@pytest.mark.parametrize("seed", [0, 12, 276])
def test_a_plant_keeps_the_rules_of_the_study(seed):
    status, problem = judged(seed, 1.0)
    assert problem == ""
    assert "no stabilising gains" not in status
    assert seed % len(PLANTS) == 0


def test_gains_are_found_where_one_random_draw_of_1250_stabilises(monkeypatch):
    monkeypatch.setattr(random_plants, "_AGAIN", 800)
    status, problem = judged(499, 1.0, again=True)
    assert problem == ""
    assert status != "no stabilising gains"
