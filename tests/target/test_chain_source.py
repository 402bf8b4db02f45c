"""The generated source: compilers, sanitizers, MISRA checker, and an emulated microcontroller."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from chain_cases import KINDS, design, grid_of_maps, runout_map
from emulated_chain import missing_tools, run_emulated

from gbid.export.chain import Chain, ChainOptions, chain_of
from gbid.export.chain_c import write_chain
from gbid.export.chain_python import selftest_rows

COMPILERS = ("gcc", "clang")
WARNINGS = ("all", "extra", "conversion", "double-promotion", "shadow", "undef", "error")
STRICT = ["-std=c99", "-O2", "-pedantic", *(f"-W{word}" for word in WARNINGS)]
DEVIATIONS = {
    "2.5": "macros of modes and status are for the program that calls the chain",
    "8.9": "tables stand together at the top of the file, not within the only function that uses each",
    "12.1": "the checker asks for a cast around sums in a conditional expression",
}
"""Advisory rules of MISRA C:2012 from which the source deviates, and why."""


def compiler(name: str) -> str:
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not installed")
    return name


def written(folder: Path, kind: str = "biquad", number: str = "double", maps: str = "harmonics", **further) -> Chain:
    computed = {"none": (), "harmonics": (runout_map(),), "bins": (runout_map("bins"),), "grid": grid_of_maps()}[maps]
    options = ChainOptions(number=number, ramp_s=0.1, fade_s=0.05, **further)  # type: ignore[arg-type]
    chain = chain_of(design(kind), runout_maps=computed, options=options)
    write_chain(chain, folder)
    return chain


def done(*command: object, folder: Path) -> str:
    ran = subprocess.run([str(c) for c in command], cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr + ran.stdout
    return ran.stdout + ran.stderr


@pytest.mark.parametrize("name", COMPILERS)
@pytest.mark.parametrize(
    ("kind", "number", "maps", "further"),
    [
        ("P", "float", "none", {}),
        ("P", "double", "grid", {"median": 3}),
        ("biquad", "float", "harmonics", {"spike_limit_m": None}),
        ("scheduled", "double", "bins", {"zero_m": (1e-7, -2e-7)}),
    ],
)
def test_compilers_have_nothing_to_say_and_the_self_test_passes(
    name: str, kind: str, number: str, maps: str, further: dict[str, object], tmp_path: Path
) -> None:
    cc = compiler(name)
    written(tmp_path, kind, number, maps, **further)
    done(cc, *STRICT, "-ffreestanding", "-c", "damper.c", folder=tmp_path)
    for optimise in ("-O0", "-O3"):
        flags = [*STRICT, optimise, "-ffp-contract=off", "-DDAMPER_SELFTEST_MAIN"]
        done(cc, *flags, "damper.c", "damper_selftest.c", "-o", "selftest", folder=tmp_path)
        assert "rows agree" in done("./selftest", folder=tmp_path)


@pytest.mark.parametrize("name", COMPILERS)
def test_address_and_undefined_behaviour_sanitizers_find_nothing(name: str, tmp_path: Path) -> None:
    cc = compiler(name)
    flags = ["-std=c99", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
    (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
    empty = [cc, *flags, "empty.c", "-o", "empty"]
    if subprocess.run(empty, cwd=tmp_path, capture_output=True, check=False).returncode:
        pytest.skip(f"{name} has no libraries of its sanitizers (compiler-rt, libasan)")
    written(tmp_path, "scheduled", "float", "grid", median=3)
    done(cc, *flags, "-DDAMPER_SELFTEST_MAIN", "damper.c", "damper_selftest.c", "-o", "selftest", folder=tmp_path)
    assert "rows agree" in done("./selftest", folder=tmp_path)


def test_the_self_test_fails_when_the_chain_is_changed(tmp_path: Path) -> None:
    cc = compiler("gcc")
    written(tmp_path)
    source = tmp_path / "damper.c"
    text = source.read_text()
    row = re.search(r"controller_table\[1\]\[\d+\] = \{\n    \{ ([\d.e-]+)", text)
    assert row is not None
    for old, new in (
        (row[1], repr(float(row[1]) * (1 + 1e-15))),  # a bit in a gain
        ("2.25e-05) - r[1]", "2.25e-05) + r[1]"),
        ("state->bad >= 5", "state->bad >= 6"),
        ("turned = (cos_n * cos_1) - (sin_n * sin_1)", "turned = (cos_n * cos_1) + (sin_n * sin_1)"),
    ):
        assert old in text
        source.write_text(text.replace(old, new, 1))
        flags = ("-std=c99", "-DDAMPER_SELFTEST_MAIN")
        done(cc, *flags, "damper.c", "damper_selftest.c", "-o", "selftest", folder=tmp_path)
        assert subprocess.run(["./selftest"], cwd=tmp_path, capture_output=True, check=False).returncode == 1, old


def test_the_self_test_in_float_fails_when_a_sign_is_changed(tmp_path: Path) -> None:
    cc = compiler("gcc")
    written(tmp_path, number="float")
    source = tmp_path / "damper.c"
    source.write_text(source.read_text().replace(") - r[1]", ") + r[1]", 1))
    done(cc, "-std=c99", "-DDAMPER_SELFTEST_MAIN", "damper.c", "damper_selftest.c", "-o", "selftest", folder=tmp_path)
    assert subprocess.run(["./selftest"], cwd=tmp_path, capture_output=True, check=False).returncode == 1


@pytest.mark.parametrize("kind", KINDS)
def test_misra_checker(kind: str, tmp_path: Path) -> None:
    if shutil.which("cppcheck") is None:
        pytest.skip("cppcheck is not installed")
    written(tmp_path, kind, "float", {"P": "bins", "biquad": "harmonics", "scheduled": "grid"}[kind], median=3)
    command = ["cppcheck", "--addon=misra", "--std=c99", "--enable=warning,style", "--inconclusive", "-q", "damper.c"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    if "Did not find addon" in ran.stdout + ran.stderr:
        pytest.skip("the misra addon of cppcheck is not installed")
    rules = set(re.findall(r"\[misra-c2012-([\d.]+)\]", ran.stderr))
    assert rules <= set(DEVIATIONS), ran.stderr
    assert "8.9" in rules  # the checker has looked
    others = [line for line in ran.stderr.splitlines() if re.search(r"\[(?!misra)\w+\]$", line)]
    assert others == []


@pytest.mark.skipif(bool(missing_tools()), reason=f"not installed: {', '.join(missing_tools())}")
@pytest.mark.parametrize(
    ("kind", "number", "most"),
    [("P", "float", 700), ("biquad", "float", 750), ("scheduled", "float", 1600), ("biquad", "double", 20000)],
)
def test_it_runs_on_an_emulated_cortex_m4f(kind: str, number: str, most: float) -> None:
    options = ChainOptions(number=number, ramp_s=0.1, fade_s=0.05)  # type: ignore[arg-type]
    chain = chain_of(design(kind), runout_maps=[runout_map()], options=options)
    run = run_emulated(chain, selftest_rows(chain))
    assert run.wrong_row == 0
    assert 300 < run.instructions < most
    if number == "float":
        assert abs(run.saturated - run.instructions) < 0.05 * run.instructions
        assert run.faulty < run.instructions
    assert run.code_bytes < 8000
