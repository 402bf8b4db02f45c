"""`gbid export --to c`: from an experiment to the files of the box by one command, and what it refuses."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chain_cases import BIQUAD, design, runout_map
from experiment_files import gbid as run
from experiment_files import json_of, printed_by
from figure_cases import BlankPictures
from places import ROOT, SUPPORT
from target_files import write_box

import gbid
from gbid.control import ControllerDesign, controller_structure
from gbid.core.errors import DataError, UsageError
from gbid.export.chain import ChainOptions, c_comment, chain_of
from gbid.export.chain_c import CompiledChain, write_chain
from gbid.lpv import Domain
from gbid.online.grid import table_over_domain
from gbid.recording import Recording
from gbid.report import write as report_file
from gbid.structure import LinearModel


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_box(tmp_path_factory.mktemp("box"), "target: {number: float, disc_limit_m: 15.0e-6, ramp_s: 0.1}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_file, "Pictures", BlankPictures)
        assert run("run", path) == 0
    return path


def test_one_command_writes_the_chain_of_an_experiment(box: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [Path(name) for name in json_of(capsys, "export", box, "--to", "c")["files"]]
    endings = (".h", ".c", "_selftest.c", "_notes.md", ".mk", ".sha256")
    assert [file.name for file in files] == [f"controller_feedback{ending}" for ending in endings]
    assert run("export", box, "--to", "c") == 0  # the same command again finds its files
    header = files[0].read_text()
    assert "with the run-out map of: p6_n3000_still" in header
    assert "typedef float controller_feedback_real;" in header
    assert "run-out, unbalance response and offset taken out" in header
    notes = files[3].read_text()
    assert "3 samples in a row beyond 1.5e-05 m: fault 4" in notes
    assert "ramp of 0.1 s" in notes
    assert "at 6 bar, 3000 rpm" in notes
    double = ("export", box, "--to", "c", "--number", "double")
    assert "exists already" in printed_by(capsys, *double, code=2).err
    assert run(*double, "--overwrite") == 0
    assert "typedef double controller_feedback_real;" in files[0].read_text()


def test_at_chooses_the_map(box: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("export", box, "--to", "c", "--at", 6, 3000, "--output", tmp_path) == 0
    printed = printed_by(capsys, "export", box, "--to", "c", "--at", 5, 3000, "--output", tmp_path / "other", code=2)
    assert "no run-out map at this operating point; there are maps at 6 bar" in printed.err


def test_a_target_section_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for section, words in (
        ("target: {limit_m: 30.0e-6}", "limit_m = 3e-05 m around offset_m = 2.25e-05 m leaves the stroke"),
        ("target: {median: 2}", "median"),
        ("controller: compiled", "there is no section impacts; add it or remove this"),
        ("target: {limits: 1}", "limits"),
        ("target: {bad_samples: 40000}", "bad_samples: must be at most 30000, found 40000"),
    ):
        path = write_box(tmp_path, section + "\n")
        if section.startswith("controller"):
            path = write_box(tmp_path, **{"  duration_s": f"  {section}\n  duration_s"})
        assert words in printed_by(capsys, "check", path, code=2).err


def unstable() -> ControllerDesign:
    one = np.eye(2)
    model = LinearModel(one * 50.0, one, one, one * 0, input_names=("p_x", "p_y"), output_names=("r_x", "r_y"))
    return ControllerDesign("wild", None, {}, 2e-4, models={None: model})


def test_controllers_that_cannot_run() -> None:
    with pytest.raises(UsageError, match=r"'wild' is unstable by itself .a pole of magnitude 1.01005 in the z plane"):
        chain_of(unstable())
    slow = replace(design("P"), sample_time=2e-3)
    with pytest.raises(UsageError, match=r"sample_time = 0.002 s is too slow for its pole at 1000 Hz; at most 0.0005"):
        chain_of(slow)
    one = LinearModel(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1), input_names=("p",), output_names=("r",)
    )
    with pytest.raises(UsageError, match=r"1 inputs .p. and 1 outputs .r., the four stacks 2 and 2; give limits"):
        chain_of(ControllerDesign("one", None, {}, models={None: one}, sample_time=2e-4))
    model = design("P").at()
    points = {(3.0, 0.0): model, (5.0, 0.0): model, (3.0, 6000.0): model}
    with pytest.raises(UsageError, match="no full grid, 5 bar, 6000 rpm is missing"):
        chain_of(ControllerDesign("three", None, {}, models=points, sample_time=2e-4))


@pytest.mark.parametrize("name", ["two words", "9lives", "a-b", "", "int", "x" * 51, "a\nb", "a*/b", "grün"])
def test_names_that_are_no_identifiers(name: str) -> None:
    with pytest.raises(UsageError, match="is no C identifier; use letters, digits"):
        chain_of(replace(design("P"), name=name))


def test_free_texts_cannot_leave_their_comment(tmp_path: Path) -> None:
    wild = "evil */ int x; /* \n #define a \\ ??/ \u00e4 **/ //*/"
    assert c_comment(wild).isascii()
    assert not any(mark in c_comment(wild) for mark in ("*/", "/*", "\n", "\\", "??"))
    map_ = replace(runout_map(), sources=(wild,))
    chain = chain_of(
        replace(design("P"), plant=wild),
        name="damper",
        runout_maps=[map_],
        options=ChainOptions(stroke_m=45e-6, disc_limit_m=20e-6),
    )
    chain = replace(chain, notes=(wild,))
    write_chain(chain, tmp_path)
    if shutil.which("cc"):
        CompiledChain(chain)
    assert "int x" in (tmp_path / "damper.h").read_text().split("*/", 2)[1]


def test_maps_that_do_not_fit() -> None:
    three = replace(runout_map(), channels=("x", "y", "z"))
    with pytest.raises(UsageError, match="has 3 channels, the controller 2; it is of other sensors"):
        chain_of(design("P"), runout_maps=[three])
    broken = replace(runout_map(), mean=np.array([np.nan, 0.0]))
    with pytest.raises(UsageError, match="not finite; make it again"):
        chain_of(design("P"), runout_maps=[broken])
    with pytest.raises(UsageError, match="tables over the angle, which are not interpolated"):
        chain_of(design("P"), runout_maps=[runout_map("bins"), runout_map("bins", speed=4000.0)])
    with pytest.raises(UsageError, match="two run-out maps at 6 bar, 6000 rpm"):
        chain_of(design("P"), runout_maps=[runout_map(), runout_map()])


def test_a_map_of_another_encoder_is_refused() -> None:
    rng, n = np.random.default_rng(2), 10000
    phi = np.mod(np.arange(n) * 2e-4 * 2 * np.pi * 100.0, 2 * np.pi)
    map_ = replace(runout_map(), rms_after=np.full(2, 3e-8))
    for turned, fits in ((0.0, True), (0.9, False)):
        p = map_.evaluate(phi + turned) + 3e-8 * rng.standard_normal((n, 2))
        still = Recording({"p": p, "phi": phi[:, None]}, 2e-4, conditions={"speed_rpm": 6000.0}, name="still")
        still = replace(still, channels={**still.channels, "p": map_.channels})
        if fits:
            assert chain_of(design("P"), runout_maps=[map_], still=[still]).maps
        else:
            with pytest.raises(DataError, match=r"rotated by 51.*the encoder missed its index"):
                chain_of(design("P"), runout_maps=[map_], still=[still])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limit_m": 0.0}, "limit_m = 0.0; give a number above 0"),
        ({"number": "half"}, "choose 'double' or 'float'"),
        ({"median": 5}, "median = 5; give 1 or 3"),
        ({"zero_m": (0.0, float("nan"))}, r"zero_m\[1\] = nan; give a number"),
        ({"spike_limit_m": -1.0}, "give a number above 0"),
        ({"stuck_samples": 30001}, "of at least 1 and of at most 30000"),
    ],
)
def test_options_without_a_meaning(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ChainOptions(**options)  # type: ignore[arg-type]


def test_without_a_compiler_the_compiled_chain_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    from gbid.core import compiled as compiler
    from gbid.core.compiled import load_library

    monkeypatch.setenv("CC", "no-such-compiler")
    compiler.find_compiler.cache_clear()
    load_library.cache_clear()
    try:
        with pytest.raises(UsageError, match=r"no C compiler found .no-such-compiler.*install one"):
            CompiledChain(chain_of(design("P")))
    finally:
        monkeypatch.undo()
        compiler.find_compiler.cache_clear()


def test_a_controller_file_has_no_map_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "damper.yaml"
    options = {"name": "damper", "sample_time": 2e-4}
    gbid.save_controller(path, controller_structure("biquad"), BIQUAD, **options)
    assert "give stroke_m and disc_limit_m" in printed_by(capsys, "export", path, "--to", "c", code=2).err
    known = {"piezo_travel_m": 38e-6, "clearance_m": 40e-6}
    gbid.save_controller(path, controller_structure("biquad"), BIQUAD, **options, provenance=known, overwrite=True)
    assert run("export", path, "--to", "c", "--output", tmp_path) == 0
    header = (tmp_path / "controller_damper.h").read_text()
    assert "it holds no run-out map. A shaft that turns needs one." in header
    notes = (tmp_path / "controller_damper_notes.md").read_text()
    assert "1.9e-05 m at rest, within 0 and 3.8e-05 m" in notes
    assert "beyond 3.2e-05 m" in notes


TOOLS = pytest.mark.skipif(not (shutil.which("cc") and shutil.which("make")), reason="no C compiler and make here")


KILLED = """
import os, signal, sys
from pathlib import Path
from chain_cases import design
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import write_chain

