"""Sections of the report: summary, data, fits, validation, nominal actuator, static maps, surfaces, provenance."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial
from operator import attrgetter
from statistics import fmean, median
from typing import Any

import numpy as np

from gbid.core.arrays import point_label
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.hdf5 import read_made_with
from gbid.core.index import known
from gbid.core.notes import explanations
from gbid.core.tables import Cell, Column, Entry, Row, Table, Value, in_unit, shown_unit, titled, value_of
from gbid.experiment.experiment import Experiment, fit_models, recordings_of
from gbid.experiment.recordings import load_made
from gbid.experiment.run import Outcome
from gbid.experiment.stages.crossval import pair_table, validate_pair
from gbid.experiment.stages.fit import load_made_fit, response_of
from gbid.identify.fit_tables import fit_tables
from gbid.lpv import LPVModel
from gbid.lpv.fit import LACK
from gbid.prefilter.filtering import correction_table
from gbid.recording.clock import MAX_JITTER
from gbid.report.campaign_tables import conditions_text, origin_table
from gbid.report.canvas import scheduling_words
from gbid.report.control_sections import design_damping_map, held_back
from gbid.report.model_pictures import plot_bode
from gbid.report.page import (
    Block,
    Fold,
    Gallery,
    Link,
    Listed,
    PageSection,
    Pictures,
    Shown,
    Templated,
    Words,
    fit_href,
    packed,
    packed_json,
)
from gbid.report.pictures import drawn
from gbid.report.read import MadeFit, Results, StageResults
from gbid.report.views import (
    converged_words,
    design_lines,
    modes_by_point,
    note_rows,
    notes_by_kind,
    outcome_words,
    points_of,
)
from gbid.validate import Validation

_NAMED = 5
Cache = dict[str, tuple[object, Any]]
"""Parts of a page that were drawn before, by name: what each stands on, and what was drawn."""


def drawn_once(cache: Cache, name: str, stand: object, draw: Callable[[], Any]) -> Any:
    """Return a cached part of the page if its inputs are unchanged; else draw it."""
    if name not in cache or cache[name][0] != stand:
        cache[name] = stand, draw()
    return cache[name][1]


def fits_section(results: Results, pictures: Pictures, beside: str, cache: Cache) -> PageSection | None:
    """Return the section on the fits: summary and details; most curves are in separate files in the folder `beside`."""
    if not results.experiment.spec.fits:
        return None
    blocks: list[Block] = []
    lost = lost_fits(results)
    if lost:
        rows = [(Cell(str(f.item), href=fit_href(f.item.section, f.item.model)), f.state, f.text) for f in lost]
        blocks.append(Table("Fits that are not there", [Column("fit"), Column("state"), Column("reason")], rows))
    for name in results.experiment.spec.fits:
        fits = [q for q in results.fits if q.fit == name]
        if fits:
            blocks += _overview(results, name, fits)
    carried: dict[str, list[MadeFit]] = {}  # each note once, with the fits that have it
    for q in results.fits:
        for note in q.document["notes"]:
            carried.setdefault(f"{q.fit}: {note}", []).append(q)
    items = [
        Link(f"{text} ({len(noted)} {_fits(len(noted))})", fit_href(noted[0].fit, noted[0].model))
        for text, noted in sorted(carried.items(), key=lambda item: -len(item[1]))
    ]
    blocks += [Fold(f"Notes of the fits ({len(items)})", [Listed(items)])] if items else []
    for q in (q for q in results.fits if q.document["profiles"]):
        figure = load_made_fit(results.job, q.fit, q.model).figures()[-1]
        picture = pictures.picture(drawn(figure), figure.caption)
        blocks.append(Fold(f"{q.fit}, {q.model}: profile likelihoods", [Shown(picture)]))
    for q in results.fits:
        for i in range(len(results.experiment.spec.fits[q.fit].responses)):
            measured = response_of(results.experiment, q.fit, i)
            caption = f"{q.fit}, {q.model}: frequency response of the model, and measured ({measured.name})"
            picture = pictures.picture(
                plot_bode({f"model of {q.model}": load_made_fit(results.job, q.fit, q.model)}, measured=measured),
                caption,
            )
            blocks.append(Fold(f"{q.fit}, {q.model}: frequency responses of {measured.name}", [Shown(picture)]))
    data = {**fit_data(results, cache), "beside": beside}
    if data["fits"]:
        groups: dict[str, list[tuple[str, str]]] = {}
        for key, document in data["fits"].items():
            groups.setdefault(key.partition("/")[0], []).append((key, document["label"]))
        blocks.append(Templated("fit.html.j2", {"groups": groups, "data": data}))
    return PageSection("fits", "Fits", blocks)


def lost_fits(results: Results) -> list[Outcome]:
    """Return the planned fits without results."""
    return [f for f in results.standings if f.item.stage == "fit" and f.state != "kept"]


def fit_data(results: Results, cache: Cache) -> dict[str, Any]:
    """Return the data of each fit for the script of the page."""
    curves = {name: curves_of(results, name) for name in with_curves(results)}
    tables = {q.name: drawn_once(cache, q.name, q.document, partial(_shown_tables, q.document)) for q in results.fits}
    fits = {q.name: {**_heading(results, q), **tables[q.name], **curves.get(q.name, {})} for q in results.fits}
    for f in lost_fits(results):
        empty: dict[str, Any] = {"tables": [], "facts": [], "traces": [], "no_trace": ""}
        title = {"title": str(f.item), "label": f"{f.item.model}: {f.state}", "state": "bad"}
        fits[str(f.item)] = {**empty, **title, "status": f"{f.state}: {f.text}"}
    order = {name: i for i, name in enumerate(results.experiment.spec.fits)}
    return {"fits": dict(sorted(fits.items(), key=lambda item: order[item[0].partition("/")[0]]))}


def _place(results: Results, q: MadeFit) -> str:
    if not recordings_of(results.experiment, q.fit, q.model):
        return "frequency responses"
    return point_words(results.experiment, q.document["recordings"][0]) if q.point else "several"


def _mean_percent(q: MadeFit, output: str) -> float:
    """Return the mean fit percent of an output over the recordings of a fit."""
    return fmean(row["fit_percent"] for row in q.document["fit_percent"] if row["output"] == output)


def _overview(results: Results, name: str, made: Sequence[MadeFit]) -> list[Block]:
    outputs = [row["output"] for row in made[0].document["whiteness"]]
    focus = made[0].document["options"]["focus"]
    how = "one step ahead" if focus == "prediction" else focus
    by_point: dict[str, list[MadeFit]] = {}
    for q in made:
        by_point.setdefault(_place(results, q), []).append(q)
    rows: list[list[Entry]] = []
    for point, fits in by_point.items():
        worst = min(fits, key=attrgetter("smallest"))
        medians = [median(_mean_percent(q, output) for q in fits) for output in outputs]
        link = Cell(f"{worst.model} ({worst.smallest:.2f} %)", href=fit_href(name, worst.model))
        rows.append([point, len(fits), sum(q.document["success"] for q in fits), *medians, link])
    columns = [
        Column("operating point"),
        *(Column(name, format="d") for name in ("fits", "converged")),
        *(Column(output, "%", ".2f") for output in outputs),
        Column("worst"),
    ]
    caption = f"{name}: median fit on its own data ({how}), by operating point"
    blocks: list[Block] = [Table(caption, columns, rows)]
    if len(made) > 2 * _NAMED:
        ordered = sorted(made, key=attrgetter("smallest"))
        for word, chosen in (("worst", ordered[:_NAMED]), ("best", ordered[: -_NAMED - 1 : -1])):
            words = (f"{q.model}: {q.smallest:.2f} % at {_place(results, q)}" for q in chosen)
            items = [Link(text, fit_href(name, q.model)) for text, q in zip(words, chosen, strict=True)]
            blocks.append(Fold(f"{name}: the {word} {_NAMED}", [Listed(items)]))
    stuck = [q for q in made if not q.document["success"]]
    if stuck:
        blocks.append(Words(f"{name}, not converged: {len(stuck)} of {len(made)} fits", "bad"))
        blocks.append(Listed([Link(f"{q.model}: {q.document['status']}", fit_href(name, q.model)) for q in stuck]))
    return blocks


def _heading(results: Results, q: MadeFit) -> dict[str, Any]:
    names, place = ", ".join(q.document["recordings"]), _place(results, q)
    state, status = ("warn", "Converged, with notes below.") if q.document["notes"] else ("good", "Converged.")
    if not q.document["success"]:
        state, status = "bad", q.document["status"][:1].upper() + q.document["status"][1:]
    return {
        "title": f"{q.fit}, {q.model}: {place}" + (f" ({names})" if names != q.model else ""),
        "label": f"{place}: {q.model} ({q.smallest:.2f} %)",
        "state": state,
        "status": status,
    }


def _shown_tables(document: Row) -> dict[str, Any]:
    *tables, facts = fit_tables(document)
    return {
        "tables": [
            {"columns": [[c.heading, c.left] for c in table.columns], "rows": table.texts()} for table in tables
        ],
        "facts": facts.texts(),
    }


CURVES = 10
"""Number of the worst, and of the best, models of a fit whose curves are in the page."""


def with_curves(results: Results) -> list[str]:
    """Return the models whose curves are in the page: the worst and the best models of each fit."""
    names: list[str] = []
    for fit in results.experiment.spec.fits:
        ordered = sorted((q for q in results.fits if q.fit == fit), key=attrgetter("smallest"))
        names += dict.fromkeys(q.name for q in (*ordered[:CURVES], *ordered[-CURVES:]))
    return names


def curves_of(results: Results, name: str) -> dict[str, Any]:
    """Return measured and simulated curves for the recordings of a fit, or a text if not available."""
    fit, _, model = name.partition("/")
    shown, traces, reason = results.experiment.spec.figures.get(fit), [], ""
    for recording in recordings_of(results.experiment, fit, model):
        try:
            validation = validate_pair(results.job, fit, model, recording)
        except (DataError, UsageError, OSError) as error:  # UsageError: of a scheduled structure
            reason = str(error)
        else:
            traces.append(trace(validation, shown.from_s if shown else None))
    return {"traces": traces, "no_trace": reason}


def curves_script(results: Results, name: str, key: str = "") -> str:
    """Return the curves of a fit as a script that the page loads on request."""
    return f"// content_key: {key}\nFits.add({json.dumps(name)},{packed_json(curves_of(results, name))});\n"


SAMPLES = 1200
"""Number of samples in the part shown."""
POINTS = 600
"""Largest number of points of a curve."""
BINS = 240
"""Number of intervals of the whole recording for which the range of the error is stored."""


def trace(validation: Validation, from_s: float | None = None) -> dict[str, Any]:
    """Return a part of a validation over time, and the range of its error over the whole recording.

    Parameters
    ----------
    validation : Validation
        The validation.
    from_s : float, optional
        Start of the part [s]; by default a third of the recording, also when too few samples follow.

    Returns
    -------
    dict
        recording; start, step, duration [s]; at irregular times `times`, from the start; outputs, each with name, unit,
        n, measured, simulated, and error_n, error_low, error_high, in the units of `shown_unit`. Curves are in the form
        of `packed`.
    """
    time, n = validation.time, len(validation.time)
    first = n // 3 if from_s is None else int(np.searchsorted(time, from_s))
    first = max(0, min(first, n - SAMPLES))
    every = max(1, min(SAMPLES, n) // POINTS)
    part = slice(first, first + SAMPLES, every)
    edges = np.linspace(0, n, min(BINS, n) + 1).astype(int)[:-1]
    step, duration = (float(time[1] - time[0]), n * float(time[1] - time[0])) if n > 1 else (0.0, 0.0)
    irregular = n > 1 and np.ptp(np.diff(time)) > MAX_JITTER * step
    if irregular:
        duration = float(time[-1])
        edges = np.searchsorted(time, np.linspace(0, duration, min(BINS, n) + 1)[:-1])
    outputs = []
    for i, (name, unit) in enumerate(zip(validation.output_names, validation.output_units, strict=True)):
        factor, shown = shown_unit(unit, float(np.nanmax(np.abs(validation.measured[:, i]))))
        measured, simulated = factor * validation.measured[:, i], factor * validation.simulated[:, i]
        error = measured - simulated
        outputs.append(
            {
                "name": name,
                "unit": shown or "-",
                "n": len(measured[part]),
                "measured": packed(measured[part]),
                "simulated": packed(simulated[part]),
                "error_n": len(edges),
                "error_low": packed(np.fmin.reduceat(error, edges)),
                "error_high": packed(np.fmax.reduceat(error, edges)),
            }
        )
    return {
        "recording": validation.recording,
        "start": float(time[first]),
        "step": every * step,
        "duration": duration,
        "outputs": outputs,
        **({"times": packed(time[part] - time[first])} if irregular else {}),
    }


_LISTED = 40
_LONG = 12  # rows of a table that folds


def value_blocks(name: str, value: Any, pictures: Pictures, models: Container[Value] = ()) -> list[Block]:
    """Return figures and tables of a result as blocks; all figures but the first and long tables are folded.

    Parameters
    ----------
    name : str
        Name of the result.
    value : any
        The result.
    pictures : Pictures
        Maker of the pictures.
    models : container of str
        Models of the fit of this name, for links from the cells that name them.
    """
    blocks: list[Block] = []
    for i, figure in enumerate(value.figures() if isinstance(value, Pictured) else ()):
        caption = f"{name}: {figure.caption}"
        try:
            shown: Block = Shown(pictures.picture(drawn(figure), caption))
        except GbidError as error:  # surfaces without physical meaning at some point
            shown = Words(f"{caption} cannot be drawn: {error}", "warn")
        blocks.append(Fold(caption, [shown]) if i else shown)
    tables = [linked(table, name, models) for table in titled(name, value.tables())]
    return [*blocks, *(_folded(f"{name}: {q.title}" if k else q.title, q) for k, q in enumerate(tables))]


def linked(table: Table, fit: str, models: Container[Value]) -> Table:
    """Return a table whose first cells link to the fits that they name."""
    rows = [list(row) for row in table.rows]
    for row in rows:
        at = next((i for i, entry in enumerate(row) if value_of(entry) in models), None)
        if at is not None:
            entry = row[at]
            row[at] = Cell(value_of(entry), getattr(entry, "text", ""), fit_href(fit, str(value_of(entry))))
    return replace(table, rows=rows)


def stage_section(id: str, title: str, results: StageResults[Any], pictures: Pictures) -> PageSection:
    """Return the section of a stage: its results, and the reasons for missing results."""
    blocks: list[Block] = [Words(why, "warn") for why in results.missing.values()]
    for name, value in results.complete.items():
        blocks += value_blocks(name, value, pictures)
    return PageSection(id, title, blocks)


def validation_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on the validation of models on recordings outside their fits."""
    planned = results.experiment.spec.crossval
    if not planned:
        return None
    blocks: list[Block] = []
    for name in planned:
        if name not in results.crossval:
            blocks.append(Words(f"{name}: not validated with the present fits; `gbid crossval` does it.", "warn"))
            continue
        rows, summary = results.crossval[name]
        models = fit_models(results.experiment, name)
        blocks += value_blocks(name, summary, pictures, models)
        missed = [row for row in rows if row.missed]
        if missed:
            text = f"{name}: {len(missed)} of {len(rows)} stay below the {missed[0].minimum_percent:g} % asked for."
            blocks.append(Words(text, "bad"))
        worst = sorted(rows, key=lambda row: row.fit_percent)[:_LISTED]
        shown = "all pairs" if len(rows) <= _LISTED else f"the worst {_LISTED} of {len(rows)}"
        blocks.append(Fold(f"{name}: {shown}", [linked(pair_table(worst), name, models)]))
    return PageSection("validation", "Cross-validation", blocks)


