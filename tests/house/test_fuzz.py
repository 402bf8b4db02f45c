"""Mutated files of all kinds: no traceback, no hang, no growth, no silent change. `make fuzz` tries many more."""

import zipfile
from functools import cache
from pathlib import Path

import pytest
from fuzzing.outcome import FAULTS, try_input
from fuzzing.targets import fuzz_targets
from hypothesis import given, settings
from hypothesis import strategies as st

KEPT = Path(__file__).parents[1] / "data" / "fuzz_inputs.zip"
"""Inputs that once ended in a fault; the folder of each is the name of its target."""


@cache
def targets():
    """Kinds of files by name; each process that collects this file would make them in vain."""
    return {target.name: target for target in fuzz_targets()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def test_good_files_are_read(folder):
    for target in targets().values():
        assert try_input(target, target.content, folder).outcome == "accepted, equal", target.name


@settings(max_examples=300, deadline=None)
@given(name=st.deferred(lambda: st.sampled_from(sorted(targets()))), random=st.randoms(use_true_random=False))
def test_mutated_files(folder, name, random):
    target = targets()[name]
    tried = try_input(target, target.mutate(random, target.content), folder)
    assert tried.outcome not in FAULTS, tried.text


def test_inputs_that_once_ended_in_a_fault(folder):
    with zipfile.ZipFile(KEPT) as archive:
        for name in archive.namelist():
            tried = try_input(targets()[name.split("/")[0]], archive.read(name), folder)
            assert tried.outcome not in FAULTS, f"{name}: {tried.text}"
