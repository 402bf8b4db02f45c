"""A control chain, cross-compiled and run on an emulated Cortex-M4F (gcc-arm-none-eabi, qemu-system-arm)."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from gbid.export.chain import Chain
from gbid.export.chain_c import render_source
from gbid.export.chain_python import FLOAT_TOLERANCE, SelfTestRow

COMPILER, EMULATOR, SIZE = "arm-none-eabi-gcc", "qemu-system-arm", "arm-none-eabi-size"
FLAGS_EMULATED = (
    *("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
    *("-std=c99", "-O2", "-ffp-contract=off", "-ffreestanding", "-fno-common"),
)
"""Flags for a Cortex-M4F: its unit computes in float; numbers of type double are computed by the library of gcc."""
_SAMPLES = 4000
_PER_TICK = 40  # 25 MHz SysTick of the board, 1 ns per instruction
_LINKER = """\
MEMORY { code (rx) : ORIGIN = 0x00000000, LENGTH = 4M  ram (rw) : ORIGIN = 0x20000000, LENGTH = 4M }
SECTIONS {
  .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) *(.ARM.*) . = ALIGN(8); } > code
  data_from = LOADADDR(.data);
  .data : { data_to = .; *(.data*) . = ALIGN(8); data_end = .; } > ram AT > code
  .bss : { *(.bss*) *(COMMON) . = ALIGN(8); bss_end = .; } > ram
  stack_top = ORIGIN(ram) + LENGTH(ram);
}
ENTRY(start)
"""


@dataclass(frozen=True)
class EmulatedRun:
    """What a chain does on an emulated Cortex-M4F.

    Attributes
    ----------
    wrong_row : int
        0 when the self-test passed, else the first row that differs.
    state_bytes, code_bytes, constant_bytes : int
        Memory of the state, the code and the constant tables of the chain.
    instructions : float
        Instructions of one call of the step function for a usual sample.
    faulty, saturated : float
        The same for a sample that is not a number, and for one at the limits.
    """

    wrong_row: int
    state_bytes: int
    code_bytes: int
    constant_bytes: int
    instructions: float
    faulty: float
    saturated: float


def missing_tools() -> tuple[str, ...]:
    """Return the programs of the cross-compilation and emulation that are not installed."""
    return tuple(tool for tool in (COMPILER, SIZE, EMULATOR) if shutil.which(tool) is None)


def run_emulated(chain: Chain, rows: tuple[SelfTestRow, ...]) -> EmulatedRun:
    """Return what a chain does on an emulated Cortex-M4F (QEMU, board mps2-an386, one instruction per nanosecond).

    Parameters
    ----------
    chain : Chain
        The chain.
    rows : tuple of SelfTestRow
        Rows of the self-test.

    Raises
    ------
    RuntimeError
        When a program fails.
    """
    chain = replace(chain, name="chain")
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        tolerance = FLOAT_TOLERANCE * chain.options.limit_m
        for file, template in (
            ("chain.h", "chain.h.j2"),
            ("chain.c", "chain.c.j2"),
            ("chain_selftest.c", "chain_selftest.c.j2"),
        ):
            text = render_source(template, chain, rows=rows, tolerance=tolerance)
            (folder / file).write_text(text, encoding="ascii")
        (folder / "board.ld").write_text(_LINKER, encoding="ascii")
        _called(folder, COMPILER, *FLAGS_EMULATED, "-c", "chain.c", "-o", "chain.o")
        point = (
            f"-D{word}={bound[1]!r}"
            for word, bound in zip(("PRESSURE_BAR", "SPEED_RPM"), chain.point_bounds, strict=True)
        )
        sources = ("chain.o", "chain_selftest.c", str(Path(__file__).with_suffix(".c")), "-I.", *point)
        _called(folder, COMPILER, *FLAGS_EMULATED, "-nostdlib", "-T", "board.ld", *sources, "-lgcc", "-o", "chain.elf")
        sections = _called(folder, SIZE, "-A", "chain.o")
        machine = ("-M", "mps2-an386", "-icount", "shift=0", "-nographic", "-monitor", "none", "-serial", "null")
        semihosting = ("-semihosting-config", "enable=on,target=native", "-kernel", "chain.elf")
        printed = _called(folder, EMULATOR, *machine, *semihosting)
    results = {word: int(number) for word, number in re.findall(r"^(\w+) (\d+)$", printed, re.MULTILINE)}
    sizes = {"text": 0, "rodata": 0}
    for word, number in re.findall(r"^\.(text|rodata)\S*\s+(\d+)", sections, re.MULTILINE):
        sizes[word] += int(number)
    each = {kind: (results[kind] - results["loop"]) * _PER_TICK / _SAMPLES for kind in ("usual", "faulty", "saturated")}
    return EmulatedRun(
        results["selftest"],
        results["state"],
        sizes["text"],
        sizes["rodata"],
        each["usual"],
        each["faulty"],
        each["saturated"],
    )


def _called(folder: Path, *command: str) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise RuntimeError(f"{command[0]} failed on the generated chain: {said}")
    return done.stdout + done.stderr
