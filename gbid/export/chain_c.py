"""C source of a control chain from templates, compiled chain for software in the loop, and files for a target."""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gbid._version import __version__
from gbid.core.arrays import FloatArray
from gbid.core.compiled import CompilerMissingError, load_library
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path, atomic_set, with_text_checksum
from gbid.core.names import given_path
from gbid.export.chain import Chain, c_comment, c_number
from gbid.export.chain_python import (
    FLOAT_TOLERANCE,
    LARGEST_ANGLE,
    WHOLE_TURN,
    ChainFault,
    ChainInput,
    ChainMode,
    ChainOutput,
    selftest_rows,
)
from gbid.online.balance import NEAR_LIMIT, Balancing
from gbid.online.grid import GridTable, inverse_widths
from gbid.online.recursive import EXCITED, OUTLIER, PRIOR_UNBALANCE_M, SCALE_OF_MEAN, UNBALANCE
from gbid.prefilter.runout import COSINE, QUARTER, QUARTERS_PER_RADIAN, SINE, TURN, RunoutMap

_BYTES = {"double": 8, "float": 4}
_FLOAT_QUARTER = (1.5703125, 4.8351287841796875e-4, 3.1385570764541626e-7)
"""A quarter turn as a sum of parts of 11 bits and the rest, for numbers of type float."""
_FLOAT_SINE = (-0.16666666641626524, 0.008333329385889463, -0.00019839334836096632, 2.718311493989822e-06)
_FLOAT_COSINE = (0.04166662332373906, -0.001388676377460993, 2.439044879627741e-05)


