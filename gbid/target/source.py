"""C source of a control chain from templates."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined

from gbid._version import __version__
from gbid.arrays import FloatArray
from gbid.prefilter.cos_sin import COSINE, QUARTER, QUARTERS_PER_RADIAN, SINE
from gbid.prefilter.runout import TURN, RunoutMap
from gbid.target.chain import Chain
from gbid.target.grid_table import inverse_widths
from gbid.target.identifiers import c_comment, c_number

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
