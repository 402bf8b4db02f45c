"""Documents (plain values in SI units) and tables of recordings, fits, cross-validation, surfaces and staircases."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gbid import characterise, identify, lpv, validate
from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import UsageError
from gbid.core.published import PUBLISHED_LARGEST_GAIN
from gbid.core.tables import (
    Cell,
    Column,
    Entry,
    Row,
    Table,
    finite_or_none,
    formatted,
    shown_unit,
)
from gbid.core.units import conversion_factor
from gbid.experiment.experiment import Experiment
from gbid.experiment.run import Outcome
from gbid.prefilter import PrefilterReport
from gbid.recording import load_recording
from gbid.recording.readers import FileChannel
from gbid.structure import KEY_PARAMETERS, PiezoPair


def keyed_table(
    title: str, columns: Mapping[str, Column], rows: Iterable[Mapping[str, Any]], notes: Sequence[str] = ()
) -> Table:
    """Return the table of some values of rows, picked by the keys of the columns."""
    return Table(title, list(columns.values()), [[row[key] for key in columns] for row in rows], notes)


# ---- Tables of a campaign: states of the items of each stage, and a summary of the fits.

_STATES = ("made", "kept", "failed", "not_converged")


def campaign_document(
    experiment: Experiment, outcomes: Sequence[Outcome], table: identify.FitTable | None = None
) -> Row:
    """Return a summary of a campaign: states of the stages, fits by name, and the files of the table."""
    stages: dict[str, dict[str, int]] = {}
    for outcome in outcomes:
        if outcome.item.stage != "table":
            counts = stages.setdefault(outcome.item.stage, dict.fromkeys(_STATES, 0))
            counts[outcome.state] += 1
            counts["not_converged"] += outcome.state != "failed" and not outcome.converged
    return {
        "experiment": experiment.spec.name,
        "results": str(experiment.results),
        "stages": stages,
        "fits": [] if table is None else [_fit_of_campaign(table, name) for name in experiment.spec.fits],
        "table": [str(outcome.path) for outcome in outcomes if outcome.item.stage == "table"],
    }


def _fit_of_campaign(table: identify.FitTable, name: str) -> Row:
    """Return numbers of converged and missing fits of one name, their median fit percent, and the worst fit."""
    rows = table.select(fit=name)
    made = np.isfinite(rows.fit_percent).any(axis=1)
    smallest = rows.fit_percent[made].min(axis=1, initial=np.inf)
    worst = int(np.argmin(smallest)) if smallest.size else None
    return {
        "fit": name,
        "fits": len(rows),
        "converged": int(rows.success.sum()),
        "not_converged": int(made.sum() - rows.success.sum()),
        "missing": int((~made).sum()),
        "median_fit_percent": {
            output: float(np.median(rows.fit_percent[made, j])) for j, output in enumerate(rows.output_names)
        },
        "worst": None if worst is None else str(rows.model[made][worst]),
        "worst_fit_percent": None if worst is None else float(smallest[worst]),
    }


def campaign_tables(document: Row) -> list[Table]:
    """Return the tables of the stages and of the fits of a campaign; empty tables are left out."""
    heads = {"stage": Column("stage")} | {key: Column(key.replace("_", " "), format="d") for key in _STATES}
    stages = [{"stage": stage, **counts} for stage, counts in document["stages"].items()]
    columns = {
        "fit": Column("fit"),
        **{key: Column(key, format="d") for key in ("fits", "converged", "missing")},
        "median": Column("median", "%"),
        "worst_fit_percent": Column("worst", "%", ".1f", missing=""),
        "worst": Column("of", missing=""),
    }
    fits = [
        {**row, "median": ", ".join(f"{output} {value:.1f}" for output, value in row["median_fit_percent"].items())}
        for row in document["fits"]
    ]
    return [table for table in (keyed_table("", heads, stages), keyed_table("", columns, fits)) if table.rows]


# ---- Documents and tables of a cross-validation, for each pair and in summary, and of the nominal actuator.

_POINTS = 30  # largest number of operating points that have their own rows


def fit_href(fit: str, model: str) -> str:
    """Return the address of a fit in the page."""
    return f"#fit&{fit}%2F{model}"


def crossval_table(title: str, rows: Sequence[Row]) -> Table:
    """Return the table of the fit percent of each model on each recording, and of the residual tests; by fit."""
    columns = {
        "model": Column("model of"),
        "recording": Column("on"),
        "output": Column("output"),
        "fit_percent": Column("fit\n", "%", ".2f"),
        "error": Column("largest\nerror", format=2),
        "residuals_white": Column("residuals\nwhite", format="s"),
        "follow": Column("follow"),
        **({"why": Column("")} if any(row["missed"] for row in rows) else {}),
    }
    cells = (
        {
            **row,
            "model": Cell(row["model"], href=fit_href(title, row["model"])),
            "error": formatted(row["infinity_norm"], 2, row["unit"]),
            "follow": ", ".join(row["residuals_follow"]) or None,
            "why": f"below {row['minimum_percent']:g} %" if row["missed"] else "",
        }
        for row in rows
    )
    return keyed_table(f"{title}, cross-validation, simulated", columns, cells)


def summary_document(fit: str, summary: validate.ValidationSummary, path: Path) -> Row:
    """Return the summary of a cross-validation as plain values, with histograms."""
    return {"fit": fit, **asdict(summary), "path": str(path)}


def validation_table(document: Row, paper: Mapping[str, str] | None = None) -> Table:
    """Return the table of mean and std of the fit percent of each output, over all pairs and by operating point.

    Parameters
    ----------
    document : dict
        Document of `summary_document`.
    paper : dict of str to str, optional
        Figures of the paper by output, for a column beside the others.
    """
    title = (
        f"{document['fit']}, cross-validation: {document['n_models']} models, "
        f"{document['n_recordings']} recordings, {document['n_pairs']} pairs"
    )
    columns = [
        *(Column(""), Column("output"), Column("pairs", format="d")),
        *(Column("fit\n", "%", ".2f"), Column("std\n", "%", ".2g"), Column("least\n", "%", ".2f")),
        Column("largest\nerror", format=2),
        Column("worst pair", wrap=True),
        *([Column("paper", "%")] if paper else []),
    ]
    worst = {pair["output"]: pair for pair in reversed(document["worst"])}
    points = document["points"] if 1 < len(document["points"]) <= _POINTS else ()
    rows: list[list[Entry]] = []
    for i, figures in enumerate(({**document, "infinity_norm": document["infinity_norm_max"]}, *points)):
        every = i == 0
        place = "all" if every else point_label(figures["pressure_bar"], figures["speed_rpm"])
        for j, (output, unit) in enumerate(zip(document["output_names"], document["output_units"], strict=True)):
            numbers = (figures["n_pairs"], figures["mean"][j], figures["std"][j], figures["least"][j] if every else "")
            pair: Entry = None if every else ""
            if every and output in worst:
                model, recording = worst[output]["model"], worst[output]["recording"]
                pair = Cell(f"{model} on {recording}", href=fit_href(document["fit"], model))
            error = formatted(figures["infinity_norm"][j], 2, unit)
            known = [paper[output] if every else ""] if paper else []
            rows.append(["" if j else place, output, *numbers, error, pair, *known])
    return Table(title, columns, rows)


def nominal_document(fit: str, nominal: validate.NominalActuator, path: Path) -> Row:
    """Return the nominal actuator as plain values, with the outliers and their reasons."""
    return {
        "fit": fit,
        "model": nominal.name,
        "parameters": nominal.parameters,
        "std": nominal.std,
        "chosen_from": len(nominal.models),
        "distance": float(nominal.distances.min()),
        "outliers": [{**asdict(outlier), "reason": outlier.reason} for outlier in nominal.outliers],
        "left_out": list(nominal.left_out),
        "path": str(path),
    }


def nominal_table(document: Row) -> Table:
    """Return the table of poles and gains of the nominal actuator, then of the outliers.

    Parameters
    ----------
    document : dict
        Document of `nominal_document`.
    """
    off = bool(document["outliers"] or document["left_out"])
    columns = [Column("most central model"), Column("parameter"), Column("value", format=5), Column("std", format=2)]
    columns += [Column("unit"), *([Column("why")] if off else [])]
    unit = {p.name: p.unit for pair in (PiezoPair(), PiezoPair(poles="any")) for p in pair.parameters}
    first = [Cell(document["model"], href=fit_href(document["fit"], document["model"]))]
    first += [Cell(f"of {document['chosen_from']} models")]
    rows: list[list[Entry]] = [
        [first[i] if i < 2 else "", name, value, document["std"][name], unit.get(name, ""), *([""] if off else [])]
        for i, (name, value) in enumerate(document["parameters"].items())
    ]
    for outlier in document["outliers"]:
        model = Cell(f"outlier {outlier['model']}", href=fit_href(document["fit"], outlier["model"]))
        name = outlier["parameter"]
        rows.append([model, name, outlier["value"], "", unit.get(name, ""), outlier["reason"]])
    rows += [["left out", "", "", "", "", text] for text in document["left_out"]]
    return Table(f"{document['fit']}, nominal actuator", columns, rows)


# ---- Tables of the deviations of fits from the surfaces over pressure and speed.

_OUTLIERS = 10  # largest number that is printed; the document contains all


def lpv_document(item: str, fit: lpv.LPVFit, path: Path, *, published: bool) -> Row:
    """Return the document of a surface fit as plain values.

    Parameters
    ----------
    item : str
        Name of the surfaces.
    fit : LPVFit
        The fit.
    path : path
        The model file.
    published : bool
        Whether the machine is that of the paper; figures of the paper are then added.
    """
    of_paper = {} if published else {"published_rms": None}

    def by_parameter(values: FloatArray) -> Row:
        return dict(zip(KEY_PARAMETERS, values.tolist(), strict=True))

    return {
        "item": item,
        "path": str(path),
        "model": fit.model.name,
        "recordings": len(fit.estimates.recordings),
        "operating_points": len(fit.model.operating_points),
        "status": fit.status,
        "success": fit.success,
        "options": dict(fit.options),
        "deviations": [asdict(d) | of_paper for d in fit.deviations],
        "published_largest_gain": PUBLISHED_LARGEST_GAIN if published else None,
        "orders": [{"order": s.order, "score": s.score, "why_not": s.why_not} for s in fit.orders],
        "coefficients": {key: list(fit.model.coefficients[key]) for key in KEY_PARAMETERS},
        "coefficients_std": by_parameter(np.sqrt(np.diag(fit.covariance)).reshape(-1, 6)),
        "scatter_std": by_parameter(np.sqrt(np.diag(fit.scatter))),
        "lack_of_fit": by_parameter(fit.lack_of_fit),
        "outliers": [asdict(o) for o in fit.outliers],
        "left_out": list(fit.estimates.left_out),
        "notes": list(fit.notes),
    }


def lpv_table(document: Row) -> Table:
    """Return the table of deviations of one surface fit, with notes on orders and outliers.

    Parameters
    ----------
    document : dict
        Document of `lpv_document`.
    """
    sizes = {"rms": "rms", "published_rms": "rms,\npaper", "largest": "largest"}
    if all(row["published_rms"] is None for row in document["deviations"]):
        del sizes["published_rms"]
    rows: list[list[Entry]] = []
    for row in document["deviations"]:
        factor, unit = shown_unit(row["unit"])
        rows.append([row["name"], *(factor * row[key] for key in sizes), unit, row["recording"]])
    title = (
        f"{document['item']}: {document['recordings']} recordings at {document['operating_points']} operating points, "
        f"{document['options']['method']}, {document['status']}"
    )
    columns = [
        Column(""),
        *(Column(name, format=".4g") for name in sizes.values()),
        Column("unit"),
        Column("recording"),
    ]
    return Table(title, columns, rows, ["", *_notes(document)])


def _notes(document: Row) -> Iterator[str]:
    orders = [
        f"{row['order']}: {row['score']:.3f}" if row["why_not"] == "" else f"{row['order']}: not possible"
        for row in document["orders"]
    ]
    if orders:
        yield f"error at points left out, by order (order 0 = 1): {', '.join(orders)}"
    for row in document["outliers"][:_OUTLIERS]:
        yield f"off the surface: {row['recording']}, {row['parameter']}, {row['standardised']:+.1f} std"
    if len(document["outliers"]) > _OUTLIERS:
        yield f"off the surface: {len(document['outliers'])} in all; these were the worst"
    yield from (f"note: {note}" for note in document["notes"])
    yield f"model: {document['path']}"


# ---- Tables of recordings, of the channels of a file, and of the corrections by the prefilter.

SHOWN_SPIKES = 10
"""Largest number of spikes whose sample numbers a row lists."""


def recording_documents(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return documents of recordings that were made or imported; failed ones are left out."""
    made = [outcome for outcome in outcomes if outcome.item.stage in ("rig", "import") and outcome.state != "failed"]
    return [
        {
            "name": recording.name,
            "kind": experiment.recordings[recording.name].kind,
            "samples": recording.n_samples,
            "sample_time_s": recording.sample_time,
            "duration_s": recording.duration,
            "conditions": dict(recording.conditions),
            "signals": {name: list(recording.channels[name]) for name in recording.signals},
            "state": outcome.state,
            "path": str(outcome.path),
        }
        for outcome in made
        for recording in [load_recording(outcome.path)]
    ]


