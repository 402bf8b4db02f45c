"""Control chain as compiled C in this process: software in the loop."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.compiling import CompilerMissingError, load_library
from gbid.errors import UsageError
from gbid.target.chain import Chain
from gbid.target.python_chain import ChainFault, ChainInput, ChainMode, ChainOutput
from gbid.target.source import render_source

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-w")
"""As on the target: sums keep their order, and products are not fused with sums."""
_WIDTH_IN, _WIDTH_OUT = 6, 10


class CompiledChain:
    """Control chain that runs as compiled C; a `gbid.target.PythonChain` with the same methods.

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
                "or run the chain in Python (gbid.target.PythonChain; rig: controller: python)"
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