def render_source(template: str, chain: Chain, **further: Any) -> str:
    """Return the text of a generated source file.

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
        loader=PackageLoader("gbid.export"), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["number"] = lambda value: c_number(value, number)
    environment.filters["comment"] = c_comment
    environment.filters["inverse"] = inverse_widths
    text = environment.get_template(template).render(**_values(chain), **further)
    return text.rstrip("\n") + "\n"


def _values(chain: Chain) -> dict[str, Any]:
    """Return the values that all templates need."""
    number = chain.options.number
    harmonics_rows = [] if chain.harmonics is None else chain.harmonics.rows.tolist()
    controller_rows = chain.controller.rows.tolist()
    bins, learning = None if chain.bins is None else _bins(chain.bins), _learning(chain)
    learned = learning["tables"] if learning else []
    waves = (3 if chain.balance else 1) * (len(chain.limits) + len(chain.input_names))
    return {
        "chain": chain,
        "name": chain.name,
        "NAME": chain.name.upper(),
        "options": chain.options,
        "n_in": len(chain.input_names),
        "n_out": len(chain.limits),
        "n_commands": len(chain.commands),
        "n_values": len(chain.commands) + waves + (3 * learning["n_all"] if learning else 0),
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
        "schedules": [(name, table, _corners(table, number)) for name, table in chain.schedules.items()],
        "bins": bins,
        "turn": TURN,
        "angle": {"per_turn": 1 / TURN, "turn": WHOLE_TURN, "largest": LARGEST_ANGLE},
        "point": [f"input->{name}" for name in chain.scheduling],
        "bounds": chain.point_bounds,
        "steps": chain.point_steps,
        "uses_angle_sums": chain.n_orders > 0 or chain.balance is not None or bool(learning and learning["unbalance"]),
        "balancing": _balancing(chain),
        "learning": learning,
        "trig": _trigonometry(number),
        "state_bytes": _state_bytes(chain),
        "table_bytes": _BYTES[number] * (_table_numbers(chain, bins) + sum(len(t) * len(t[0]) for _, t in learned)),
    }


def _corners(table: GridTable, number: str) -> list[tuple[str, int]]:
    """Return the weight of each corner of an interval as a C expression, and the distance of its row from the first."""
    corners = []
    for up in product((0, 1), repeat=len(table.axes)):
        weight, at = "", 0
        for i, (far, nodes) in enumerate(zip(up, table.axes.values(), strict=True)):
            share = f"way[{i}]" if far else f"({c_number(1.0, number)} - way[{i}])"
            weight, at = f"({weight} * {share})" if weight else share, at * len(nodes) + far
        corners.append((weight, at))
    return corners


def _trigonometry(number: str) -> dict[str, Any]:
    """Return the constants and polynomials of cosine and sine as C expressions."""
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
    """Return the table over the angle with one extra node at each end and its slopes, as `numpy.interp` has them."""
    angles = np.concatenate([runout_map.angles[-1:] - TURN, runout_map.angles, runout_map.angles[:1] + TURN])
    values: FloatArray = np.vstack([runout_map.table[-1:], runout_map.table, runout_map.table[:1]])
    slopes = np.diff(values, axis=0) / np.diff(angles)[:, None]
    return {
        "angle": angles.tolist(),
        "value": values.tolist(),
        "slope": slopes.tolist(),
        "mean": runout_map.mean.tolist(),
        "first_step": 1 << ((len(angles) - 1).bit_length() - 1),
    }


def _balancing(chain: Chain) -> dict[str, Any] | None:
    """Return the numbers of the cancellation of unbalance; None without one."""
    if chain.balance is None:
        return None
    twin = Balancing(chain.balance, chain.limits, chain.fade_samples)
    return {
        "rows": chain.balance.table.rows.tolist(),
        "speeds": chain.balance.speeds_rpm,
        "squares": twin.squares,
        "near": [NEAR_LIMIT * square for square in twin.squares],
        "share": twin.share,
        "end": twin.end_samples,
    }


def _learning(chain: Chain) -> dict[str, Any] | None:
    """Return the numbers of the recursive estimates; None without them."""
    if chain.learn is None:
        return None
    fit, t = chain.learn, chain.learn.tables
    units = [fit.start, fit.prior_std, fit.bounds / fit.prior_std]
    tables = {
        "state": t.A,
        "input": t.G,
        "position": t.C,
        "gain": t.K,
        "observer": t.F[t.first :, t.first :],
        "slope": t.slopes[:, t.first :].reshape(-1, t.slopes.shape[2]),
        "force": t.E[t.first :],
        "whiten": t.whiten,
        "outputs": (t.whiten @ t.C)[:, t.first :],
        **{f"law_{letter.lower()}": getattr(t.law, letter) for letter in "ABCD"},
    }
    unbalance = [(i, name) for i, name in enumerate(fit.names) if name in UNBALANCE]
    return {
        "tables": [(n, a.tolist()) for n, a in tables.items() if a.size and (unbalance or n != "force")],
        "lists": list(zip(("start", "prior", "bound"), (unit.tolist() for unit in units), strict=True)),
        "names": fit.names,
        "units": fit.units,
        "n": len(t.A),
        "first": t.first,
        "rest": len(t.A) - t.first,
        "m": t.G.shape[1],
        "n_all": len(fit.names),
        "n_plant": len(fit.names) - len(unbalance),
        "n_law": t.law.n_states,
        "share": fit.sample_time / fit.forgetting_s,
        "excited": EXCITED,
        "outlier": OUTLIER,
        "mean": SCALE_OF_MEAN / len(t.C),
        "warm": fit.warm_samples,
        "unbalance": unbalance,
        "omega": np.pi / 30,
        "half": 0.5 * fit.sample_time,
        "eccentricity": PRIOR_UNBALANCE_M,
        "dither": fit.dither,
        "hold": fit.hold_samples,
    }


def _table_numbers(chain: Chain, bins: dict[str, Any] | None) -> int:
    balance = None if chain.balance is None else chain.balance.table
    tables = [t for t in (chain.controller, chain.harmonics, balance) if t is not None]
    numbers = sum(t.rows.size + sum(2 * len(nodes) - t.is_scheduled for nodes in t.axes.values()) for t in tables)
    if bins is not None:
        numbers += (1 + 2 * len(bins["mean"])) * len(bins["angle"])
    return int(numbers)


def _state_bytes(chain: Chain) -> int:
    """Return the size of the state struct [bytes]: numbers, then 32-bit integers, padded to whole numbers."""
    size = _BYTES[chain.options.number]
    n = len(chain.input_names)
    numbers, counts = max(len(chain.states), 1) + 6 * n + 3 + len(chain.further), 2 * n + 8
    if chain.balance is not None:
        numbers, counts = numbers + 2 * n + 2 * len(chain.limits) + 2, counts + 5
    total = size * (numbers + -(-4 * counts // size))
    if chain.learn is None:
        return total
    t, q, n_y, n_r = chain.learn.tables, len(chain.learn.names), n, len(chain.limits)
    states = 2 * len(t.A) + q * (len(t.A) - t.first) + max(t.law.n_states, 1)
    numbers = states + 2 * t.G.shape[1] + 3 * n_r + n_y + q * q + 3 * q + 1
    return int(total + size * (numbers + -(-4 * (n_r + q + 5) // size)))


# ---- Control chain as compiled C in this process: software in the loop.

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-w")
"""As on the target: sums keep their order, and products are not fused with sums."""


class CompiledChain:
    """Control chain as compiled C, with the methods of `gbid.export.PythonChain`.

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
        self._n_inputs = len(chain.input_names) + 2 + len(chain.scheduling)
        channels = len(chain.limits), len(chain.input_names)
        waves = tuple(2 * n for n in channels if chain.balance is not None)
        learnt = (0 if chain.learn is None else len(chain.learn.names),) * 3
        self._sizes = (len(chain.commands), *channels, *(waves or (0, 0)), *learnt)
        header, body = render_source("chain.h.j2", plain), render_source("chain.c.j2", plain)
        source = header + body.replace('#include "chain.h"\n', "") + render_source("chain_run.c.j2", plain)
        try:
            self._library = load_library(source, FLAGS)
        except CompilerMissingError as missing:
            raise UsageError(
                f"the compiled chain {chain.name!r} needs a C compiler: {missing}; install one (gcc, clang or "
                "gbid[compiler]), set CC, or run the chain in Python (gbid.export.PythonChain; rig: controller: python)"
            ) from None
        self._library.chain_state_bytes.restype = ctypes.c_long
        self.state_bytes = int(self._library.chain_state_bytes())
        self._state = ctypes.create_string_buffer(self.state_bytes)
        self.start()

    def start(self) -> None:
        """Reset the chain to rest."""
        self._library.chain_start(self._state)

    def run(self, inputs: Sequence[ChainInput]) -> list[ChainOutput]:
        """Return the outputs of several samples.

        Parameters
        ----------
        inputs : sequence of ChainInput
            The samples.
        """
        rows = np.array([(*u.position, u.angle, *u.point, u.mode) for u in inputs], float)
        return [self._output(row) for row in self._run(rows.reshape(-1, self._n_inputs))]

    def step(self, given: ChainInput) -> ChainOutput:
        """Return the output of one sample.

        Parameters
        ----------
        given : ChainInput
            The sample.
        """
        return self.run([given])[0]

    def references(self, position: FloatArray, angle: float, *point: float) -> FloatArray:
        """Return the outputs of the controller of one sample in mode CONTROL, r_x and r_y of shape (2,) [m].

        Parameters
        ----------
        position : (n,) array
            Inputs as measured, p_x and p_y [m].
        angle : float
            Shaft angle [rad].
        *point : float
            Pressure [bar], speed [rpm] and further scheduling variables of the chain.
        """
        row = np.array([[*position, angle, *point, ChainMode.CONTROL]], float)
        return self._run(row)[0, self._sizes[0] : self._sizes[0] + self._sizes[1]]

    def _run(self, rows: FloatArray) -> FloatArray:
        rows = np.ascontiguousarray(rows)
        outputs = np.empty((len(rows), sum(self._sizes) + 2))
        pointers = (ctypes.c_void_p(each.ctypes.data) for each in (rows, outputs))
        self._library.chain_run(ctypes.c_long(len(rows)), *pointers, self._state)
        return outputs

    def _output(self, row: FloatArray) -> ChainOutput:
        *values, fault, status = (float(v) for v in row)
        ends, flags = np.cumsum(self._sizes).tolist(), int(status)
        stack, reference, deviation, waves, once, estimate, std, excited = (
            tuple(values[end - size : end]) for end, size in zip(ends, self._sizes, strict=True)
        )
        return ChainOutput(
            stack,
            reference,
            deviation,
            ChainFault(int(fault)),
            bool(flags & 1),
            bool(flags & 2),
            waves,
            once,
            bool(flags & 4),
            estimate,
            std,
            tuple(map(bool, excited)),
            bool(flags & 8),
        )


