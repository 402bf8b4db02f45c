"""Rows of the self-test of a generated chain: inputs, and what the chain in Python makes of them."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np

from gbid.target.chain import Chain
from gbid.target.python_chain import ChainInput, ChainMode, ChainOutput, PythonChain

FLOAT_TOLERANCE = 1e-3
"""Tolerance of the outputs in float, as a share of the limit of the references."""
_TURN_IN = 40
"""Repetitions after which the angle of a row begins again."""


@dataclass(frozen=True)
class SelfTestRow:
    """Input that is repeated, and the output after the last repetition.

    Attributes
    ----------
    given : tuple of float
        p_x, p_y [m], phi, its change per repetition [rad], pressure [bar], speed [rpm], dither of p [m].
    marks : tuple of int
        Mode, repetitions, whether p_x is not a number, fault, status.
    expected : tuple of float
        Stacks 1 to 4, r_x, r_y, e_x, e_y [m].
    """

    given: tuple[float, ...]
    marks: tuple[int, ...]
    expected: tuple[float, ...]


@dataclass(frozen=True)
class _Drive:
    position: tuple[float, float] = (0.0, 0.0)
    mode: ChainMode = ChainMode.CONTROL
    repeat: int = 1
    faulty: bool = False
    dither: float = 1e-8


def selftest_rows(chain: Chain, seed: int = 1) -> tuple[SelfTestRow, ...]:
    """Return the rows of the self-test.

    They start the chain, fade the control in, move the disc at random while pressure and speed change, show it a spike,
    a number that is none, a saturating position, a disc beyond the limit, a stuck sensor and the end of the control.

    Parameters
    ----------
    chain : Chain
        The chain.
    seed : int
        Seed of the random positions.

    Returns
    -------
    tuple of SelfTestRow
    """
    random = np.random.default_rng(seed)
    twin, rows = PythonChain(chain), []
    single = chain.options.number == "float"
    bounds = chain.point_bounds
    for drive in _drives(chain, random):
        point = [float(random.uniform(*bound)) for bound in bounds]
        angle = float(random.uniform(-1.0, 4.0))
        values = (*drive.position, angle, 0.05, *point, drive.dither)
        given = tuple(float(np.float32(v)) if single else v for v in values)
        output = _repeated(twin, given, drive)
        status = int(output.held) + 2 * int(output.saturated)
        rows.append(
            SelfTestRow(
                given,
                (int(drive.mode), drive.repeat, int(drive.faulty), int(output.fault), status),
                (*output.stack, *output.reference, *output.deviation),
            )
        )
    return tuple(rows)


def _drives(chain: Chain, random: np.random.Generator) -> list[_Drive]:
    options = chain.options
    mean = np.zeros(2) if not chain.maps else np.mean([each.mean for each in chain.maps], axis=0)
    zero = mean + np.array(options.zero_m)

    def at(x: float, y: float, **further: object) -> _Drive:
        return _Drive((float(zero[0] + x), float(zero[1] + y)), **further)  # type: ignore[arg-type]  # fields of _Drive

    moves = 0.25 * options.disc_limit_m * np.cumsum(random.normal(size=(40, 2)) * 0.15, axis=0)
    moving = [at(*move) for move in moves]
    edge = 0.6 * options.disc_limit_m
    return [
        at(0, 0, mode=ChainMode.OFFSET, repeat=chain.ramp_samples + 5),
        at(0, 0, repeat=chain.fade_samples + 5),
        *moving[:20],
        at(2e-5, 0),
        *moving[20:25],
        at(0, 0, faulty=True, repeat=max(options.bad_samples - 1, 1)),
        *moving[25:],
        *(at(edge * np.cos(0.4 * k), edge * np.sin(0.4 * k)) for k in range(12)),
        *(at(3 * edge, 0) for _ in range(options.beyond_samples + 4)),
        at(0, 0, mode=ChainMode.OFFSET, repeat=20),
        at(0, 0, repeat=30),
        at(1e-6, 1e-6, dither=0.0, repeat=options.stuck_samples + 3),
        at(0, 0, mode=ChainMode.OFFSET, repeat=20),
        at(0, 0, faulty=True, repeat=options.bad_samples + 1),
        at(0, 0, mode=ChainMode.OFF, repeat=600),
    ]


def _repeated(twin: PythonChain, given: tuple[float, ...], drive: _Drive) -> ChainOutput:
    """Return the output after the repetitions of a row, by the operations of the C self-test."""
    x, y, angle, turn, pressure, speed, dither = given
    for k in range(drive.repeat):
        moved = dither if k % 2 else -dither
        output = twin.step(
            ChainInput(
                (nan if drive.faulty else x + moved, y + moved),
                angle + float(k % _TURN_IN) * turn,
                pressure,
                speed,
                drive.mode,
            )
        )
    return output
