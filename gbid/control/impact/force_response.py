"""Response of a model to a measured force, which enters the rotor without delay and actuators (paper, Sec. 5.1)."""

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
    r"""Simulate the disc under the force of some impacts, for a mass of 1 kg.

    .. math:: p = G_b f \quad\text{(open loop, Eq. 8)}, \qquad p = S_o G_b f \quad\text{(closed loop, Eq. 22)}

    Parameters
    ----------
    plant : LinearModel
        Continuous, from r (or u) to p. In open loop its input does not matter.
    controller : LinearModel or None
        From p to r. Continuous: the loop of the paper, which needs a plant without exact delays. Sampled: the loop as
        it runs, r held over each sample, exact delays allowed.
    pulses : sequence of Pulse
    n_samples : int
    sample_time : float
        [s].
    computation_s : float, optional
        Time from the sample of p to the change of r, sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Where a force per mass enters the plant; found by `force_entry` when not given.

    Returns
    -------
    (n_samples, 2) array
        [m kg].

    Raises
    ------
    UsageError
        When the models do not fit together, or the loop is unstable.
    """
    E = force_entry(plant) if entry is None else np.asarray(entry, float)
    n = plant.n_states
    if E.shape != (n, 2):
        raise UsageError(f"impact: the force enters {plant.name!r} by shape {E.shape}, expected ({n}, 2)")
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
                "controller (sample_controller), or make states of the delays, with_pade(plant, order)"
            )
        closed = close_loop(plant, controller)
        A, C = np.array(closed.A), np.array(closed.C)
        E = np.vstack([E, np.zeros((controller.n_states, 2))])
        F = expm(A * sample_time)
    if (np.abs(np.linalg.eigvals(F)) >= 1).any():
        what = plant.name if controller is None else f"{plant.name}, closed by {controller.name}"
        raise UsageError(f"impact: {what!r} is unstable, so there is no response to compare with")
    # the plant's own states come first in every loop, and between samples only they see the force
    forcing = np.zeros((n_samples, len(F)))
    forcing[:, : len(A)] = pulse_forcing(A, E, pulses, n_samples, sample_time)
    return np.asarray(propagate(F, forcing, np.zeros(len(F))) @ C.T)
