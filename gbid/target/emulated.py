"""A chain on an emulated microcontroller: it is cross-compiled, tested there, and its instructions are counted."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from gbid.errors import UsageError
from gbid.target.chain import Chain
from gbid.target.selftest_rows import FLOAT_TOLERANCE, SelfTestRow
from gbid.target.source import render_source

COMPILER, EMULATOR, SIZE = "arm-none-eabi-gcc", "qemu-system-arm", "arm-none-eabi-size"
FLAGS = (
    *("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
    *("-std=c99", "-O2", "-ffp-contract=off", "-ffreestanding", "-fno-common"),
)
"""Flags for a Cortex-M4F: its unit computes in float; numbers of type double are computed by the library of gcc."""
CLOCK_HZ = 170e6
"""Clock for which a rate is computed."""
CYCLES_PER_INSTRUCTION = 2.0
"""Assumed mean of a Cortex-M4F with wait states of its flash; loads take two cycles, most others one."""
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

    @property
    def largest_rate_hz(self) -> float:
        """Rate that the instructions allow at `CLOCK_HZ` with `CYCLES_PER_INSTRUCTION`: computed, not measured."""
        return CLOCK_HZ / (CYCLES_PER_INSTRUCTION * max(self.instructions, self.faulty, self.saturated))

    def lines(self) -> tuple[str, ...]:
        """Return the lines of the header."""
        return (
            f"Cortex-M4F, gcc -O2, emulated: {self.instructions:.0f} instructions per sample ({self.faulty:.0f} for a "
            f"faulty one, {self.saturated:.0f} at the limits).",
            f"Code {self.code_bytes} bytes, constants {self.constant_bytes} bytes, state {self.state_bytes} bytes.",
            f"Largest rate at {CLOCK_HZ / 1e6:.0f} MHz, computed with {CYCLES_PER_INSTRUCTION:g} cycles per "
            f"instruction, not measured: {self.largest_rate_hz / 1e3:.0f} kHz.",
        )


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
    UsageError
        When a program is missing, or when it fails.
    """
    missing = missing_tools()
    if missing:
        raise UsageError(
            f"counting instructions needs {', '.join(missing)}; install gcc-arm-none-eabi and qemu-system-arm, or "
            "leave --measure out"
        )
    name = chain.name
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        tolerance = FLOAT_TOLERANCE * chain.options.limit_m
        for file, template in (
            (f"{name}.h", "chain.h.j2"),
            (f"{name}.c", "chain.c.j2"),
            (f"{name}_selftest.c", "chain_selftest.c.j2"),
            ("harness.c", "harness.c.j2"),
        ):
            text = render_source(template, chain, rows=rows, tolerance=tolerance, measured=())
            (folder / file).write_text(text, encoding="ascii")
        (folder / "board.ld").write_text(_LINKER, encoding="ascii")
        _called(folder, COMPILER, *FLAGS, "-c", f"{name}.c", "-o", "chain.o")
        sources = ("chain.o", f"{name}_selftest.c", "harness.c")
        _called(folder, COMPILER, *FLAGS, "-nostdlib", "-T", "board.ld", *sources, "-lgcc", "-o", "chain.elf")
        sections = _called(folder, SIZE, "-A", "chain.o")
        machine = ("-M", "mps2-an386", "-icount", "shift=0", "-nographic", "-monitor", "none", "-serial", "null")
        semihosting = ("-semihosting-config", "enable=on,target=native", "-kernel", "chain.elf")
        printed = _called(folder, EMULATOR, *machine, *semihosting)
    found = {word: int(number) for word, number in re.findall(r"^(\w+) (\d+)$", printed, re.MULTILINE)}
    sizes = {"text": 0, "rodata": 0}
    for word, number in re.findall(r"^\.(text|rodata)\S*\s+(\d+)", sections, re.MULTILINE):
        sizes[word] += int(number)
    each = {kind: (found[kind] - found["loop"]) * _PER_TICK / _SAMPLES for kind in ("usual", "faulty", "saturated")}
    return EmulatedRun(
        found["selftest"],
        found["state"],
        sizes["text"],
        sizes["rodata"],
        each["usual"],
        each["faulty"],
        each["saturated"],
    )


def _called(folder: Path, *command: str) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    except subprocess.TimeoutExpired:
        raise UsageError(f"{command[0]} did not end within 300 s") from None
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise UsageError(f"{command[0]} failed on the generated chain: {said}")
    return done.stdout + done.stderr
