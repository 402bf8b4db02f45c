"""Theisen et al. (2016): tables of the paper from results, and its figures (`theisen2016_numbers.yaml`) beside ours.

`gbid figures` and `gbid reproduce` load this file (`gbid.report.named.paper`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import isfinite, nan
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from gbid.control import GainResult, close_loop, sensitivities, tune
from gbid.control.impact.study import response_rows
from gbid.core.arrays import point_label
from gbid.core.errors import DataError, GbidError, NoSpaceError, UsageError
from gbid.core.tables import Column, Entry, Table, csv_text, finite_or_none, formatted, markdown_table, plain_table
from gbid.core.yaml_file import read_yaml
from gbid.experiment.fields import Result, content_key, stored_key
from gbid.experiment.run import Job, Outcome, produce
from gbid.lpv import CHARACTERISTICS, TERMS, characteristics
from gbid.report.canvas import save_figure
from gbid.report.control_tables import comparison_table
from gbid.report.named import NamedFigure, named_figures
from gbid.report.read import POINT, Results, conditions_words, design_performances, published_controller
from gbid.structure import KEY_PARAMETERS

FILE = Path(__file__).with_name("theisen2016_numbers.yaml")


@dataclass(frozen=True)
class PaperNumber:
    """One figure of the paper.

    Attributes
    ----------
    id : str
        Identifier.
    where : str
        Section, table or figure.
    quantity, unit : str
        Quantity and its unit.
    value : float
        Value in the paper.
    scatter : float or None
        Scatter that the paper gives for it; None when it gives none.
    scatter_from : str
        Source of the scatter.
    at_most : bool
        Whether the figure is a size of scatter or error; a smaller value is then not a deviation.
    off : str
        Explanation of a larger deviation of our value.
    """

    id: str
    where: str
    quantity: str
    unit: str
    value: float
    scatter: float | None = None
    scatter_from: str = ""
    at_most: bool = False
    off: str = ""


def paper_numbers(path: Path = FILE) -> tuple[PaperNumber, ...]:
    """Return the figures of the paper.

    Raises
    ------
    UsageError
        When the file is faulty: a key is unknown, an explanation is missing, or an id occurs twice.
    """
    file = read_yaml(path)
    explanations: Mapping[str, str] = file.data["explanations"]
    found: dict[str, PaperNumber] = {}
    for i, row in enumerate(file.data["numbers"]):
        where = file.position(("numbers", i))
        off = row.get("off", "")
        if off and off not in explanations:
            raise UsageError(f"{where}: off: no explanation {off!r}; there is {', '.join(explanations)}")
        try:
            number = PaperNumber(**{**row, "off": " ".join(str(explanations[off]).split()) if off else ""})
        except TypeError as error:
            raise UsageError(f"{where}: {error}") from None
        if number.id in found:
            raise UsageError(f"{where}: id {number.id!r} occurs twice; remove one")
        found[number.id] = number
    return tuple(found.values())


# ---- Tables of the paper from the results of an experiment: CSV for programs, Markdown for reports.

_UNITS = {"k": "N/(kg m)", "d": "N s/(kg m)", "b": "N/(kg m)", "tau": "s"}
_PER = ("", "/bar", "/rpm", "/(bar rpm)", "/bar^2", "/rpm^2")


def machine_table(results: Results) -> Table:
    """Return the dimensions of the machine (Table 1) from its model file."""
    if not results.published_machine.rig:
        raise DataError(f"the model file of {results.machine.name!r} gives no dimensions of the machine")
    rows = [(name.replace("_", " "), q.value, q.unit, q.source) for name, q in results.published_machine.rig.items()]
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
    found = results.published_machine.piezo_controllers
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
    modes = [m for m in results.published_machine.reference_modes if (m.pressure_bar, m.speed_rpm) == place]
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


# ---- Comparison with the paper, row by row: its figures, ours, the deviation, and the reason of a large one.

Verdict = Literal["within", "explained", "off", "missing"]
Own = tuple[float, float]
"""Value and its standard deviation, nan without one."""
_SCALE = {"um": 1e6, "ms": 1e3}
_PAIRS = ("xx", "xy", "yx", "yy")


@dataclass(frozen=True)
class ReproductionRow:
    """Comparison of one figure of the paper with ours.

    Attributes
    ----------
    number : PaperNumber
        Figure of the paper.
    ours, std : float
        Our value and its standard deviation; nan without one.
    verdict : {"within", "explained", "off", "missing"}
        ``within``: the deviation is within the scatter of the paper. ``explained`` and ``off``: it is larger, with or
        without explanation. ``missing``: there is no value of ours.
    why : str
        Explanation, or what is missing.
    """

    number: PaperNumber
    ours: float
    std: float
    verdict: Verdict
    why: str = ""

    @property
    def deviation(self) -> float:
        """Our value minus that of the paper."""
        return self.ours - self.number.value

    def document(self) -> dict[str, Any]:
        """Return plain values; None for missing ones."""
        n = self.number
        return {
            "id": n.id,
            "where": n.where,
            "quantity": n.quantity,
            "unit": n.unit,
            "paper": n.value,
            "ours": finite_or_none(self.ours),
            "ours_std": finite_or_none(self.std),
            "deviation": finite_or_none(self.deviation),
            "deviation_percent": finite_or_none(100 * self.deviation / n.value) if n.value else None,
            "scatter": n.scatter,
            "scatter_from": n.scatter_from,
            "at_most": n.at_most,
            "verdict": self.verdict,
            "why": self.why,
        }


def reproduction(results: Results) -> list[ReproductionRow]:
    """Return the comparison of an experiment with the paper.

    Parameters
    ----------
    results : Results
        Results for the machine of the paper.

    Returns
    -------
    list of ReproductionRow
        Rows in the order of the paper.

    Raises
    ------
    DataError
        When the machine is another.
    """
    if not results.published:
        raise DataError("the paper's figures are for its own machine: an experiment with rig: {model: theisen2016}")
    own = dict(_values())
    rows = []
    for number in paper_numbers():
        try:
            ours, std = own[number.id](results)
        except GbidError as error:
            rows.append(ReproductionRow(number, nan, nan, "missing", str(error)))
            continue
        scale = _SCALE.get(number.unit, 1.0)
        rows.append(judged(number, scale * ours, scale * std))
    return rows


def judged(number: PaperNumber, ours: float, std: float = nan) -> ReproductionRow:
    """Return the row of a value; its verdict allows the scatter of the paper plus up to two own standard deviations."""
    if not isfinite(ours):
        return ReproductionRow(number, ours, std, "missing", "not a finite number")
    over = ours - number.value if number.at_most else abs(ours - number.value)
    allowed = (number.scatter or 0.0) + (2 * std if isfinite(std) else 0.0)
    if over <= allowed + 1e-12 * abs(number.value):
        return ReproductionRow(number, ours, std, "within")
    return ReproductionRow(number, ours, std, "explained" if number.off else "off", number.off)


def _values() -> Iterator[tuple[str, Callable[[Results], Own]]]:
    """Yield for each id the function that returns our value in SI units (percents as such)."""
    for k, pair in enumerate(_PAIRS):
        yield f"static_rms_{pair}", partial(_static_rms, k)
    yield "static_largest", _static_largest
    yield "recordings", _models
    for name in ("p1_x", "p2_x", "p1_y", "p2_y", "kappa_x", "kappa_y"):
        yield f"actuator_{name}", partial(_actuator, name)
    for word, structure in (("bearing", "rotor_bearing"), ("actuator", "piezo_pair")):
        for j, axis in enumerate("xy"):
            for what in ("mean", "std"):
                yield f"{word}_{what}_{axis}", partial(_crossval, structure, what, j)
    for j, name in enumerate(CHARACTERISTICS):
        yield f"rms_{name}", partial(_rms, j)
        yield f"surface_{name}", partial(_off_published, j)
    yield "largest_gain", _largest_gain
    for loop in ("open", "closed"):
        for i in (1, 2):
            for j, what in enumerate(("frequency", "damping")):
                yield f"expected_{loop}_{what}_{i}", partial(_expected, loop, i - 1, j)
                yield f"obtained_{loop}_{what}_{i}", partial(_obtained, loop, i - 1, what)
    for i in (1, 2):
        yield f"damping_factor_{i}", partial(_damping_factor, i - 1)
    for loop in ("open", "closed"):
        for i in (1, 2):
            for j, what in enumerate(("frequency", "damping")):
                yield f"model_{loop}_{what}_{i}", partial(_published_mode, loop, i - 1, j)
    for i in (1, 2):
        yield f"model_damping_factor_{i}", partial(_published_factor, i - 1)
    tuned = lru_cache(maxsize=1)(_retuned)  # one search for all three rows
    yield "tuned_damping", lambda results: (tuned(results).value, nan)
    for axis in "xy":
        yield f"tuned_kappa_{axis}", partial(_retuned_gain, tuned, f"kappa_{axis}")
    yield "hysteresis", _hysteresis


def _static_rms(k: int, results: Results) -> Own:
    return float(results.static_map.rms.flat[k]), nan


def _static_largest(results: Results) -> Own:
    return float(np.nanmax(results.static_map.largest)), nan


def _models(results: Results) -> Own:
    """Return the number of recordings whose fits determine the surfaces."""
    return float(len(results.surface_fit.estimates.recordings)), nan


def _actuator(name: str, results: Results) -> Own:
    return results.nominal.parameters[name], results.nominal.std[name]


def _crossval(structure: str, what: Literal["mean", "std"], j: int, results: Results) -> Own:
    summary = results.summary(structure)
    return float((summary.mean if what == "mean" else summary.std)[j]), nan


def _rms(j: int, results: Results) -> Own:
    return results.surface_fit.deviations[j].rms, nan


def _largest_gain(results: Results) -> Own:
    return max(d.largest for d in results.surface_fit.deviations if d.name.startswith("g_")), nan


def _off_published(j: int, results: Results) -> Own:
    """Return the rms over the operating points of a characteristic of our surfaces minus that of the published ones."""
    points = np.array(results.machine.operating_points, float)
    ours, published = (
        characteristics(np.column_stack([np.broadcast_to(p[key], len(points)) for key in KEY_PARAMETERS]))
        for p in (
            model.key_parameters(points[:, 0], points[:, 1]) for model in (results.surface_fit.model, results.machine)
        )
    )
    return float(np.sqrt(np.mean((ours[:, j] - published[:, j]) ** 2))), nan


def _expected(loop: str, i: int, j: int, results: Results) -> Own:
    return results.impacts_at(False)[loop].expected[i][j], nan


def _obtained(loop: str, i: int, what: str, results: Results) -> Own:
    ring = results.impacts_at(False)[loop].ringdown
    value, std = (ring.frequency_hz, ring.frequency_std) if what == "frequency" else (ring.damping, ring.damping_std)
    return float(value[i]), float(std[i])


def _damping_factor(i: int, results: Results) -> Own:
    """Return the factor by which the controller increases a damping factor."""
    return _expected("closed", i, 1, results)[0] / _expected("open", i, 1, results)[0], nan


def _published_mode(loop: str, i: int, j: int, results: Results) -> Own:
    """Return frequency or damping factor of a mode of the published model, with or without its controller."""
    plant = results.machine.plant_at(*POINT)
    if loop == "closed":
        plant = close_loop(plant, published_controller(results.published_machine))
    return plant.modes()[i][j], nan


def _published_factor(i: int, results: Results) -> Own:
    return _published_mode("closed", i, 1, results)[0] / _published_mode("open", i, 1, results)[0], nan


def _retuned(results: Results) -> GainResult:
    """Return gains tuned on the published model at the point of the paper, with the peak of S_o of its own gains."""
    machine = results.machine
    cap = sensitivities(machine.plant_at(*POINT), published_controller(results.published_machine)).peak("output").value
    return tune(machine, operating_points=[POINT], peak_sensitivity=cap)


def _retuned_gain(tuned: Callable[[Results], GainResult], name: str, results: Results) -> Own:
    return tuned(results).gains[name], nan


def _hysteresis(results: Results) -> Own:
    for curve, *_ in results.piezos:
        if curve.units[0] == "V":
            return curve.hysteresis, curve.hysteresis_std
    raise DataError("no piezo was characterised in open loop; add one to section 'static'")


def counts(rows: list[ReproductionRow]) -> Mapping[str, int]:
    """Return the number of rows by verdict."""
    return {
        verdict: sum(row.verdict == verdict for row in rows) for verdict in ("within", "explained", "off", "missing")
    }


# ---- The reproduction table, for a terminal and as Markdown.

_COLUMNS = (
    Column("where"),
    Column("quantity", wrap=True),  # the only one with words enough to give way
    Column("unit"),
    *(Column(name, format="g") for name in ("paper", "+-", "ours", "std", "off by")),
    Column(""),
)
_LEGEND = "+-: how far by the paper's own account; less: a size of scatter or error, where less is no deviation"
_COUNTED = {
    "within": "within the paper's own scatter",
    "explained": "further off or without a scatter to compare with, and explained",
    "off": "off without an explanation",
    "missing": "missing",
}
_DIGITS = 3
_WORDS = {"within": "within", "explained": "see", "off": "OFF", "missing": "missing"}


def reproduction_tables(document: Mapping[str, Any]) -> list[Table]:
    """Table of the paper's figures and ours, with the explanations below, each once; then what goes past the paper.

    Parameters
    ----------
    document : dict
        From `reproduction_document`.
    """
    rows, reasons = _laid_out(document)
    notes = [_total(document), f"{_LEGEND}.", *(f"{i}. {reason}" for i, reason in enumerate(reasons, 1))]
    table = Table("the paper's figures and ours", _COLUMNS, rows, ["", *notes])
    return [table, *map(_past, document.get("past_the_paper", ()))]


def reproduction_markdown(document: Mapping[str, Any]) -> str:
    """Markdown of the same tables.

    Parameters
    ----------
    document : dict
        From `reproduction_document`.
    """
    first, *past = reproduction_tables(document)
    return "\n".join(map(markdown_table, (replace(first, title=""), *past)))  # a page has a heading of its own


def _past(document: Mapping[str, Any]) -> Table:
    """Table of what the paper has no figures for, from its document."""
    rows = [[cell if isinstance(cell, str) else _cell(cell, _DIGITS) for cell in row] for row in document["rows"]]
    worded = [isinstance(cell, str) for cell in document["rows"][0]]
    heads = zip(document["columns"], worded, strict=True)
    columns = [Column(name) if words else Column(name.replace(" ", "\n"), format="g") for name, words in heads]
    return Table(document["title"], columns, rows)


def _laid_out(document: Mapping[str, Any]) -> tuple[list[list[Entry]], list[str]]:
    """Cells of each row, and the explanations that the last column numbers."""
    rows: list[list[Entry]] = []
    reasons: list[str] = []
    for row in document["rows"]:
        word = _WORDS[row["verdict"]]
        if row["why"]:
            reasons += [] if row["why"] in reasons else [row["why"]]
            word = f"{word} {reasons.index(row['why']) + 1}"
        scatter = "less" if row["at_most"] else _cell(row["scatter"], 2)
        numbers = (_cell(row["paper"], 4), scatter, _cell(row["ours"], 4), _cell(row["ours_std"], 2), _off(row))
        rows.append([row["where"], row["quantity"], row["unit"], *numbers, word])
    return rows, reasons


def _total(document: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{count} {_COUNTED[verdict]}" for verdict, count in document["counts"].items() if count)
    return f"{len(document['rows'])} rows: {counts}"


def _off(row: Mapping[str, Any]) -> Entry:
    if row["deviation"] is None or (row["at_most"] and row["deviation"] <= 0):
        return None
    if row["deviation_percent"] is None:
        return _cell(row["deviation"], 2)
    return formatted(row["deviation_percent"], "+.1f", "%")


def _cell(value: float | None, digits: int) -> Entry:
    if value is None or not 0.001 <= abs(value) < 1e5:
        return formatted(value, digits)
    return formatted(value, f".{digits}g" if abs(value) < 10**digits else ".0f")


# ---- Files of the figures and tables of the paper, and of the comparison with it, from the results.

FOLDER = "figures"
KINDS = ("pdf", "svg", "png")
"""Formats of figures."""
PAST = ("designs", "designs_impacts")
"""Tables without counterpart in the paper."""
REPRODUCTION = "reproduction"
_SOURCES = ("static", "fits", "crossval", "nominal", "lpv", "impacts", "controller")


@dataclass(frozen=True)
class LeftOut:
    """Figure or table that could not be made.

    Attributes
    ----------
    item, why : str
        Its name, and the reason.
    """

    item: str
    why: str


def write_paper(job: Job, kinds: Sequence[str] = KINDS[:1]) -> tuple[list[Outcome], list[LeftOut]]:
    """Write ``figures/fig05_static_map.pdf`` and so on, ``figures/table2_actuators.csv``, ``.md``.

    Parameters
    ----------
    job : Job
        The job.
    kinds : sequence of str
        Formats of the figures: pdf, svg, png. Each takes its time.

    Returns
    -------
    outcomes : list of Outcome
        Outcomes of the files.
    left_out : list of LeftOut
        Figures and tables that the results do not allow, with the reason.

    Raises
    ------
    UsageError
        When a file made from other results exists and must not be replaced.
    """
    results, sources = Results(job), _sources(job)
    outcomes: list[Outcome] = []
    left_out: list[LeftOut] = []
    for figure in named_figures().values():
        _collect(figure.name, partial(_figure, job, results, figure, sources, kinds), outcomes, left_out)
    for name, make in TABLES.items():
        _collect(name, partial(_table, job, results, name, make, sources), outcomes, left_out)
    return outcomes, left_out


def write_reproduction(job: Job) -> tuple[list[Outcome], dict[str, Any]]:
    """Write ``reproduction.json``, ``.csv`` and ``.md``.

    Returns
    -------
    list of Outcome
    dict
        From `reproduction_document`.

    Raises
    ------
    DataError
        When the machine is not the paper's.
    """
    results, sources = Results(job), _sources(job)
    rows = reproduction(results)
    document = reproduction_document(rows, past_the_paper(results))
    writers: dict[str, Callable[[], str]] = {
        ".json": lambda: json.dumps(document, indent=1, allow_nan=False) + "\n",
        ".csv": lambda: csv_text(_as_table(rows)),
        ".md": lambda: reproduction_markdown(document),
    }
    outcomes = []
    for ending, write in writers.items():
        path = job.experiment.results / f"{REPRODUCTION}{ending}"
        settings = {"kind": ending, "document": document}
        key = content_key(REPRODUCTION, settings, sources)
        text = partial(_with_key, write, ending, key)
        outcomes.append(
            produce(job, Result(REPRODUCTION, f"{REPRODUCTION}{ending}", path, key), partial(_write_text, text))
        )
    return outcomes, document


def past_the_paper(results: Results) -> list[Table]:
    """Return tables without counterpart in the paper, if the results allow them: tuned designs and their impacts."""
    found = []
    for name in PAST:
        with suppress(DataError):
            found.append(TABLES[name](results))
    return found


def reproduction_document(rows: list[ReproductionRow], past: Sequence[Table] = ()) -> dict[str, Any]:
    """Return all rows as plain values, the number of rows by verdict, and tables without counterpart in the paper."""
    return {
        "counts": dict(counts(rows)),
        "rows": [row.document() for row in rows],
        "past_the_paper": [table.document() for table in past],
    }


def _as_table(rows: list[ReproductionRow]) -> Table:
    columns = ("where", "quantity", "unit", "paper", "ours", "ours_std", "deviation", "scatter", "verdict", "why")
    documents = [row.document() for row in rows]
    return plain_table(columns, [[document[name] for name in columns] for document in documents])


def _collect(name: str, make: Callable[[], list[Outcome]], outcomes: list[Outcome], left_out: list[LeftOut]) -> None:
    """Make one item; when its results do not allow it, note the reason."""
    try:
        made = make()
    except NoSpaceError:
        raise
    except DataError as error:
        left_out.append(LeftOut(name, str(error)))
        return
    outcomes += made


def _figure(job: Job, results: Results, named: NamedFigure, sources: list[str], kinds: Sequence[str]) -> list[Outcome]:
    name = named.name
    paths = {kind: job.path(FOLDER, name, f".{kind}") for kind in kinds}
    keys = {kind: content_key("paper figure", {"name": name, "kind": kind}, sources) for kind in kinds}
    stale = [kind for kind in kinds if stored_key(paths[kind]) != keys[kind]]
    figure = _drawn(named, results) if stale else None

    def write(kind: str, part: Path) -> None:
        assert figure is not None
        save_figure(figure, part, kind=kind, note=f"content_key: {keys[kind]}")

    return [
        produce(job, Result("figure", f"{name}.{kind}", paths[kind], keys[kind]), partial(write, kind))
        for kind in kinds
    ]


def _table(
    job: Job, results: Results, name: str, make: Callable[[Results], Table], sources: list[str]
) -> list[Outcome]:
    table = make(results)
    outcomes = []
    for ending, text in ((".csv", csv_text(table)), (".md", markdown_table(table))):
        key = content_key("paper table", {"name": name, "kind": ending, "text": text}, sources)
        write = partial(_write_text, partial(_with_key, partial(str, text), ending, key))
        outcomes.append(produce(job, Result("table", f"{name}{ending}", job.path(FOLDER, name, ending), key), write))
    return outcomes


def _drawn(named: NamedFigure, results: Results) -> Figure:
    """Return a figure; results that do not allow it count as bad data, for any reason."""
    try:
        return named.make(results)
    except UsageError as error:
        raise DataError(str(error)) from None


def _sources(job: Job) -> list[str]:
    """Return the content keys of all results behind figures and tables."""
    folder = job.experiment.results
    files = sorted(
        path for name in _SOURCES for path in (folder / name).rglob("*") if path.suffix in (".h5", ".yaml", ".csv")
    )
    spec = job.experiment.spec
    model = spec.rig.model if spec.rig is not None else ""
    return [model, *(f"{path.relative_to(folder)} {stored_key(path)}" for path in files)]


def _with_key(text: Callable[[], str], ending: str, key: str) -> str:
    """Add the content key as a comment, in JSON as an entry."""
    if ending == ".json":
        return text().replace("{\n", f'{{\n "made_from": "content_key: {key}",\n', 1)
    comment = f"<!-- content_key: {key} -->\n" if ending == ".md" else f"# content_key: {key}\n"
    return comment + text()


def _write_text(text: Callable[[], str], part: Path) -> None:
    part.write_text(text(), encoding="utf-8")
