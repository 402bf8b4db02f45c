"""A measured figure of a decision record stands beside the command that prints it."""

import re
from pathlib import Path

import pytest

from gbid.cli.main import app

ROOT = Path(__file__).parents[2]
RECORDS = sorted((ROOT / "docs" / "decisions").glob("0*.md"))
UNITS = "ms|us|µs|ns|s|min|minutes|seconds|hours|%|[kMG]B|iterations|times"
FIGURE = re.compile(rf"(?<![\w.])(\d[\d .,]*(?:e-?\d+)?\s?(?:{UNITS}))(?!\w)")
COMMAND = re.compile(r"`(?:python -m (tests\.benchmarks\.\w+)|make ([\w-]+)|gbid (\w+)[^`]*)`")
VERBS = {command.name for command in app.registered_commands}
SETTINGS = {
    "0010": {"20 ms"},  # the hold that was chosen
    "0028": {"32 MB"},  # limit of memory
    "0040": {"0.1 %"},  # limit
    "0064": {"0.1 s", "2 ms"},  # length of a piece, sample time of an example
}
"""Figures that a record sets and does not measure."""


def unnamed(number: str, text: str) -> list[str]:
    """Return the figures of the paragraphs of a record that name no command."""
    bare = [paragraph for paragraph in text.split("\n\n") if not COMMAND.search(paragraph)]
    figures = [" ".join(figure.split()) for paragraph in bare for figure in FIGURE.findall(paragraph)]
    return [figure for figure in figures if figure not in SETTINGS.get(number, ())]


def test_the_records_are_few_and_short():
    words = {path.stem: len(path.read_text(encoding="utf-8").split()) for path in RECORDS}
    assert len(words) <= 50
    assert {name: count for name, count in words.items() if count > 250} == {}
    index = (ROOT / "docs" / "decisions" / "index.md").read_text(encoding="utf-8")
    assert re.findall(r"^(0\d{3}-\S+)$", index, re.M) == sorted(words)


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_measured_figure_names_its_command(path):
    text = path.read_text(encoding="utf-8")
    assert unnamed(path.stem[:4], text) == []
    targets = (ROOT / "Makefile").read_text(encoding="utf-8")
    for module, target, verb in COMMAND.findall(text):
        assert not module or (ROOT / (module.replace(".", "/") + ".py")).is_file(), module
        assert not target or re.search(rf"^{target}:", targets, re.M), target
        assert not verb or verb in VERBS, verb


def test_a_figure_without_a_command_is_found():
    assert unnamed("0001", "A fit takes 12 ms.\n\n`make paper` says 3 %.") == ["12 ms"]
    assert unnamed("0010", "It holds 20 ms, 440\ntimes.") == ["440 times"]
