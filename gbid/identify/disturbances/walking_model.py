"""Model with the random walks of its outputs as states, for predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gbid.identify.disturbances.disturbances import Disturbances
from gbid.structure import LinearModel, NonlinearModel
from gbid.structure.nonlinear.with_integrators import with_integrators


def with_walking_offsets(
    model: LinearModel | NonlinearModel, disturbances: Disturbances, parameters: Mapping[str, float]
) -> LinearModel | NonlinearModel:
    """Return a model with one more state for each output whose offset is a random walk.

    Parameters
    ----------
    model : LinearModel or NonlinearModel
        Fitted model in continuous time.
    disturbances : Disturbances
        Disturbances of the fit.
    parameters : dict of str to float
        Parameters of the fit, with the gains of the random walks.

    Returns
    -------
    LinearModel or NonlinearModel
        Its last states are the offsets. Without random walks it is the model itself.
    """
    walking = list(disturbances.walking)
    if not walking:
        return model
    if isinstance(model, NonlinearModel):
        gains = [parameters[disturbances.gain_name(output)] for output in walking]
        return with_integrators(model, walking, gains)
    n, (n_y, n_u), added = model.n_states, model.D.shape, len(walking)
    A, C, K = np.zeros((n + added,) * 2), np.zeros((n_y, n + added)), np.zeros((n + added, n_y))
    A[:n, :n], C[:, :n] = model.A, model.C
    K[:n] = 0.0 if model.K is None else model.K
    for state, output in enumerate(walking, start=n):
        C[output, state] = 1.0
        K[state, output] = parameters[disturbances.gain_name(output)]
    still = np.zeros((added, n_u))
    late = None if model.B_delayed is None else np.vstack([model.B_delayed, still])
    return replace(model, A=A, B=np.vstack([model.B, still]), C=C, K=K, B_delayed=late, state_names=())
