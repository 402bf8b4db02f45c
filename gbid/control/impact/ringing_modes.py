"""Dominant modes of a ring-down: the modes of a loop that an impact excites most."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.loop.close import close_loop
from gbid.control.loop.force_entry import force_entry
from gbid.control.loop.sampling import sample_plant
from gbid.errors import UsageError
from gbid.poles import one_of_each_pair, oscillatory_modes
from gbid.structure import LinearModel

Modes = tuple[tuple[float, float], ...]


def ringing_modes(
    plant: LinearModel,
    controller: LinearModel | None = None,
    *,
    count: int = 2,
    computation_s: float | None = None,
    entry: FloatArray | None = None,
) -> Modes:
    r"""Return the oscillatory modes that contribute most to the impulse responses from force to position.

    A mode with poles :math:`\lambda, \bar\lambda` and residue R contributes
    :math:`2 \mathrm{Re}(R e^{\lambda t})`, of energy about :math:`|R|^2 / |\mathrm{Re} \lambda|`. A bearing has two
    modes; a loop also has those of actuators and filters.

    Parameters
    ----------
    plant : LinearModel
        Continuous, from r (or u) to p.
    controller : LinearModel, optional
        Controller from p to r. A sampled controller gives the modes of the sampled loop, with the exact delays of the
        plant if it has any.
    count : int
        Number of modes.
    computation_s : float, optional
        Time from the sample of p to the change of r, sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Input matrix of a force per mass; from `force_entry` when not given.

    Returns
    -------
    tuple of (frequency_hz, damping)
        Modes by rising frequency.

    Raises
    ------
    UsageError
        When models do not fit together.
    """
    E = force_entry(plant) if entry is None else np.asarray(entry, float)
    model = plant
    if controller is not None and controller.dt is not None:
        late = controller.dt if computation_s is None else computation_s
        model = close_loop(sample_plant(plant, controller.dt, late), controller)
    elif controller is not None:
        if plant.delay is not None:
            raise UsageError(f"model {plant.name!r} has exact delays; give the sampled controller")
        model = close_loop(plant, controller)
    E = np.vstack([E, np.zeros((model.n_states - len(E), E.shape[1]))])
    values, vectors = np.linalg.eig(model.A)
    residues = np.einsum("im,mj->mij", model.C @ vectors, np.linalg.pinv(vectors) @ E)
    there = np.abs(values) > 1e-9 if model.dt is not None else np.ones(len(values), dtype=bool)
    values, residues = values[there].astype(complex), residues[there]  # those of shift registers decay at once
    poles = values if model.dt is None else np.log(values) / model.dt
    keep = np.flatnonzero(one_of_each_pair(poles))
    energy = (np.abs(residues[keep]) ** 2).sum(axis=(1, 2)) / np.maximum(np.abs(poles[keep].real), 1e-9)
    chosen = poles[keep[np.argsort(-energy)[:count]]]
    return tuple((frequency, damping) for frequency, damping in oscillatory_modes(chosen).tolist())
