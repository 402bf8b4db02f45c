"""Start values of disturbances, and data without them for start values of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gbid.discretise import Hold
from gbid.identify.data import FitData
from gbid.identify.disturbances.disturbances import Disturbances
from gbid.structure import AnyStructure, model_of

_RUNAWAY = 1e3  # size of a simulation, in that of the outputs, beyond which the model counts as unstable


def disturbance_starts(
    disturbances: Disturbances,
    structure: AnyStructure,
    begin: Mapping[str, float],
    data: FitData,
    intersample: Hold | Sequence[Hold],
) -> list[dict[str, float]]:
    """Return start values for each record: least squares on the residuals of a simulation of the model.

    Parameters
    ----------
    disturbances : Disturbances
        The disturbances.
    structure : Structure
        Structure of the fit.
    begin : dict of str to float
        Start values of its parameters.
    data : FitData
        Data of the fit.
    intersample : {"zoh", "foh"} or sequence of these
        Behaviour of the inputs between samples.

    Returns
    -------
    list of dict of str to float
        Coefficients and gains by name. The offset is that of the median, because the first samples contain the
        response to the initial state. An unstable model counts as zero.
    """
    gains = {q.name: float(q.start or 0.0) for q in disturbances.walk_gains(data.sample_time)}
    if not disturbances.terms:
        return [gains for _ in data.records]
    model, starts = model_of(structure, begin), []
    for record in data.records:
        left = record.outputs - model.simulate(record.inputs, data.sample_time, intersample=intersample)
        if not np.abs(left).max() < _RUNAWAY * np.abs(record.outputs).max():
            left = record.outputs
        columns = disturbances.regressors(record.n_samples, data.sample_time)
        found = disturbances.closest(left, columns)
        rest = np.median(left - columns @ found.T, axis=0)
        found[:, 0] += rest * [trend.n_terms > 0 for trend in disturbances.trends]
        values = found[disturbances.places].tolist()
        starts.append({**gains, **{term.name: v for term, v in zip(disturbances.terms, values, strict=True)}})
    return starts


def without_disturbances(disturbances: Disturbances, data: FitData) -> FitData:
    """Return the data less drift and hum, which would spoil start values that are found in the data.

    The fit itself uses the data as they are. Offsets alone are left, because start values do not depend on them.
    """
    known = disturbances.instead_of_walks(2)
    if known.n_columns < 2:
        return data
    records = []
    for record in data.records:
        columns = known.regressors(record.n_samples, data.sample_time)
        course = columns @ known.closest(record.outputs, columns).T
        records.append(replace(record, outputs=record.outputs - course))
    return replace(data, records=tuple(records))