def nominal_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on the nominal actuator; None if the experiment has no section nominal."""
    section = results.experiment.spec.nominal
    if section is None:
        return None
    try:
        models = fit_models(results.experiment, section.fit)
        blocks = value_blocks(section.fit, results.nominal, pictures, models)
    except GbidError as error:
        blocks = [Words(f"There is none: {error}", "warn")]
    return PageSection("actuator", "Nominal actuator", blocks)


def static_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on static characterisations; None if the experiment has none."""
    if not results.experiment.spec.static:
        return None
    return stage_section("static", "Static characterisation", results.statics, pictures)


def surfaces_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on each surface fit; None if the experiment has none."""
    if results.experiment.spec.lpv is None:
        return None
    text = "Not drawn with the present fits; `gbid lpv` does it, or says why it cannot."
    surfaces = StageResults(results.surfaces, {} if results.surfaces else {"lpv": text})
    title = f"Surfaces over {scheduling_words(results.experiment.spec.lpv.scheduling)}"
    return stage_section("surfaces", title, surfaces, pictures)


ALIKE = 0.5
"""Correlation of the two excitations above which their effects can hardly be separated."""
WORSE = 1e-3
"""Share of the variance by which a run-out map may increase the position before the page lists it."""


def point_words(experiment: Experiment, recording: str) -> str:
    """Return the operating point of a recording as text."""
    planned = experiment.recordings[recording]
    known = planned.conditions
    if "pressure_bar" in known and "speed_rpm" in known:
        return point_label(known["pressure_bar"], known["speed_rpm"])
    return conditions_text(known) or "not stated"


def quality_section(results: Results) -> PageSection | None:
    """Return the section on data quality: recordings, their problems, and corrections by the prefilter."""
    recordings = results.recordings
    if not any(planned.excited for planned in results.experiment.recordings.values()):
        return None
    if not recordings:
        return PageSection("data", "Data quality", [Words("There is no excited recording yet.")])
    blocks: list[Block] = []
    problems = [text for q in recordings for text in q.problems]
    if problems:
        blocks += [Words(f"{len(problems)} problems found in {len(recordings)} recordings:", "bad"), Listed(problems)]
    else:
        text = f"{len(recordings)} excited recordings checked: no dead, saturated or swapped channel, no rub."
        blocks.append(Words(text, "good"))
    signals = list(dict.fromkeys(signal for q in recordings for signal in q.signals))
    units = {signal: {q.units[signal] for q in recordings if signal in q.signals} for signal in signals}
    rows: list[list[Entry]] = []
    for q in recordings:
        if q.alike is not None and abs(q.alike) > ALIKE:
            blocks.append(Words(f"{q.name}: the excitations of x and y are correlated ({q.alike:+.2f})", "warn"))
        rows.append([q.name, point_words(results.experiment, q.name), f"{q.duration:g} s, {q.n_samples}"])
        for signal in signals:
            sizes = [(channel, in_unit(rms, q.units[signal])) for channel, rms, _ in q.signals.get(signal, ())]
            if len(units[signal]) == 1:  # the heading has it
                sizes = [(channel, size.partition(" ")[0]) for channel, size in sizes]
            rows[-1].append(", ".join(map(" ".join, sizes)) or None)
    pairs = any(q.alike is not None for q in recordings)
    for q, row in zip(recordings, rows, strict=True):
        row += [q.alike] * pairs
    one_unit = {name: shown_unit(next(iter(unit)))[1] if len(unit) == 1 else "" for name, unit in units.items()}
    columns = [*map(Column, ("recording", "operating point", "length, samples"))]
    columns += [Column(f"{name}, rms", one_unit[name]) for name in signals]
    title = "Excited recordings: rms about the mean of each channel"
    if pairs:
        title += ", correlation of the two excitations"
        columns.append(Column("correlation x, y", format="+.3f"))
    table = Table(title, columns, rows)
    blocks += [_folded(f"Excitation of {len(rows)} recordings", table), *_prefilter(results)]
    return PageSection("data", "Data quality", blocks)


def _folded(title: str, table: Table) -> Block:
    """Return a table as a block, folded if it is long."""
    return Fold(title, [table]) if len(table.rows) > _LONG else table


def _prefilter(results: Results) -> list[Block]:
    section = results.experiment.spec.prefilter
    if section is None:
        return [Words("No prefilter: the recordings were fitted as they are.")]
    rows = results.prefiltered
    if not rows:
        return [Words("The prefilter has not run yet.", "warn")]
    worse = [row for row in rows if row["runout_share"] < -WORSE]
    median = "none" if section.median == 1 else f"{section.median} samples"
    spikes, mean = ("replaced" if section.spikes else "kept"), ("removed" if section.remove_mean else "kept")
    caption = f"Run-out map: {section.method}; spikes: {spikes}; median: {median}; mean {mean}."
    blocks: list[Block] = [Words(caption)]
    if worse:
        names = ", ".join(dict.fromkeys(row["recording"] for row in worse))
        blocks.append(Words(f"The run-out map made the position larger in {names}: it may not belong to them.", "warn"))
    carried: dict[str, set[str]] = {}
    for row in rows:
        for note in row["notes"]:
            carried.setdefault(note, set()).add(row["recording"])
    every = len({row["recording"] for row in rows})
    if carried:
        blocks.append(Listed([f"{len(names)} of {every} recordings: {note}" for note, names in carried.items()]))
    return [*blocks, _folded(f"Prefilter, {len(rows)} channels", correction_table(rows))]


_LEAD_S = 0.3  # of a response at the top of the page
_STAGES = {"rig": "recordings", "import": "recordings", "prefilter": "prefiltered", "fit": "fits"}


def warnings(results: Results) -> list[Link]:
    """Return the warnings of all results, each with a link to its section."""
    links = [
        Link(f"{f.item.stage} {f.item}: {f.text}", "#data")
        for f in results.standings
        if f.item.stage != "fit" and f.state == "failed"
    ]
    lost = Counter(f.state for f in lost_fits(results))
    links += [Link(f"{n} {_fits(n)} {_LOST[state]}", "#fits") for state, n in lost.items()]

    def add_if(present: object, words: str, href: str) -> None:
        """Add a warning if there are items to warn about."""
        links.extend([Link(words, href)] if present else [])

    problems = sum(len(q.problems) for q in results.recordings)
    add_if(problems, f"{problems} problems in the signals of the recordings", "#data")
    stuck = sum(not q.document["success"] for q in results.fits)
    add_if(stuck, f"{stuck} {_fits(stuck)} did not converge", "#fits")
    for name, (rows, summary) in results.crossval.items():
        missed = sum(row.missed for row in rows)
        add_if(missed, f"{name}: {missed} validations below the minimum asked for", "#validation")
        coloured = sum(row.residuals_white is False for row in rows)
        tested = sum(row.residuals_white is not None for row in rows)
        add_if(coloured, f"{name}: residuals of {coloured} of {tested} validations are not white", "#validation")
        links += [Link(f"{name}: {text}", "#validation") for text in summary.failed]
    for name in results.experiment.spec.crossval:
        add_if(name not in results.crossval, f"{name}: not validated with the present fits", "#validation")
    if results.experiment.spec.nominal is not None:
        try:
            outliers = len(results.nominal.outliers)
            add_if(outliers, f"{outliers} actuator parameters lie off the others", "#actuator")
        except GbidError as error:
            links.append(Link(f"no nominal actuator: {error}", "#actuator"))
    if results.experiment.spec.lpv is not None:
        add_if(not results.surfaces, "no surfaces were drawn with the present fits", "#surfaces")
    add_if(results.fits and not results.experiment.spec.crossval, "no fit was validated on other recordings", "#fits")
    noted: dict[str, Iterable[Row]] = {
        "#fits": (q.document for q in results.fits),
        "#surfaces": (fit.document() for fit in results.surfaces.values()),
        "#controller": (design.document() for design in results.designs.complete.values()),
    }
    for href, documents in noted.items():
        for code, texts in notes_by_kind(documents).items():
            explanation = explanations().get(code)
            if explanation and explanation.warns:
                links.append(
                    Link(f"{explanation.title} [{code}{f', {len(texts)} times' if len(texts) > 1 else ''}]", href)
                )
    for item, fit in results.surfaces.items():
        lack = (fit.lack_of_fit < LACK).any()
        add_if(lack, f"surfaces {item} miss the means of some parameters by more than chance", "#surfaces")
        add_if(not fit.success, f"surfaces {item}: {fit.status}", "#surfaces")
        far = len(fit.outliers)
        add_if(far, f"surfaces {item}: {far} estimate{'s' * (far != 1)} far off their surface", "#surfaces")
    for design in results.assessed if results.experiment.spec.controller else ():
        links += [Link(f"controller {design.name}: {text}", "#controller") for text in design.warnings()]
    links += [Link(f"controller {name}: {text}", "#controller") for name, text in results.designs.missing.items()]
    for name, made in results.designs.complete.items():
        links += [Link(f"controller {name}: {text}", "#controller") for text in held_back(made)]
    return links


_LOST = {"failed": "failed", "missing": "not made yet", "stale": "made with other settings or data"}


def _fits(n: int) -> str:
    return "fit" if n == 1 else "fits"


def lead_figure(results: Results) -> Figure | None:
    """Return the figure at the top of the page: of a design, else the surfaces, else the best fit, else a recording.

    A model of a single operating point has no picture over pressure and speed.
    """
    designs = results.assessed if results.experiment.spec.controller else ()
    for design in [design for design in designs if _has_range(design.plant)][:1]:
        data = design_damping_map(design)
        over = scheduling_words(design.plant.scheduling)
        return Figure("plot_damping_map", f"Smallest damping factor over {over}, {data.title}", (data,))
    for item, fit in [(item, fit) for item, fit in results.surfaces.items() if _has_range(fit.model)][:1]:
        return fit.figures()[0]._replace(caption=f"{item}: {fit.figures()[0].caption}")
    first = next((q.fit for q in results.fits), "")
    best = max((q for q in results.fits if q.fit == first), key=attrgetter("smallest"), default=None)
    if best is not None and recordings_of(results.experiment, first, best.model):
        recording = best.document["recordings"][0]
        validation = validate_pair(results.job, first, best.model, recording)
        caption = f"Model of {best.name}, measured and simulated on {recording}: fit {best.smallest:.1f} %"
        shown, end = results.experiment.spec.figures.get(first), float(validation.time[-1])
        part = {"from_s": shown.from_s, "to_s": shown.to_s} if shown else {"from_s": end / 3, "to_s": end / 3 + _LEAD_S}
        return Figure("plot_response", caption, (validation,), part)
    for signals in results.recordings:
        return load_made(results.job, results.experiment.recordings[signals.name]).figures()[0]
    return None


def _has_range(model: LPVModel) -> bool:
    return len(model.scheduling) == 2 and any(low < high for low, high in model.domain.bounds)


def _lead(results: Results, pictures: Pictures) -> list[Block]:
    """Return the figure at the top of the page as a block; empty if it cannot be drawn."""
    try:
        figure = lead_figure(results)
        return [Shown(pictures.picture(drawn(figure), figure.caption))] if figure else []
    except (GbidError, OSError):
        return []


def summary_section(results: Results, links: list[Link], pictures: Pictures) -> PageSection:
    """Return the summary at the top: leading figure, warnings, key figures and numbers of results."""
    blocks: list[Block] = []
    if links:
        blocks += [Words(f"{len(links)} {'thing' if len(links) == 1 else 'things'} to look at:", "warn"), Listed(links)]
    else:
        blocks.append(Words("No warnings.", "good"))
    document = {
        "fits": [{"fit": q.fit, "model": q.model, **q.document} for q in results.fits],
        "crossval_summary": [{"fit": name, **asdict(made)} for name, (_, made) in results.crossval.items()],
        "lpv": [{"item": name, **fit.document()} for name, fit in results.surfaces.items()],
        "tuning": [{"design": name, **design.document()} for name, design in results.designs.complete.items()],
    }
    lines = [begin + ", ".join(words) for begin, words in outcome_words(document) if words]
    lines += [line for design in document["tuning"] for line in design_lines(design)]
    blocks.append(Listed([converged_words(document["fits"]), *lines] if results.fits else lines))
    blocks = [Gallery([*_lead(results, pictures), Gallery(blocks)])]
    if modes := modes_by_point(document["fits"], points_of(results.experiment)):
        columns = [Column(head) for head in ("fit", "operating point", "mode", "models", "frequency [Hz]", "damping")]
        title = "Modes: means over the models, with the 95 % interval of one model"
        table = Table(title, columns, [(q.fit, q.point, q.number, q.models, *q.formatted()) for q in modes])
        blocks.append(_folded(f"Modes, {len(modes)} rows", table))
    if notes := note_rows(document):
        blocks.append(Fold(f"Notes ({len(notes)})", [Listed([begin + text for begin, text in notes])]))
    counts: dict[str, Counter[str]] = {}
    for f in results.standings:
        counts.setdefault(_STAGES[f.item.stage], Counter())[f.state] += 1
    states = ("kept", "failed", "missing", "stale")
    rows: list[tuple[Entry, ...]] = [(stage, *(count[state] for state in states)) for stage, count in counts.items()]
    heads = ("made", "failed", "not made", "made with other settings")
    blocks.append(Table("Results", [Column("stage"), *(Column(head, format="d") for head in heads)], rows))
    return PageSection("summary", "At a glance", blocks)


def origin_section(results: Results) -> PageSection | None:
    """Return the provenance of fits, surfaces and designs: programs, YAML, seeds, data, commands; None without them."""
    job = results.job
    paths = [job.path("fits", q.fit, q.model) for q in results.fits]
    paths += [job.path("lpv", name) for name in results.surfaces]
    paths += [job.path("controller", name) for name in results.designs.complete]
    origins = [known(path, "made_with", read_made_with) for path in paths if path.is_file()]
    return PageSection("origin", "Made with", [origin_table(origins)]) if origins else None


def not_done(results: Results) -> list[str]:
    """Return the parts of the method that the experiment does not use."""
    spec = results.experiment.spec
    missing = [
        ("prefilter", spec.prefilter is not None, "run-out, offset and spikes were not removed from the recordings"),
        ("static", bool(spec.static), "no static characterisation from staircases"),
        ("crossval", bool(spec.crossval), "no model was validated on recordings to which it was not fitted"),
        ("nominal", spec.nominal is not None, "no nominal actuator was chosen"),
        ("lpv", spec.lpv is not None, "no surfaces over pressure and speed"),
    ]
    texts = [f"{text} (no section {name})" for name, done, text in missing if not done]
    if not results.designs.complete:
        texts.append("no controller was designed")
    if not (results.assessed or any(design.performance for design in results.designs.complete.values())):
        texts.append("no controller was assessed")
    return texts
