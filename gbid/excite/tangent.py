"""Structure that is linear in its parameters, with the values and derivatives of a fitted model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.identify import FitResult
from gbid.identify.curves.uncertain_model import ModelSlopes
from gbid.structure import LinearStructure, Parameter
from gbid.structure.parameter import Values


def tangent_structure(fit: FitResult) -> tuple[LinearStructure, list[int]]:
    """Return the structure whose matrices are the tangents of those of a fit, and the parameters that act in it.

    Its matrices are ``A(p) = A + sum dA/dp_i (p_i - p_i0)``, and so on. At the estimates it has the same predictions
    with the same derivatives as the structure of the fit, so it has the same information. A stored fit knows its
    derivatives, but not the equations.

    Parameters
    ----------
    fit : FitResult
        Fit with derivatives of its model.

    Returns
    -------
    LinearStructure
        The parameters start at the estimates.
    list of int
        Their positions among the free parameters of the fit. Parameters of other recordings, trends and hum are not
        among them.
    """
    model, slopes = fit.linear_model, fit.model_slopes
    assert slopes is not None
    acting = [i for i in range(len(fit.free)) if any(part[i].any() for part in _parts(slopes).values())]
    names = {fit.free[i]: f"p{i}" if not fit.free[i].isidentifier() else fit.free[i] for i in acting}
    parameters = [
        Parameter(names[fit.free[i]], fit.parameters[fit.free[i]], unit=fit.units[fit.free[i]]) for i in acting
    ]
    values = {"A": model.A, "B": model.B, "C": model.C, "D": model.D}
    if model.K is not None:
        values["K"] = model.K
    elif slopes.K is not None:
        values["K"] = np.zeros(slopes.K.shape[1:])
    if model.B_delayed is not None and model.delay is not None:
        values |= {"B_delayed": model.B_delayed, "delay": model.delay[:, None]}

    def matrices(p: Values) -> Mapping[str, Any]:
        steps = [p[q.name] - q.start for q in parameters]
        return {letter: _moved(value, _parts(slopes).get(letter), acting, steps) for letter, value in values.items()}

    return LinearStructure(fit.structure, parameters, matrices, model.input_names, model.output_names), acting


def _parts(slopes: ModelSlopes) -> dict[str, FloatArray]:
    found = {"A": slopes.A, "B": slopes.B, "C": slopes.C, "D": slopes.D, "B_delayed": slopes.B_delayed}
    found["delay"] = slopes.delay[:, :, None]
    return found if slopes.K is None else {**found, "K": slopes.K}


def _moved(value: FloatArray, slope: FloatArray | None, acting: list[int], steps: list[Any]) -> ca.SX:
    result = ca.SX(ca.sparsify(ca.DM(np.array(value))))
    for i, step in zip(acting, steps, strict=True):
        if slope is not None and slope[i].any():
            result += ca.SX(ca.sparsify(ca.DM(np.array(slope[i])))) * step
    return result
