"""Results as plain rows, in SI: the same for tables on a terminal and for programs that read JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gbid.errors import UsageError
from gbid.identify import FitResult
from gbid.prefilter import PrefilterReport
from gbid.structure import LinearModel

Row = dict[str, Any]


def parameter_rows(result: FitResult, truth: Mapping[str, float]) -> list[Row]:
    """Estimates with their standard deviations and, where known, the truth.

    Parameters
    ----------
    result : FitResult
    truth : dict of str to float
        True values of some parameters; may be empty.

    Returns
    -------
    list of dict
        parameter, estimate, std, truth, deviation_std (in standard deviations), deviation_percent, unit, fixed.
        What is not known is None; so is the standard deviation of a parameter that has none.
    """
    rows = []
    for name, estimate in result.parameters.items():
        std, true = result.std[name], truth.get(name)
        off = None if true is None else estimate - true
        rows.append(
            {
                "parameter": name,
                "estimate": estimate,
                "std": std if np.isfinite(std) else None,
                "truth": true,
                "deviation_std": off / std if off is not None and np.isfinite(std) and std > 0 else None,
                "deviation_percent": 100 * off / abs(true) if off is not None and true else None,
                "unit": result.units[name],
                "fixed": name not in result.free,
            }
        )
    return rows


def mode_rows(model: LinearModel, truth: LinearModel | None) -> list[Row]:
    """Natural frequencies and damping factors with their true values, by rising frequency."""
    modes = model.modes()
    true = truth.modes() if truth is not None else []
    if len(true) != len(modes):
        true = []
    return [
        {
            "mode": i + 1,
            "frequency_hz": frequency,
            "damping": damping,
            "true_frequency_hz": true[i][0] if true else None,
            "true_damping": true[i][1] if true else None,
        }
        for i, (frequency, damping) in enumerate(modes)
    ]


def gain_rows(model: LinearModel, truth: LinearModel | None) -> list[Row]:
    """List static gains with their true values; none for a model that integrates."""
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
            "truth": None if true is None else float(true[i, j]),
        }
        for i, output in enumerate(model.output_names)
        for j, source in enumerate(model.input_names)
    ]


def fit_percent_rows(result: FitResult) -> list[Row]:
    """Fit of each output of each recording."""
    return [
        {"recording": recording, "output": output, "fit_percent": float(result.fit_percent[i, j])}
        for i, recording in enumerate(result.recordings)
        for j, output in enumerate(result.model.output_names)
    ]


def prefilter_rows(reports: Iterable[PrefilterReport]) -> list[Row]:
    """Tell what the prefilter took out of each channel of p [m]."""
    return [
        {
            "recording": report.name,
            "channel": f"p_{channel}",
            "rms_before": float(report.rms_before["p"][i]),
            "rms_after": float(report.rms_after["p"][i]),
            "offset": float(report.offsets["p"][i]),
            "runout_share": float(report.runout_share[i]),
            "harmonics": [float(amplitude) for amplitude in report.harmonics[:, i]],
            "spikes": report.spikes[i],
            "notes": list(report.notes),
        }
        for report in reports
        for i, channel in enumerate(report.channels["p"])
    ]


def fit_document(result: FitResult, truth: Mapping[str, float], true_model: LinearModel | None) -> Row:
    """Everything a reader wants to know about a fit."""
    return {
        "structure": result.structure,
        "recordings": list(result.recordings),
        "status": result.status,
        "success": result.success,
        "iterations": result.iterations,
        "wall_time_s": result.wall_time_s,
        "loss": result.loss,
        "options": dict(result.options),
        "parameters": parameter_rows(result, truth),
        "modes": mode_rows(result.model, true_model),
        "static_gain": gain_rows(result.model, true_model),
        "fit_percent": fit_percent_rows(result),
        "notes": list(result.notes),
    }
