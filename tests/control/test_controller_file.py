"""Controllers in files: read back as written, refused when broken, and as C beside the model they came from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from own_controller import own
from typer.testing import CliRunner

import gbid
from gbid.cli.main import app
from gbid.control import GainStatus, controller_model, sample_controller, scheduled
from gbid.control.controllers.built_in import BiquadStructure, PStructure
from gbid.core.errors import UsageError
from gbid.export.chain import ChainOptions, chain_of

GAINS = {"kappa_x": 1.125, "kappa_y": 0.99}
BIQUAD = dict(
    zip(
        [p.name for p in BiquadStructure().parameters],
        [1.1, 0.9, -0.4, 0.3, 0.2, -0.7, 0.12, 0.31, 0.8, 1.4],
        strict=True,
    )
)


@pytest.mark.parametrize(
    ("structure", "gains"),
    [
        (gbid.controller_structure("P", lowpass_hz=800.0, order=2), GAINS),
        (gbid.controller_structure("PD"), {**GAINS, "kd_x": 0.123456789012345, "kd_y": -1.0}),
        (gbid.controller_structure("biquad", damping=(0.1, 2.0)), BIQUAD),
        (gbid.controller_structure("P", order=0), GAINS),
    ],
)
def test_round_trip(structure: object, gains: dict[str, float], tmp_path: Path) -> None:
    path = tmp_path / "design.yaml"
    provenance = {"peak_sensitivity": 2.6, "made_by": "test"}
    gbid.save_controller(
        path, structure, gains, name="mine", plant="theisen2016", method="zoh", sample_time=1e-4, provenance=provenance
    )  # type: ignore[arg-type]
    design = gbid.load_controller(path)
    assert design.structure == structure
    assert design.gains == gains
    assert (design.name, design.plant, design.method, design.sample_time) == ("mine", "theisen2016", "zoh", 1e-4)
    assert design.provenance == provenance
    assert set(design.units) == set(gains)
    expected = controller_model(structure, gains)  # type: ignore[arg-type]
    for letter in "ABCD":
        np.testing.assert_array_equal(getattr(design.at(), letter), getattr(expected, letter))
        np.testing.assert_array_equal(getattr(design.models[None], letter), getattr(expected, letter))
        np.testing.assert_array_equal(
            getattr(design.sampled_at(), letter), getattr(sample_controller(expected, 1e-4, "zoh"), letter)
        )


def test_scheduled_round_trip(tmp_path: Path) -> None:
    structure = scheduled(PStructure(), ("1", "P", "Omega"))
    gains = {p.name: 0.1 * i for i, p in enumerate(structure.parameters)}
    path = tmp_path / "scheduled.yaml"
    with pytest.raises(UsageError, match="give the operating points="):
        gbid.save_controller(path, structure, gains, sample_time=2e-4)
    gbid.save_controller(path, structure, gains, points=[(3, 0), (6, 2050)], sample_time=2e-4)
    design = gbid.load_controller(path)
    assert design.structure == structure
    assert list(design.models) == [(3.0, 0.0), (6.0, 2050.0)]
    np.testing.assert_array_equal(design.at(6, 2050).C, design.models[(6.0, 2050.0)].C)
    with pytest.raises(UsageError, match="its gains follow the operating point; give pressure_bar"):
        design.at()


def test_structure_of_ones_own(tmp_path: Path) -> None:
    gains = {"low": 1.25, "high": -0.5}
    path = tmp_path / "lead.yaml"
    gbid.save_controller(path, own(), gains, sample_time=2e-4)
    expected = controller_model(own(), gains)
    bare, complete = gbid.load_controller(path), gbid.load_controller(path, own())
    assert bare.structure is None
    for design in (bare, complete):
        np.testing.assert_array_equal(design.at(5.0, 0.0).D, expected.D)
        assert design.sampled_at().dt == 2e-4


def test_bad_files(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    gbid.save_controller(path, "P", GAINS, sample_time=2e-4)
    text = path.read_text().split("\n", 1)[1]  # without its checksum, as in a file of gbid 0.1
    with pytest.raises(UsageError, match="exists"):
        gbid.save_controller(path, "P", GAINS, sample_time=2e-4)
    gbid.save_controller(path, "P", GAINS, overwrite=True, sample_time=2e-4)
    line = text.splitlines().index("  kappa_x:") + 2
    for old, new, message in (
        ("value: 1.125", "value: 1.2", r"continuous C differs from the value computed from gains and sampling"),
        ("method: tustin", "method: zoh", r"sampled \w differs from the value computed from gains and sampling"),
        ("value: 1.125", "value: high", rf"p\.yaml:{line}:5: gains\.kappa_x\.value = 'high'"),
        ("kind: controller", "kind: lpv_model", r"p\.yaml:1:1: kind = 'lpv_model'"),
        ("order: 1", "ordre: 1", r"unknown option ordre; choose from"),
        ("sampling:", "sampled:", r"unknown key 'sampled'"),
        ("sample_time_s: 0.0002", "sample_time_s: -1.0", r"sample_time = -1.0; give a number above 0"),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(UsageError, match=message):
            gbid.load_controller(path)
    with pytest.raises(UsageError, match="no such file"):
        gbid.load_controller(tmp_path / "none.yaml")
    with pytest.raises(UsageError, match=r"ends in \.yaml"):
        gbid.save_controller(tmp_path / "p.h5", "P", GAINS, sample_time=2e-4)
    with pytest.raises(UsageError, match="leave points= out"):
        gbid.save_controller(tmp_path / "q.yaml", "P", GAINS, points=[(6, 0)], sample_time=2e-4)
    path.write_text(text)
    with pytest.raises(UsageError, match="leave structure= out"):
        gbid.load_controller(path, own())


def test_gains_changed_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    gbid.save_controller(path, "P", GAINS, sample_time=2e-4, plant="theisen2016")
    assert gbid.load_controller(path).notes == ()
    path.write_bytes(path.read_bytes().replace(b"value: 1.125", b"value: 1.2").replace(b"\n", b"\r\n"))
    design = gbid.load_controller(path)
    assert design.gains["kappa_x"] == 1.2
    expected = controller_model(gbid.controller_structure("P"), design.gains)
    np.testing.assert_array_equal(design.models[None].C, expected.C)
    assert "changed after gbid wrote it" in design.notes[0]
    assert "computed from the gains" in design.notes[0]
    assert "continuous C differs from the value computed" in design.notes[1]
    ran = CliRunner().invoke(app, ["export", str(path), "--to", "c", "--output", str(tmp_path)])
    assert "gbid: note: " in ran.stderr
    gbid.save_controller(path, own(), {"low": 1.25, "high": -0.5}, overwrite=True, sample_time=2e-4)
    path.write_text(path.read_text().replace("1.25", "1.26", 1))
    assert "matrices are used as they are stored" in gbid.load_controller(path).notes[0]
    assert gbid.load_controller(path, own()).models[None].D[0, 0] != gbid.load_controller(path).models[None].D[0, 0]


def test_a_tuned_design_is_saved_for_the_target_it_was_designed_for(tmp_path: Path) -> None:
    """Structure and gains alone say no sample time: 0.4 ms became 0.2 ms, and the machine ran at it."""
    model = gbid.load_model("theisen2016")
    options = {"operating_points": [(6, 0)], "sample_time": 4e-4, "computation_s": 0.0}
    tuned = gbid.tune(model, **options)
    path = tmp_path / "tuned.yaml"
    for forgotten in (lambda: gbid.save_controller(path, tuned.controller, tuned.gains), lambda: ended(tuned)):
        with pytest.raises(UsageError):
            forgotten()
    with pytest.raises(UsageError, match=r"designed for sample_time = 0\.0004"):
        gbid.save_controller(path, tuned, sample_time=2e-4)
    saved = gbid.save_controller(path, tuned)
    assert (saved.sample_time, saved.gains, saved.structure) == (4e-4, dict(tuned.gains), tuned.controller)
    assert saved.provenance["status"] == "optimal"
    assert gbid.load_controller(path).sample_time == 4e-4
    assert chain_of(tuned, name="damper", options=ChainOptions(stroke_m=45e-6, disc_limit_m=2e-5)).sample_time == 4e-4
    continuous = gbid.tune(model, operating_points=[(6, 0)])
    with pytest.raises(UsageError, match="give sample_time"):
        gbid.save_controller(tmp_path / "c.yaml", continuous)
    assert gbid.save_controller(tmp_path / "c.yaml", continuous, sample_time=5e-4).sample_time == 5e-4


def ended(result: gbid.GainResult) -> object:
    """Save the result of a search that found nothing stable."""
    return replace(result, status=GainStatus.NO_STABILISING_GAINS).design()
