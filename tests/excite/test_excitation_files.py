"""Excitations as files: written by the stage, read back exactly, refused when changed, played by the rig."""

import json
import math

import numpy as np
import pytest
from experiment_files import gbid, write_quick, write_spring
from rig_point import machine

from gbid.core.errors import DataError, UsageError
from gbid.excite import KnownModel, design_excitation, read_excitation, recording_length, save_excitation
from gbid.rig import Played, record
from gbid.structure import LinearStructure, Parameter

LAG = LinearStructure(
    "lag", [Parameter("a", 200.0), Parameter("b", 300.0)], lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1]]}
)
KNOWN = KnownModel(LAG, {}, 0.05)
LIMITS = {"u": 1.0}


def test_the_stage_writes_what_the_reader_reads(tmp_path, capsys):
    section = (
        "crossval:",
        "excite:\n  next: {fit: spring, duration_s: 1.0, focus: [d], limits: {peaks: {u: 0.5}}}\ncrossval:",
    )
    path = write_spring(tmp_path, section)
    assert gbid("import", path, "--quiet") == 0
    assert gbid("fit", path, "--quiet") == 0
    capsys.readouterr()
    assert gbid("excite", path, "--json", "--quiet") == 0
    rows = json.loads(capsys.readouterr().out)["excite"]
    assert [row["item"] for row in rows] == ["next/run1", "next/run2"]
    assert "limits reached: u" in rows[0]["text"]
    file = tmp_path / "results" / "spring" / "excite" / "next" / "run1.csv"
    played = read_excitation(file)
    assert played.sample_time == pytest.approx(5e-4)
    (u,) = played.columns.values()
    assert len(u) == 2000
    assert 0.48 < np.abs(u).max() <= 0.5
    assert gbid("excite", path) == 0, "kept, and the next step is named"
    text = file.read_text()
    file.write_text(text.replace("0.0005,", "0.0005,9", 1))
    with pytest.raises(DataError, match="changed after it was made"):
        read_excitation(file)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("fit: sprong", "no fit 'sprong'"),
        ("fit: spring, kind: chirp", "multisine"),
        ("fit: spring, focus: []", "focus"),
    ],
)
def test_mistakes_in_the_section_are_named(change, words, tmp_path, capsys):
    section = ("crossval:", f"excite:\n  next: {{{change}, limits: {{peaks: {{u: 0.5}}}}}}\ncrossval:")
    assert gbid("check", write_spring(tmp_path, section)) == 2
    assert words in capsys.readouterr().err


def test_the_rig_plays_a_signal_from_its_steady_state():
    """A period played and its next one are the same motion; the other sample time is refused."""
    time = np.arange(500) * 2e-4
    r = 2e-6 * np.column_stack([np.sin(2 * np.pi * 100 * time), np.cos(2 * np.pi * 100 * time)])
    conditions = {"pressure_bar": 5.0, "speed_rpm": 0.0}
    made = record(machine(5.0, 0.0), Played(np.tile(r, (2, 1)), 2e-4), conditions=conditions, seed=1, name="a")
    np.testing.assert_array_equal(made.signal("r"), np.tile(r, (2, 1)))
    p = made.signal("p")
    assert np.abs(p[:500] - p[500:]).max() < 8 * 30e-9, "noise of the sensor alone"
    assert len(json.loads(made.provenance["experiment"])["Played"]["sha256"]) == 64
    with pytest.raises(UsageError, match="design it for the sample time of the rig"):
        record(machine(5.0, 0.0), Played(r, 1e-4), conditions=conditions, seed=1, name="a")
    with pytest.raises(UsageError, match=r"\(n_samples, 2\)"):
        Played(r[:, 0], 2e-4)


def test_the_yaml_of_the_rig_names_a_file_to_play(tmp_path, capsys):
    lines = [f"{k * 2e-4!r},{1e-6 * math.sin(0.1 * k)!r},0.0" for k in range(500)]
    (tmp_path / "next.csv").write_text("\n".join(["time_s,r_x_m,r_y_m", *lines]))
    text = (
        "format: 1\nname: second\nrig:\n  operating_points: [{pressure_bar: 5.0, speed_rpm: 0}]\n"
        "  played: {file: next.csv}\n  prbs: {recordings: 0}\n  stationary: {recordings: 0}\n"
    )
    path = write_quick(tmp_path, text=text)
    gbid("rig", path, "--json", "--quiet")
    names = [row["name"] for row in json.loads(capsys.readouterr().out)["recordings"]]
    assert names == ["p5_n0_played1"]
    (tmp_path / "next.csv").write_text("time_s,u_m\n0,1\n0.0002,2\n0.0004,3\n")
    assert gbid("check", path) == 2
    assert "no column r_x_m" in capsys.readouterr().err


def test_a_longer_recording_reaches_the_target():
    """For the gain of a lag alone: the length falls out of the deviation of the result, and half of it misses."""
    length = recording_length(KNOWN, sample_time=1e-3, limits=LIMITS, relative={"b": 0.005, "a": 0.01})
    std = length.excitation.std
    assert std[length.decisive] <= length.targets[length.decisive]
    assert std[length.decisive] > 0.8 * length.targets[length.decisive]
    assert length.by_amplitude[0.5] == pytest.approx(4 * length.duration_s)
    half = design_excitation(
        KNOWN, duration=length.duration_s / 2, sample_time=1e-3, limits=LIMITS, focus=length.targets
    )
    assert max(half.std[name] / wanted for name, wanted in length.targets.items()) > 1.2
    with pytest.raises(UsageError, match="longer than longest_s"):
        recording_length(KNOWN, sample_time=1e-3, limits=LIMITS, absolute={"a": 1e-4})


def test_a_file_of_an_excitation_says_what_to_expect(tmp_path):
    made = design_excitation(KNOWN, duration=1.0, sample_time=1e-3, limits=LIMITS)
    path = save_excitation(made, tmp_path / "a.csv")
    assert f"a {made.std['a']:.3g}" in path.read_text()
    np.testing.assert_array_equal(read_excitation(path).columns["u"], made.signals["u"][:, 0])
    with pytest.raises(UsageError):
        save_excitation(made, path)