def recording_table(rows: Sequence[Row]) -> Table:
    """Return the table of recordings with their length and operating point."""
    columns = {
        "name": Column("recording"),
        "samples": Column("samples", format="d"),
        "duration_s": Column("duration", "s", "g"),
        "where": Column("conditions"),
        "state": Column("state"),
    }
    where = [", ".join(f"{key} {value:g}" for key, value in row["conditions"].items()) for row in rows]
    cells = ({**row, "where": words} for row, words in zip(rows, where, strict=True))
    return keyed_table("recordings", columns, cells)


def channel_rows(channels: Iterable[FileChannel]) -> list[Row]:
    """Return the channels of a file of another program as plain values."""
    return [
        {
            "channel": channel.name,
            "samples": channel.n_samples,
            "unit": channel.unit,
            "sample_time_s": channel.sample_time,
            "rate_hz": None if channel.sample_time is None else 1.0 / channel.sample_time,
            "step": channel.step,
            "jitter_ppm": channel.jitter_ppm,
            "first": list(channel.first),
            "remark": channel.remark,
        }
        for channel in channels
    ]


def channel_table(name: str, rows: Sequence[Row]) -> Table:
    """Return the table of the channels of a file, from `channel_rows`."""
    columns = {
        "channel": Column("channel"),
        "samples": Column("samples", format="d"),
        "unit": Column("unit"),
        "sample_time_s": Column("sample time", "s", ".6g"),
        "rate_hz": Column("rate", "Hz", ".6g"),
        "first": Column("first samples"),
        "remark": Column("remark", wrap=True),
    }
    cells = (
        {
            **row,
            "first": " ".join(f"{value:.5g}" for value in row["first"]) or None,
            "remark": row["remark"] or _rising(row),
        }
        for row in rows
    )
    return keyed_table(name, columns, cells)


