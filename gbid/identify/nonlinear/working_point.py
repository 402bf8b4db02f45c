"""Linear model at the working point of a nonlinear fit, with derivatives by the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Dual
from gbid.identify.data import FitData
from gbid.identify.nlp.shooting import Shooting
from gbid.structure import NonlinearModel


def at_working_point(
    model: NonlinearModel, problem: Shooting, theta: FloatArray, starts: FloatArray, data: FitData
) -> NonlinearModel:
    """Return the model with the means over the recordings as its working point, and the steps of the fit.

    Parameters
    ----------
    model : NonlinearModel
        Model at the estimates.
    problem : Shooting
        Problem of the fit.
    theta, starts : (n_p,) and (n_windows, n) array
        Its solution.
    data : FitData
        Data of the fit.
    """
    n, values = model.n_states, problem.values(theta)
    firsts = zip(problem.first_window[:-1], problem.first_window[1:], strict=True)
    states = [
        np.concatenate(part.blocks.by_segment(part.kernel.predict(v, part.blocks, starts[a:b]).states))[:, :n]
        for part, v, (a, b) in zip(problem.parts, values, firsts, strict=True)
    ]
    every = np.concatenate(states)
    inputs = np.concatenate([record.inputs for record in data.records])
    if not np.isfinite(every).all():
        return replace(model, steps=values[0].steps)
    size = np.sqrt(np.mean(every**2, axis=0))
    return replace(
        model,
        steps=values[0].steps,
        working_state=every.mean(axis=0),
        working_input=inputs.mean(axis=0),
        state_size=np.where(size > 0, size, 1.0),
    )


def linearised(model: NonlinearModel, names: Sequence[str], free: Sequence[str]) -> list[Dual]:
    """Return A, B, C and D at the working point with their derivatives, the working point as it is.

    Parameters
    ----------
    model : NonlinearModel
        The model.
    names : sequence of str
        Names of the parameters of its structure.
    free : sequence of str
        Parameters of the derivatives; zero for those that are none of the structure.
    """
    x, u, p = (ca.SX.sym("s", size) for size in (model.n_states, len(model.input_names), len(names)))
    found = []
    for output in model.function(x, u, p):
        for at in (x, u):
            slopes = ca.densify(ca.jacobian(output, at))
            function = ca.Function("m", [x, u, p], [slopes, ca.densify(ca.jacobian(slopes, p))])
            value, by = (
                np.asarray(m, float) for m in function(model.working_state, model.working_input, model.parameters)
            )
            value = value.reshape(slopes.shape)
            every = by.T.reshape(len(names), *value.shape[::-1]).transpose(0, 2, 1)  # CasADi stacks columns
            own = np.zeros((len(free), *value.shape))
            for i, name in enumerate(free):
                if name in names:
                    own[i] = every[names.index(name)]
            found.append(Dual(value, own))
    return found
