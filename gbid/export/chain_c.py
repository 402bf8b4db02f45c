"""C source of a control chain from templates."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined

from gbid._version import __version__
from gbid.core.arrays import FloatArray
from gbid.core.compiled import CompilerMissingError, load_library
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path, with_text_checksum
from gbid.core.names import given_path
from gbid.export.chain import Chain, c_comment, c_number, inverse_widths
from gbid.export.chain_python import (
    FLOAT_TOLERANCE,
    ChainFault,
    ChainInput,
    ChainMode,
    ChainOutput,
    SelfTestRow,
    selftest_rows,
)
from gbid.prefilter.runout import COSINE, QUARTER, QUARTERS_PER_RADIAN, SINE, TURN, RunoutMap

_BYTES = {"double": 8, "float": 4}
_FLOAT_QUARTER = (1.5703125, 4.8351287841796875e-4, 3.1385570764541626e-7)
"""A quarter turn as a sum of parts of 11 bits and the rest, for numbers of type float."""
_FLOAT_SINE = (-0.16666666641626524, 0.008333329385889463, -0.00019839334836096632, 2.718311493989822e-06)
_FLOAT_COSINE = (0.04166662332373906, -0.001388676377460993, 2.439044879627741e-05)


def render_source(template: str, chain: Chain, **further: Any) -> str:
    """Return a file of the generated source.

    Parameters
    ----------
    template : str
        Name of the template, as ``chain.c.j2``.
    chain : Chain
        The chain.
    **further
        Further values for the template.

    Returns
    -------
    str
        The text, in ASCII.
    """
    number = chain.options.number
    environment = Environment(
        loader=FunctionLoader(_read), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, autoescape=False
    )
    environment.filters["number"] = lambda value: c_number(value, number)
    environment.filters["comment"] = c_comment
    environment.filters["inverse"] = inverse_widths
    text = environment.get_template(template).render(**_values(chain), **further)
    return text.rstrip("\n") + "\n"


def _read(name: str) -> str:
    return files(__package__).joinpath("templates", name).read_text(encoding="utf-8")


def _values(chain: Chain) -> dict[str, Any]:
    """Return the values that all templates know."""
    number = chain.options.number
    scheduled = [("controller", chain.controller), ("map", chain.harmonics)]
    harmonics_rows = [] if chain.harmonics is None else chain.harmonics.rows.tolist()
    controller_rows = chain.controller.rows.tolist()
    bins = None if chain.bins is None else _bins(chain.bins)
    return {
        "chain": chain,
        "name": chain.name,
        "NAME": chain.name.upper(),
        "options": chain.options,
        "title": c_comment(chain.title),
        "version": __version__,
        "key": chain.content_key,
        "rate": f"{1 / chain.sample_time:g}",
        "sources": c_comment(", ".join(source for each in chain.maps for source in each.sources)),
        "n_states": len(chain.states),
        "n_entries": chain.controller.rows.shape[1],
        "n_orders": chain.n_orders,
        "controller_rows": controller_rows,
        "controller_scheduled": chain.controller.is_scheduled,
        "harmonics_rows": harmonics_rows,
        "harmonics_scheduled": chain.harmonics is not None and chain.harmonics.is_scheduled,
        "schedules": [(name, table) for name, table in scheduled if table is not None and table.is_scheduled],
        "bins": bins,
        "turn": TURN,
        "bounds": chain.point_bounds,
        "steps": chain.point_steps,
        "uses_angle_sums": chain.n_orders > 0,
        "trig": _trigonometry(number),
        "state_bytes": _state_bytes(chain),
        "table_bytes": _BYTES[number] * _table_numbers(chain, bins),
    }


def _trigonometry(number: str) -> dict[str, Any]:
    """Return the constants of cosine and sine and their polynomials as C expressions."""
    double = number == "double"
    parts = QUARTER if double else _FLOAT_QUARTER
    rest = "angle"
    for part in parts:
        rest = f"({rest} - (n * {c_number(part, number)}))"
    sine, cosine = (SINE, COSINE) if double else (_FLOAT_SINE, _FLOAT_COSINE)
    return {
        "per_radian": QUARTERS_PER_RADIAN,
        "rest": rest,
        "sine_poly": _horner(sine, number),
        "cosine_poly": _horner(cosine, number),
    }


def _horner(coefficients: Sequence[float], number: str) -> str:
    text = c_number(coefficients[-1], number)
    for coefficient in coefficients[-2::-1]:
        text = f"({c_number(coefficient, number)} + (z * {text}))"
    return text


def _bins(runout_map: RunoutMap) -> dict[str, Any]:
    """Return the table over the angle, continued by a node at each end, with its slopes, as `numpy.interp` has them."""
    angles = np.concatenate([runout_map.angles[-1:] - TURN, runout_map.angles, runout_map.angles[:1] + TURN])
    values: FloatArray = np.vstack([runout_map.table[-1:], runout_map.table, runout_map.table[:1]])
    slopes = np.diff(values, axis=0) / np.diff(angles)[:, None]
    step = 1
    while 2 * step < len(angles):
        step *= 2
    return {
        "angle": angles.tolist(),
        "value": values.tolist(),
        "slope": slopes.tolist(),
        "mean": runout_map.mean.tolist(),
        "first_step": step,
    }


def _table_numbers(chain: Chain, bins: dict[str, Any] | None) -> int:
    tables = [t for t in (chain.controller, chain.harmonics) if t is not None]
    numbers = sum(t.rows.size + 2 * (len(t.pressure_bar) + len(t.speed_rpm)) - 2 * t.is_scheduled for t in tables)
    if bins is not None:
        numbers += 5 * len(bins["angle"])
    return int(numbers)


def _state_bytes(chain: Chain) -> int:
    """Return the size of the state struct: numbers first, then 32-bit integers, filled up to whole numbers."""
    size = _BYTES[chain.options.number]
    numbers = max(len(chain.states), 1) + 2 + 3 + 4 + 4 + 2
    return size * (numbers + -(-4 * 12 // size))


# ---- Control chain as compiled C in this process: software in the loop.

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-w")
"""As on the target: sums keep their order, and products are not fused with sums."""
_WIDTH_IN, _WIDTH_OUT = 6, 10


class CompiledChain:
    """Control chain that runs as compiled C; a `gbid.export.PythonChain` with the same methods.

    Parameters
    ----------
    chain : Chain
        The chain; the source is that of ``gbid export --to c`` with its type of numbers.

    Raises
    ------
    UsageError
        When there is no C compiler.
    """

    def __init__(self, chain: Chain) -> None:
        plain = replace(chain, name="chain")
        header, body = render_source("chain.h.j2", plain, measured=()), render_source("chain.c.j2", plain)
        source = header + body.replace('#include "chain.h"\n', "") + render_source("chain_run.c.j2", plain)
        try:
            self._library = load_library(source, FLAGS)
        except CompilerMissingError as missing:
            raise UsageError(
                f"the compiled chain {chain.name!r} needs a C compiler: {missing}; install one (gcc or clang), set CC, "
                "or run the chain in Python (gbid.export.PythonChain; rig: controller: python)"
            ) from None
        self._library.chain_state_bytes.restype = ctypes.c_long
        self.state_bytes = int(self._library.chain_state_bytes())
        self._state = ctypes.create_string_buffer(self.state_bytes)
        self.start()

    def start(self) -> None:
        """Reset to rest."""
        self._library.chain_start(self._state)

    def run(self, inputs: Sequence[ChainInput]) -> list[ChainOutput]:
        """Return the outputs of several samples.

        Parameters
        ----------
        inputs : sequence of ChainInput
            The samples.
        """
        rows = np.array([(*u.position, u.angle, u.pressure_bar, u.speed_rpm, u.mode) for u in inputs], float)
        return [_output(row) for row in self._run(rows.reshape(-1, _WIDTH_IN))]

    def step(self, given: ChainInput) -> ChainOutput:
        """Return the output of one sample.

        Parameters
        ----------
        given : ChainInput
            The sample.
        """
        return self.run([given])[0]

    def references(self, position: FloatArray, angle: float, pressure_bar: float, speed_rpm: float) -> FloatArray:
        """Return r_x, r_y of one sample in mode CONTROL, shape (2,) [m].

        Parameters
        ----------
        position : (2,) array
            p_x, p_y as measured [m].
        angle : float
            Shaft angle [rad].
        pressure_bar, speed_rpm : float
            Operating point [bar], [rpm].
        """
        row = np.array([[*position, angle, pressure_bar, speed_rpm, ChainMode.CONTROL]], float)
        return self._run(row)[0, 4:6]

    def _run(self, rows: FloatArray) -> FloatArray:
        rows = np.ascontiguousarray(rows)
        found = np.empty((len(rows), _WIDTH_OUT))
        self._library.chain_run(
            ctypes.c_long(len(rows)), ctypes.c_void_p(rows.ctypes.data), ctypes.c_void_p(found.ctypes.data), self._state
        )
        return found


def _output(row: FloatArray) -> ChainOutput:
    values = [float(v) for v in row]
    status = int(values[9])
    return ChainOutput(
        tuple(values[:4]),
        tuple(values[4:6]),
        tuple(values[6:8]),
        ChainFault(int(values[8])),
        bool(status & 1),
        bool(status & 2),
    )


# ---- A chain on an emulated microcontroller: it is cross-compiled, tested there, and its instructions are counted.

COMPILER, EMULATOR, SIZE = "arm-none-eabi-gcc", "qemu-system-arm", "arm-none-eabi-size"
FLAGS_EMULATED = (
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
        _called(folder, COMPILER, *FLAGS_EMULATED, "-c", f"{name}.c", "-o", "chain.o")
        sources = ("chain.o", f"{name}_selftest.c", "harness.c")
        _called(folder, COMPILER, *FLAGS_EMULATED, "-nostdlib", "-T", "board.ld", *sources, "-lgcc", "-o", "chain.elf")
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


# ---- Files of a control chain: C source, header, self-test, S-function and notes.

_FILES = {
    ".h": "chain.h.j2",
    ".c": "chain.c.j2",
    "_selftest.c": "chain_selftest.c.j2",
    "_sfun.c": "chain_sfun.c.j2",
    "_notes.md": "chain_notes.md.j2",
}
_UNMEASURED = "Instructions per sample: not counted (gbid export --measure counts them on an emulated Cortex-M4F)."


def write_chain(chain: Chain, folder: str | Path, *, measure: bool = False, overwrite: bool = False) -> list[Path]:
    """Write a control chain as C source, and return the paths of the files.

    Parameters
    ----------
    chain : Chain
        The chain, from `chain_of`.
    folder : str or path
        Folder of the files. Their names begin with the name of the chain.
    measure : bool
        Whether the source is compiled for a Cortex-M4F and run under an emulator: then the header has the instructions
        per sample. It needs arm-none-eabi-gcc and qemu-system-arm.
    overwrite : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of pathlib.Path
        Header, source, self-test, S-function and notes.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, or when a program is missing for `measure`.
    DataError
        When a file cannot be written.
    """
    folder = given_path(folder)
    paths = {folder / f"{chain.name}{ending}": template for ending, template in _FILES.items()}
    for path in paths:
        if path.exists() and not overwrite:
            raise UsageError(f"{path} exists already; choose another name or ask for overwriting")
    rows = selftest_rows(chain)
    measured: tuple[str, ...] = (_UNMEASURED,)
    if measure:
        run = run_emulated(chain, rows)
        if run.wrong_row:
            raise UsageError(
                f"chain {chain.name!r}: row {run.wrong_row} of its self-test differs on the emulated Cortex-M4F; "
                "please report it"
            )
        measured = run.lines()
    for path, template in paths.items():
        text = render_source(
            template,
            chain,
            rows=rows,
            n_rows=len(rows),
            tolerance=FLOAT_TOLERANCE * chain.options.limit_m,
            measured=measured,
            conditions=_conditions(chain),
        )
        with atomic_path(path, overwrite) as part:
            part.write_bytes(with_text_checksum(text, path.suffix).encode("ascii"))
    return list(paths)


def _conditions(chain: Chain) -> str:
    """Return the operating points of the maps in words."""
    points = [each.conditions for each in chain.maps]
    words = [
        ", ".join(f"{c[key]:g} {unit}" for key, unit in (("pressure_bar", "bar"), ("speed_rpm", "rpm")) if key in c)
        for c in points
    ]
    return " and at ".join(word for word in words if word)