def _rising(row: Row) -> str:
    """Return what is known of a column that may be the time."""
    if row["step"] is None:
        return ""
    rate = ""
    with suppress(UsageError):
        rate = f": {1 / (row['step'] * conversion_factor(row['unit'], 's')):.6g} Hz" if row["unit"] else ""
    even, jitter = (
        ("even ", "") if row["jitter_ppm"] is None else ("", f", with a jitter of {row['jitter_ppm']:.0f} ppm")
    )
    return f"rises in {even}steps of {row['step']:.6g}{rate}{jitter}"


def layout_words(layout: Mapping[str, str | int | None]) -> str:
    """Return the layout of a text file as one line; empty for a file of another kind."""
    return ", ".join(f"{key.replace('_', ' ')} {value!r}" for key, value in layout.items() if value is not None)


def prefilter_rows(reports: Iterable[PrefilterReport]) -> list[Row]:
    """Return the corrections of each channel of p by the prefilter as plain values, in the unit of p."""
    return [
        {
            "recording": report.name,
            "channel": f"p_{channel}",
            "unit": report.units["p"],
            "rms_before": float(report.rms_before["p"][i]),
            "rms_after": float(report.rms_after["p"][i]),
            "offset": float(report.offsets["p"][i]),
            "runout_share": float(report.runout_share[i]),
            "harmonics": [float(amplitude) for amplitude in report.harmonics[:, i]],
            "spikes": report.spikes[i],
            "first_spikes": list(report.spike_samples[i][:SHOWN_SPIKES]) if report.spike_samples else [],
            "notes": list(report.notes),
        }
        for report in reports
        for i, channel in enumerate(report.channels["p"])
    ]


