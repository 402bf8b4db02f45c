"""Codes of notes: unique, explained, used, and shown."""

import json
import re

import pytest
from experiment_files import gbid
from fit_cases import MODE, MODE_AT, levels, simulated
from places import ROOT

from gbid.core.errors import UsageError
from gbid.core.notes import FAMILIES, explain, explanations, families
from gbid.identify import fit

KINDS = [kind for family in FAMILIES.values() for kind in family]


def test_each_kind_has_a_code_of_its_own_in_the_range_of_its_family():
    assert {kind.value for kind in KINDS} == set(explanations())
    assert len(KINDS) == len(set(KINDS)) == sum(len(family.__members__) for family in FAMILIES.values())
    for hundred, group in enumerate(families().values(), 1):
        assert all(re.fullmatch(rf"GB{hundred}\d\d", entry.code) for entry in group)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.value)
def test_each_kind_is_used_and_explained(kind):
    name = f"{type(kind).__name__}.{kind.name}("
    assert any(name in path.read_text(encoding="utf-8") for path in (ROOT / "gbid").rglob("*.py"))
    _, title, meaning, remedy, warns = explain(kind.value)
    assert warns in (True, False)
    assert not title.endswith(".")
    assert meaning.endswith(".")
    assert remedy.endswith(".")


def test_notes_of_a_fit_have_codes_that_are_explained():
    rec = simulated(MODE, MODE_AT, levels(300), noise=0.3)
    result = fit(MODE, rec, focus="simulation", bounds={"g": (0.0, 1.0)})
    assert len(result.notes) >= 2
    for note in result.notes:
        assert explain(re.search(r"\[(GB\d{3})\]$", note)[1]).title


def test_explain_tells_meaning_and_remedy(capsys):
    assert gbid("explain", "gb102") == 0
    out = capsys.readouterr().out
    assert out.startswith("GB102: the data do not determine a parameter")
    assert "What to do: " in out
    assert gbid("explain", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)["notes"]) == len(explanations())
    assert gbid("explain", "GB999") == 2
    assert "`gbid explain` lists all" in capsys.readouterr().err
    with pytest.raises(UsageError):
        explain("")
