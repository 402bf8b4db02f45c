"""Document of a fit: plain values in SI units for tables and JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from gbid.errors import UsageError
from gbid.identify import FitResult
from gbid.structure import LinearModel
from gbid.tables.numbers import finite_or_none

Row = dict[str, Any]


def parameter_rows(result: FitResult, truth: Mapping[str, float]) -> list[Row]:
    """Return estimates with standard deviations and, where known, true values.

    Parameters
    ----------
    result : FitResult
        Result of the fit.
    truth : dict of str to float
        True values of some parameters; may be empty.

    Returns
    -------
    list of dict
        parameter, estimate, std (the one to use), std_white, std_robust, std_bootstrap (where there is one), truth,
        deviation_std (in standard deviations), deviation_percent, unit, fixed, start, start_origin. Unknown values are
        None, also the standard deviation of a parameter without one.
    """
    rows = []
    by_kind = {"std_white": result.std_with("white"), "std_robust": result.std_with("robust")}
    if result.covariance_bootstrap is not None:
        by_kind["std_bootstrap"] = result.std_with("bootstrap")
    for name, estimate in result.parameters.items():
        std, true = result.std[name], truth.get(name)
        off = None if true is None else estimate - true
        rows.append(
            {
                "parameter": name,
                "estimate": estimate,
                "std": finite_or_none(std),
                **{key: finite_or_none(own[name]) for key, own in by_kind.items()},
                "truth": true,
                "deviation_std": off / std if off is not None and np.isfinite(std) and std > 0 else None,
                "deviation_percent": 100 * off / abs(true) if off is not None and true else None,
                "unit": result.units[name],
                "fixed": name not in result.free,
                "start": result.start[name],
                "start_origin": result.start_origin[name],
            }
        )
    return rows


def mode_rows(result: FitResult, truth: LinearModel | None) -> list[Row]:
    """Return natural frequencies and damping factors with standard deviations and true values, by rising frequency."""
    modes = result.model.modes()
    true = truth.modes() if truth is not None else []
    if len(true) != len(modes):
        true = []
    return [
        {
            "mode": i + 1,
            "frequency_hz": frequency,
            "frequency_std_hz": finite_or_none(result.modes_std[i, 0]),
            "damping": damping,
            "damping_std": finite_or_none(result.modes_std[i, 1]),
            "true_frequency_hz": true[i][0] if true else None,
            "true_damping": true[i][1] if true else None,
        }
        for i, (frequency, damping) in enumerate(modes)
    ]


def gain_rows(result: FitResult, truth: LinearModel | None) -> list[Row]:
    """Return static gains with standard deviations and true values; empty for a model with a pole at zero."""
    model = result.model
    try:
        gain = model.static_gain()
    except UsageError:
        return []
    true = truth.static_gain() if truth is not None else None
    return [
        {
            "output": output,
            "input": source,
            "gain": float(gain[i, j]),
            "std": finite_or_none(result.static_gain_std[i, j]),
            "truth": None if true is None else float(true[i, j]),
        }
        for i, output in enumerate(model.output_names)
        for j, source in enumerate(model.input_names)
    ]


def fit_percent_rows(result: FitResult) -> list[Row]:
    """Return the fit percent of each output of each recording."""
    return [
        {"recording": recording, "output": output, "fit_percent": float(result.fit_percent[i, j])}
        for i, recording in enumerate(result.recordings)
        for j, output in enumerate(result.model.output_names)
    ]


def whiteness_rows(result: FitResult) -> list[Row]:
    """Return the p-value of the whiteness test of each output."""
    return [
        {"output": output, "p_value": finite_or_none(p)}
        for output, p in zip(result.model.output_names, result.whiteness, strict=True)
    ]


def multi_start_row(result: FitResult) -> Row | None:
    """Return the counts of the fits from several starts; None for a fit from one start."""
    if result.multi_start is None:
        return None
    return {**asdict(result.multi_start), "spread": finite_or_none(result.multi_start.spread)}


def fit_document(result: FitResult, truth: Mapping[str, float], true_model: LinearModel | None) -> Row:
    """Return the document of a fit."""
    return {
        "structure": result.structure,
        "recordings": list(result.recordings),
        "status": result.status,
        "success": result.success,
        "iterations": result.iterations,
        "wall_time_s": result.wall_time_s,
        "loss": result.loss,
        "aic": finite_or_none(result.aic),
        "fpe": finite_or_none(result.fpe),
        "condition": finite_or_none(result.condition),
        "trusted": result.trusted,
        "whiteness": whiteness_rows(result),
        "multi_start": multi_start_row(result),
        "options": asdict(result.options),
        "parameters": parameter_rows(result, truth),
        "modes": mode_rows(result, true_model),
        "static_gain": gain_rows(result, true_model),
        "fit_percent": fit_percent_rows(result),
        "notes": list(result.notes),
    }