def prefilter_table(rows: Sequence[Row]) -> Table:
    """Return the table of the corrections by the prefilter, from `prefilter_rows`."""
    units = list(dict.fromkeys(row["unit"] for row in rows))
    factor, unit = shown_unit(units[0]) if len(units) == 1 else (1.0, " or ".join(units))
    columns = [
        Column("recording"),
        Column("rms\nbefore\n", unit, ".3f"),
        Column("after\n", unit, ".3f"),
        Column("offset\n", unit, ".3f"),
        Column("run-out\nshare", format=".1%"),
        Column("harmonics\n1, 2, 3", unit),
        Column("spikes", format="d"),
    ]
    laid = []
    for row in rows:
        harmonics = " ".join(f"{factor * amplitude:.2f}" for amplitude in row["harmonics"][:3]) or None
        sizes = (factor * row[key] for key in ("rms_before", "rms_after", "offset"))
        laid.append([f"{row['recording']} {row['channel']}", *sizes, row["runout_share"], harmonics, row["spikes"]])
    return Table("Prefilter: what it removed from each channel", columns, laid)


# ---- Documents (SI units) and tables (micrometres instead of metres) of static maps and piezo curves.


def static_document(name: str, result: characterise.StaticMap | characterise.PiezoCurve) -> Row:
    """Return the document of a static characterisation; unknown values are None.

    Parameters
    ----------
    name : str
        Name of the characterisation.
    result : StaticMap or PiezoCurve
        The result.

    Returns
    -------
    dict
        name, kind, recordings, notes, and a row for each gain of a map, or the figures of a curve.
    """
    if isinstance(result, characterise.PiezoCurve):
        steps = ~result.saturated
        of_curve = ("hysteresis", "hysteresis_std", "hysteresis_at", "hysteresis_share", "uniformity")
        return {
            "name": name,
            "kind": "piezo",
            "recordings": [result.name],
            "channel": result.channel,
            "units": list(result.units),
            **{name: finite_or_none(getattr(result, name)) for name in of_curve},
            "range": [float(result.position.min()), float(result.position.max())],
            "step_gain": finite_or_none(float(np.mean(result.step_gain[steps]))) if steps.any() else None,
            "creep": finite_or_none(float(np.mean(result.creep[steps]))) if steps.any() else None,
            "steps": len(result.step),
            "saturated_steps": [int(i) + 1 for i in np.flatnonzero(result.saturated)],
            "notes": list(result.notes),
        }
    interval = result.interval()
    figures = {
        **{"gain": result.gain, "std": result.gain_std, "lower_95": interval[..., 0], "upper_95": interval[..., 1]},
        **{key: getattr(result, key) for key in ("rms", "largest", "hysteresis", "hysteresis_std")},
    }
    return {
        "name": name,
        "kind": "bearing",
        "recordings": list(result.sources),
        "conditions": dict(result.conditions),
        "units": list(result.units),
        "plateaus": len(result.command),
        "dof": result.dof,
        "gains": [
            {
                "output": output,
                "input": source,
                **{key: finite_or_none(values[i, j]) for key, values in figures.items()},
            }
            for i, output in enumerate(result.output_names)
            for j, source in enumerate(result.input_names)
        ],
        "offset": result.offset.tolist(),
        "notes": list(result.notes),
    }