folder, survivors, replaced, replace = Path(sys.argv[1]), int(sys.argv[2]), [], Path.replace

def dying(self, target):
    if self.suffix != ".part" and target.parent == folder:
        if len(replaced) == survivors:
            os.kill(os.getpid(), signal.SIGKILL)
        replaced.append(target.name)
    return replace(self, target)

Path.replace = dying
write_chain(chain_of(design("P"), name="damper", options=ChainOptions(ramp_s=0.2)), folder, overwrite=True)
"""


@TOOLS
@pytest.mark.parametrize("survivors", [0, 1, 3])
def test_a_killed_export_leaves_no_set_that_can_be_built(survivors: int, tmp_path: Path) -> None:
    """SIGKILL between two renames: neither make nor the compiler takes old and new; the same command goes on."""
    first, second = (chain_of(design("P"), name="damper", options=ChainOptions(ramp_s=ramp)) for ramp in (0.1, 0.2))
    write_chain(first, tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    folders = os.pathsep.join((str(ROOT), str(SUPPORT)))
    killed = [sys.executable, "-c", KILLED, str(tmp_path), str(survivors)]
    run = subprocess.run(killed, env={**os.environ, "PYTHONPATH": folders}, check=False)
    assert run.returncode == -signal.SIGKILL
    changed = [name for name, content in before.items() if (tmp_path / name).read_bytes() != content]
    assert len(changed) == survivors
    assert built(tmp_path) == (survivors == 0)
    compiled = subprocess.run(["cc", "-std=c99", "-c", "damper.c"], cwd=tmp_path, capture_output=True, check=False)
    assert (compiled.returncode == 0) == (survivors != 1)
    write_chain(second, tmp_path, overwrite=True)
    assert not list(tmp_path.glob(".*"))
    assert built(tmp_path)


@TOOLS
def test_an_export_goes_on_where_it_was_killed(tmp_path: Path) -> None:
    chain = chain_of(design("P"), name="damper")
    files = write_chain(chain, tmp_path / "new")
    for file in files[::2]:
        file.unlink()
    kept = files[1].stat().st_mtime_ns
    assert not built(tmp_path / "new")
    assert write_chain(chain, tmp_path / "new") == files
    assert files[1].stat().st_mtime_ns == kept
    assert built(tmp_path / "new")
    files[1].write_text(files[1].read_text() + "/* mine */\n")
    files[0].unlink()
    with pytest.raises(UsageError, match=r"damper\.c exists already"):
        write_chain(chain, tmp_path / "new")
    assert not files[0].exists()


def built(folder: Path) -> bool:
    return subprocess.run(["make", "-f", "damper.mk"], cwd=folder, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize(("bend", "nodes"), [(0.0, 2), (0.02, 5), (5.0, 9)])
def test_a_table_over_a_rectangle_has_the_nodes_that_its_interpolation_needs(bend, nodes):
    """A straight line between nodes h apart misses a parabola by its second derivative times h^2 / 8."""

    def row_at(pressure: float, speed: float) -> list[float]:
        return [1.0 + bend * ((pressure - 3.0) / 4.0) ** 2, 2.0 + speed / 6000.0]

    table = table_over_domain(row_at, Domain((3, 7), (0, 6000)))
    assert tuple(map(len, table.axes.values())) == (nodes, 2)
    off = 2 * bend / (nodes - 1) ** 2 / 8 / (1 + bend)
    assert table.error == pytest.approx(off, abs=1e-12)
    places = [(p, s) for p in np.linspace(3, 7, 17) for s in (0.0, 1234.0, 6000.0)]
    missed = np.abs([np.subtract(table.row(p, s), row_at(p, s)) for p, s in places]) / [1 + bend, 3.0]
    assert missed.max() <= table.error + 1e-12
    assert missed.max() >= 0.99 * off


def test_a_table_over_one_pressure_is_a_line_over_the_speeds():
    table = table_over_domain(lambda p, s: [p + s / 6000.0], Domain((5, 5), (0, 6000)))
    assert table.row(5.0, 1500.0) == pytest.approx([5.25])
    assert len(table.rows) == 4
    assert len(table_over_domain(lambda p, s: [p + s], Domain((5, 5), (60, 60))).rows) == 1
