"""Tables of the paper from the results of an experiment: CSV for programs, Markdown for reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gbid.control.impact.impact_store import response_rows
from gbid.errors import DataError
from gbid.lpv import TERMS
from gbid.operating_point import point_label
from gbid.report.reader import Results
from gbid.report.reader.designs import conditions_words, design_performances
from gbid.report.tables.tuning_tables import comparison_table
from gbid.structure import KEY_PARAMETERS
from gbid.tables.table import Column, Entry, Table

_UNITS = {"k": "N/(kg m)", "d": "N s/(kg m)", "b": "N/(kg m)", "tau": "s"}
_PER = ("", "/bar", "/rpm", "/(bar rpm)", "/bar^2", "/rpm^2")


def machine_table(results: Results) -> Table:
    """Return the dimensions of the machine (Table 1) from its model file."""
    if not results.machine.rig:
        raise DataError(f"the model file of {results.machine.name!r} gives no dimensions of the machine")
    rows = [(name.replace("_", " "), q.value, q.unit, q.source) for name, q in results.machine.rig.items()]
    return Table("Table 1: the machine", _columns("dimension", "value", "unit", "source"), rows)


def actuator_table(results: Results) -> Table:
    """Return the nominal actuators (Table 2), with those of the machine's model file."""
    nominal = results.nominal
    known = _published(results)
    rows = [
        (name, value, nominal.std[name], known.get(name), "m/m" if name.startswith("kappa") else "rad/s")
        for name, value in nominal.parameters.items()
    ]
    title = f"Table 2: nominal actuators, the model of {nominal.name}"
    return Table(title, _columns("parameter", "value", "std", "published", "unit"), rows)


def frequency_table(results: Results) -> Table:
    """Return expected and identified natural frequencies (Table 3)."""
    return _mode_table(results, "Table 3: natural frequencies [Hz]", "omega", 0)


def damping_table(results: Results) -> Table:
    """Return expected and identified damping factors (Table 4)."""
    return _mode_table(results, "Table 4: damping factors", "zeta", 1)


def controller_table(results: Results) -> Table:
    """Return the controllers of the piezos (Table A.5) from the machine's model file."""
    found = results.machine.piezo_controllers
    if found is None:
        raise DataError(f"the model file of {results.machine.name!r} gives no controllers of the piezos")
    columns = [Column("piezo"), *(Column(name, unit, 4) for name, unit in found.unit.items())]
    rows = tuple((i, *(getattr(pd, name) for name in found.unit)) for i, pd in enumerate(found.piezos, 1))
    return Table("Table A.5: controllers of the piezos", columns, rows)


def coefficient_table(results: Results) -> Table:
    """Return the coefficients of the surfaces (Table B.6), with those of the machine's model file."""
    fit = results.surface_fit
    std = np.sqrt(np.diag(fit.covariance)).reshape(len(KEY_PARAMETERS), len(TERMS))
    known = results.machine.coefficients if results.experiment.spec.rig is not None else {}
    rows = [
        (key, term, value, float(std[i, j]), known[key][j] if known else None, f"{_UNITS[key.split('_')[0]]}{_PER[j]}")
        for i, key in enumerate(KEY_PARAMETERS)
        for j, (term, value) in enumerate(zip(TERMS, fit.model.coefficients[key], strict=True))
    ]
    columns = _columns("parameter", "term", "value", "std", "published", "unit")
    return Table("Table B.6: coefficients of the surfaces, per kg", columns, rows)


def designs_table(results: Results) -> Table:
    """Return the tuned designs and the published one, each at its worst operating point."""
    performances = design_performances(results.tuned)
    first = next(iter(results.tuned.values()))
    title = f"Designs at the worst of {len(performances[0].points)} operating points"
    return comparison_table(title, performances, conditions_words(first.impact, first.sample_time, first.method))


def impacts_table(results: Results) -> Table:
    """Return measured and simulated responses to the same impact in each loop."""
    shown = (("disc", "um", "peak", "m", 1e6), ("over", "ms", "decay", "s", 1e3), ("piezo", "um", "piezo", "m", 1e6))
    heads = [Column(f"{what}{word}", unit, 4) for what, unit, *_ in shown for word in ("", " std", " simulated")]
    rows: list[tuple[Entry, ...]] = []
    for loops in results.beside:
        for label, study in loops.items():
            where = point_label(study.conditions["pressure_bar"], study.conditions["speed_rpm"])
            for row in response_rows(study):
                numbers = (
                    factor * row[f"{name}{suffix} [{unit}]"]
                    for *_, name, unit, factor in shown
                    for suffix in ("", "_std", "_simulated")
                )
                rows.append((where, label, row["axis"], *numbers))
    title = "The same impact in each loop on the rig: disc up to, over after (95 % of the energy), piezo up to"
    return Table(title, [*_columns("where", "loop", "axis"), *heads], rows)


def _mode_table(results: Results, title: str, sign: str, j: int) -> Table:
    loops = results.impacts_at(False)
    point = next(iter(loops.values())).conditions
    place = (point["pressure_bar"], point["speed_rpm"])
    columns = [(i, loop) for i in (0, 1) for loop in ("open", "closed")]
    rows: list[tuple[Entry, ...]] = [
        ("expected from model", *(loops[loop].expected[i][j] for i, loop in columns)),
        ("expected, sampled loop", *(loops[loop].expected_sampled[i][j] for i, loop in columns)),
        ("obtained from the impacts", *(loops[loop].ringdown.modes()[i][j] for i, loop in columns)),
        ("standard deviation", *(_std(loops[loop].ringdown, i, j) for i, loop in columns)),
    ]
    modes = [m for m in results.machine.reference_modes if (m.pressure_bar, m.speed_rpm) == place]
    for kind in ("expected", "measured"):
        known = {m.loop: m.modes for m in modes if m.kind == kind}
        if {"open", "closed"} <= set(known):
            word = "expected from model" if kind == "expected" else "obtained experimentally"
            rows.append((f"published: {word}", *(known[loop][i][j] for i, loop in columns)))  # type: ignore[index]
    heads = [Column(""), *(Column(f"{sign}_{i + 1} {loop}", format=4) for i, loop in columns)]
    return Table(f"{title}, {point_label(*place)}", heads, rows)


def _std(ring: Any, i: int, j: int) -> float:
    return float((ring.frequency_std, ring.damping_std)[j][i])


def _published(results: Results) -> dict[str, float]:
    return dict(results.machine.actuators) if results.experiment.spec.rig is not None else {}


def _columns(*names: str) -> list[Column]:
    """Return columns of texts, and of numbers with four digits."""
    return [Column(name, format=4 if name in ("value", "std", "published") else "") for name in names]


TABLES: dict[str, Callable[[Results], Table]] = {
    "table1_machine": machine_table,
    "table2_actuators": actuator_table,
    "table3_natural_frequencies": frequency_table,
    "table4_damping_factors": damping_table,
    "tableA5_piezo_controllers": controller_table,
    "tableB6_coefficients": coefficient_table,
    "designs": designs_table,
    "designs_impacts": impacts_table,
}
"""Tables by name. Each raises `DataError` when its results are missing."""
