"""Response of a model to a measured force, which acts on the rotor without delay and actuators (paper, Sec. 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm

from gbid.arrays import FloatArray
from gbid.control.impact.measured import Pulse, pulse_forcing
from gbid.control.loop.close import close_loop
from gbid.control.loop.force_entry import force_entry
from gbid.control.loop.sampling import sample_plant
from gbid.discretise import propagate
from gbid.errors import UsageError
from gbid.structure import LinearModel


def force_response(
    plant: LinearModel,
    controller: LinearModel | None,
    pulses: Sequence[Pulse],
    n_samples: int,
    sample_time: float,
    *,
    computation_s: float | None = None,
    entry: FloatArray | None = None,
) -> FloatArray:
    r"""Return the simulated disc position after impacts, for a mass of 1 kg.

    .. math:: p = G_b f \quad\text{(open loop, Eq. 8)}, \qquad p = S_o G_b f \quad\text{(closed loop, Eq. 22)}

    Parameters
    ----------
    plant : LinearModel
        Continuous plant, from r (or u) to p. In open loop its input has no effect.
    controller : LinearModel or None
        Controller from p to r. A continuous controller gives the loop of the paper and needs a plant without exact
        delays. A sampled controller gives the sampled loop: r is held over each sample, and exact delays are allowed.
    pulses : sequence of Pulse
        Forces of the impacts.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    computation_s : float, optional
        Time from the sample of p to the change of r, for sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Input matrix of a force per mass; from `force_entry` when not given.

    Returns
    -------
    (n_samples, 2) array
        Disc position times mass [m kg].

    Raises
    ------
    UsageError
        When the models do not fit together, or when the loop is unstable.
    """
    E = force_entry(plant) if entry is None else np.asarray(entry, float)
    n = plant.n_states
    if E.shape != (n, 2):
        raise UsageError(f"impact: entry of the force on {plant.name!r} has shape {E.shape}, expected ({n}, 2)")
    A, C = np.array(plant.A), np.array(plant.C)
    if controller is None:
        F = expm(A * sample_time)
    elif controller.dt is not None:
        held = sample_plant(plant, sample_time, sample_time if computation_s is None else computation_s)
        closed = close_loop(held, controller)
        F, C = np.array(closed.A), np.array(closed.C)
    else:
        if plant.delay is not None:
            raise UsageError(
                f"model {plant.name!r} has exact delays and {controller.name!r} is continuous: give the sampled "
                "controller (sample_controller), or replace the delays: with_pade(plant, order)"
            )
        closed = close_loop(plant, controller)
        A, C = np.array(closed.A), np.array(closed.C)
        E = np.vstack([E, np.zeros((controller.n_states, 2))])
        F = expm(A * sample_time)
    if (np.abs(np.linalg.eigvals(F)) >= 1).any():
        what = plant.name if controller is None else f"{plant.name}, closed by {controller.name}"
        raise UsageError(f"impact: {what!r} is unstable, so there is no response to compare with")
    # The states of the plant come first in every loop. Between samples the force acts on them only.
    forcing = np.zeros((n_samples, len(F)))
    forcing[:, : len(A)] = pulse_forcing(A, E, pulses, n_samples, sample_time)
    return np.asarray(propagate(F, forcing, np.zeros(len(F))) @ C.T)
