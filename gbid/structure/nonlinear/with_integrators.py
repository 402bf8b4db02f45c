"""Nonlinear model with offsets of its outputs as states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from gbid.structure.nonlinear.nonlinear_model import NonlinearModel


def with_integrators(model: NonlinearModel, outputs: Sequence[int], gains: Sequence[float]) -> NonlinearModel:
    """Return a model with one more state for each of these outputs: an offset that the error drives with a gain."""
    n, added = model.n_states, len(outputs)
    sizes = (n + added, len(model.input_names), len(model.parameters))
    x, u, p = (ca.SX.sym("s", size) for size in sizes)
    dx, y = model.function(x[:n], u, p)
    onto = np.zeros((len(model.output_names), added))
    onto[list(outputs), np.arange(added)] = 1.0
    function = ca.Function("equations", [x, u, p], [ca.vertcat(dx, ca.SX.zeros(added)), y + ca.DM(onto) @ x[n:]])
    return replace(
        model,
        equations=function.serialize(),
        K=np.vstack([model.K, np.asarray(gains)[:, None] * onto.T]),
        state_names=(*model.state_names, *(f"offset_{model.output_names[output]}" for output in outputs)),
        working_state=np.concatenate([model.working_state, np.zeros(added)]),
        state_size=np.concatenate([model.state_size, np.ones(added)]),
    )