# ---- Files of a control chain: C source, header, self-test and notes.

_FILES = {
    ".h": "chain.h.j2",
    ".c": "chain.c.j2",
    "_selftest.c": "chain_selftest.c.j2",
    "_notes.md": "chain_notes.md.j2",
    ".mk": "chain.mk.j2",
}


def write_chain(chain: Chain, folder: str | Path, *, overwrite: bool = False) -> list[Path]:
    """Write a control chain as C source, and return the paths of the files.

    Parameters
    ----------
    chain : Chain
        The chain, from `chain_of`.
    folder : str or path
        Folder of the files. Their names begin with the name of the chain.
    overwrite : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of pathlib.Path
        Header, source, self-test, notes, makefile and the SHA-256 of these five, all of them or none.

    Raises
    ------
    UsageError
        When a file exists with other contents and `overwrite` is not set.
    DataError
        When a file cannot be written.
    """
    folder, rows = given_path(folder), selftest_rows(chain)
    files = {}
    for ending, template in _FILES.items():
        text = render_source(
            template,
            chain,
            rows=rows,
            n_rows=len(rows),
            tolerance=FLOAT_TOLERANCE * min(chain.limits),
            conditions=_conditions(chain),
        )
        files[f"{chain.name}{ending}"] = with_text_checksum(text, Path(ending).suffix or ending).encode("ascii")
    digests = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items())
    files[f"{chain.name}.sha256"] = digests.encode("ascii")
    with atomic_set(folder, overwrite) as stage:
        for name, content in files.items():
            with atomic_path(stage / name, overwrite=False) as part:
                part.write_bytes(content)
    return [folder / name for name in files]


def _conditions(chain: Chain) -> str:
    """Return the operating points of the maps as text."""
    points = [each.conditions for each in chain.maps]
    words = [
        ", ".join(f"{c[key]:g} {unit}" for key, unit in (("pressure_bar", "bar"), ("speed_rpm", "rpm")) if key in c)
        for c in points
    ]
    return " and at ".join(word for word in words if word)
