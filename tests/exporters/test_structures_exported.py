"""Every built-in controller structure leaves gbid as MATLAB data and YAML, and some run on the rig."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from experiment_files import gbid as command
from places import ROOT
from scipy.io import loadmat

import gbid
from gbid.control import (
    Scheduled,
    controller_at,
    controller_model,
    controller_structure,
    exact_plant,
    sample_controller,
    save_controller,
)
from gbid.control.controllers.built_in import built_in_structures
from gbid.control.controllers.structures import with_schedule
from gbid.core.yaml_file import read_yaml
from gbid.rig import Hammer, Impact, Machine, SampledController, Stationary, record

MODEL = gbid.load_model("theisen2016")
POINTS = [(6.0, 0.0), (6.0, 6000.0)]


def response(matrices: list[np.ndarray]) -> np.ndarray:
    """Response of a sampled controller at three frequencies."""
    A, B, C, D = matrices
    z = np.exp(2j * np.pi * np.array([3.0, 120.0, 900.0]) * 2e-4)
    return np.array([C @ np.linalg.solve(w * np.eye(len(A)) - A, B) + D for w in z])


@pytest.mark.parametrize("kind", built_in_structures())
def test_a_structure_is_exported(kind: str, tmp_path: Path) -> None:
    structure = with_schedule(controller_structure(kind), MODEL.domain)
    rng = np.random.default_rng(3)
    gains = {}
    for q in structure.parameters:
        start = 0.0 if q.start is None else q.start
        gains[q.name] = float(np.clip(start + 0.05 * rng.standard_normal(), q.lower, q.upper))
    scheduled = isinstance(structure, Scheduled)
    file = tmp_path / "own.yaml"
    save_controller(file, structure, gains, name="own", sample_time=2e-4, points=POINTS if scheduled else ())
    for to in ("matlab", "yaml"):
        assert command("export", file, "--to", to, "--output", tmp_path / to) == 0, to
    written = {to: sorted((tmp_path / to).rglob(f"*.{end}")) for to, end in (("matlab", "mat"), ("yaml", "yaml"))}
    assert len(written["matlab"]) == len(written["yaml"]) == (len(POINTS) if scheduled else 1)
    for point, mat, text in zip(POINTS, written["matlab"], written["yaml"], strict=False):
        sampled = sample_controller(controller_at(structure, gains, *point), 2e-4)
        mine = response([getattr(sampled, letter) for letter in "ABCD"])
        for computed in (loadmat(mat), read_yaml(text).data):
            theirs = response(
                [np.array(computed[letter], float).reshape(getattr(sampled, letter).shape) for letter in "ABCD"]
            )
            np.testing.assert_allclose(theirs, mine, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["lead-lag", "full P"])
def test_a_structure_runs_on_the_rig_as_the_sampled_loop_says(kind: str) -> None:
    run = json.loads((ROOT / "docs" / "structures.json").read_text(encoding="utf-8"))["structures"][kind]
    controller = sample_controller(controller_model(controller_structure(kind), run["designs"][0]["gains"]), 2e-4)
    machine = Machine.from_parameters(MODEL.key_parameters(6.0, 0.0), MODEL.actuators)
    about = {"name": "hit", "conditions": {"pressure_bar": 6.0, "speed_rpm": 0.0}, "seed": 1}
    zero = record(machine, Stationary(0.2), **about).signal("p").mean(axis=0)
    running = SampledController(*(getattr(controller, letter) for letter in "ABCD"), 2e-4, offset=zero)
    hit = record(machine, Hammer((Impact.along("x", 0.1, 12.0),), 0.3), controller=running, **about)
    validation = gbid.validate_impact(hit, exact_plant(MODEL, 6.0, 0.0), controller)
    assert validation.along_percent > 97
    assert 1 / validation.force_scale == pytest.approx(2.18, rel=0.01)  # the moving mass
