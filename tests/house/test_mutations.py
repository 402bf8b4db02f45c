"""The faults of the mutation study are those that it says, and its table counts them."""

import ast
from pathlib import Path

import pytest

from benchmarks.mutants import formulas, is_another_program, mutants, summary, verdict

SOURCE = '''"""Words."""

LEAST = 2.5


def size(values: list[float], *, fully: bool = True) -> float:
    """Words = 1."""
    if not values or min(values) < LEAST:
        raise ValueError(f"{len(values) + 1} values, é")
    total = 0.0  # é
    for value in values[1:]:
        total += value
    return round(total, ndigits=3)
'''
EXPECTED = {
    ("", "2.5", "5.0"),
    ("size", "True", "False"),
    ("size", "not values", "(values)"),
    ("size", "min", "max"),
    ("size", "min(values) < LEAST", "(min(values) <= LEAST)"),
    ("size", "min(values) < LEAST", "(min(values) > LEAST)"),
    ("size", "not values or min(values) < LEAST", "((not values) and (min(values) < LEAST))"),
    ("size", "not values or min(values) < LEAST", "(not (not values or min(values) < LEAST))"),
    ("size", "0.0", "1.0"),
    ("size", "1", "2"),
    ("size", "total += value", "pass"),
    ("size", "round(total, ndigits=3)", "round(total)"),
    ("size", "3", "4"),
}


def test_faults_of_a_small_file(tmp_path: Path) -> None:
    path = tmp_path / "size.py"
    path.write_text(SOURCE, encoding="utf-8")
    faults = mutants(path, tmp_path)
    assert {(m.function, m.old, m.new) for m in faults} == EXPECTED
    assert len(faults) == len(EXPECTED)
    for mutant in faults:
        assert is_another_program(mutant, tmp_path)
        assert mutant.apply(SOURCE).splitlines()[: mutant.line - 1] == SOURCE.splitlines()[: mutant.line - 1]
    same = next(m for m in faults if m.old == "total += value")
    assert ast.unparse(ast.parse(same.apply(SOURCE))).count("pass") == 1
    with pytest.raises(ValueError, match=r"size\.py:12 is no longer"):
        same.apply(SOURCE.replace("total += value", "total -= value"))


def test_the_share_leaves_equivalent_faults_out() -> None:
    entries = [{"file": "gbid/lpv/model.py", "outcome": outcome} for outcome in ("killed", "timeout", "survived")]
    entries += [{"file": "gbid/lpv/model.py", "outcome": "survived", "equivalent": "only the speed"}]
    assert [verdict(e) for e in entries] == ["killed", "killed", "survived", "equivalent"]
    assert summary(entries).splitlines()[-1] == "| all | 4 | 2 | 1 | 1 | 66.7 % |"


def test_formulas_are_functions_that_cite_the_paper(tmp_path):
    text = '"""Eq. 1 of the paper."""\n\n\ndef cited():\n    """Return Eq. 12."""\n\n\ndef other():\n    """Words."""\n'
    text += '\n\nclass Pair:\n    """Words."""\n\n    def gain(self):\n        """Gain (paper, Sec. 3.3)."""\n'
    path = tmp_path / "a.py"
    path.write_text(text, encoding="utf-8")
    assert formulas(path) == {"cited", "Pair.gain"}