def static_table(document: Row) -> Table:
    """Return the table of a static characterisation from its document."""
    title = f"{document['name']}: {', '.join(document['recordings'])}"
    source, output = document["units"]
    if document["kind"] == "piezo":
        columns = [Column(document["channel"]), Column("value", format=3)]
        rows = [
            [word, formatted(_times(factor, document[key]), 3, unit)]
            for word, key, factor, unit in (
                ("hysteresis", "hysteresis", 1.0, output),
                ("  its standard error", "hysteresis_std", 1.0, output),
                ("  over the range", "hysteresis_share", 100.0, "%"),
                ("creep per step", "creep", 100.0, "%"),
                ("gain per step", "step_gain", 1.0, f"{output}/{source}"),
                ("non-uniformity of the steps", "uniformity", 100.0, "%"),
            )
        ]
        return Table(title, columns, rows, document["notes"])
    factor, unit = shown_unit(output)
    names = {"rms": "rms off\nlinear\n", "largest": "largest\n", "hysteresis": "hysteresis\n"}
    names["hysteresis_std"] = "its std\n"
    columns = [Column("static gain"), Column("value", format=5), Column("std", format=2)]
    columns += [Column(name, unit, 3) for name in names.values()]
    gains = [
        [f"{row['input']} to {row['output']}", row["gain"], row["std"], *(_times(factor, row[key]) for key in names)]
        for row in document["gains"]
    ]
    return Table(title, columns, gains, document["notes"])


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


# ---- Origin of results: programs, YAML, seeds, data and command.


def origin_table(origins: Iterable[Mapping[str, Any]]) -> Table:
    """Return the table of what results were made with; different values of several results stand side by side.

    Parameters
    ----------
    origins : iterable of dict
        What `gbid.core.hdf5.read_made_with` returns for each file.
    """
    values: dict[str, dict[str, None]] = {}
    for origin in origins:
        words: dict[str, str] = {key: value for key, value in origin.items() if isinstance(value, str)}
        if "experiment" in origin:
            words["experiment"] = f"{origin['experiment']['file']} (sha256 {origin['experiment']['sha256']})"
        for key, seed in origin.get("seeds", {}).items():
            words[f"seed ({key})"] = str(seed)
        for text in words:
            values.setdefault(text, {})[words[text]] = None
        for file, digest in origin.get("data", {}).items():
            values.setdefault("data", {})[f"{file} (sha256 {digest})"] = None
    rows: list[list[Entry]] = [[key, "\n".join(each)] for key, each in values.items()]
    return Table("made with", [Column(""), Column("", wrap=True)], rows)
