"""Structures that other packages offer by entry points of the group `gbid.structures`."""

import pytest
from experiment_files import SPRING_STRUCTURE, write_spring

from gbid.core.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.structures import make_structure, structure_settings

ENTRY_POINTS = """\
[gbid.structures]
spring = spring_models:structure
made = spring_models:make
broken = no_such_module:structure
number = spring_models:LIMIT
"""
MADE = """
LIMIT = 3

def make(**options):
    return structure
"""


@pytest.fixture
def experiment_of(tmp_path, monkeypatch):
    """Experiment with a structure by name, and a package beside it that offers structures."""
    info = (site := tmp_path / "site") / "spring_models-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: spring-models\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (site / "spring_models.py").write_text(SPRING_STRUCTURE + MADE)
    monkeypatch.syspath_prepend(site)
    return lambda name: load_experiment(write_spring(tmp_path, ('"spring.py:structure"', name)))


@pytest.mark.parametrize("name", ["spring", "made"])
def test_structure_of_another_package(experiment_of, name):
    experiment = experiment_of(name)
    assert make_structure(experiment, "spring").name == "spring"
    assert structure_settings(experiment, "spring")["package"] == "spring-models 1.2"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("broken", r"'broken' \(gbid.structures\): spring-models 1.2 fails on its import: ModuleNotFoundError"),
        ("number", "spring-models 1.2: number is not a structure"),
        ("sprung", "no structure 'sprung'; .* or install the package that offers it"),
    ],
)
def test_structures_that_cannot_be_had_are_refused(experiment_of, name, message):
    with pytest.raises(UsageError, match=message):
        make_structure(experiment_of(name), "spring")
