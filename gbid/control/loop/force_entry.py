"""Input matrix of a force on the rotor, which acts without delay and actuators (paper, Sec. 5.1)."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.structure import LinearModel


def force_entry(plant: LinearModel) -> FloatArray:
    r"""Return the input matrix of a force per mass on the rotor.

    Parameters
    ----------
    plant : LinearModel
        Continuous model. Its outputs must be positions that are states, and their derivatives must be states as well:
        any model of `gbid.RotorBearing` or `gbid.Plant` with the output p.

    Returns
    -------
    (n, n_outputs) array
        E of :math:`\dot x = A x + B r + E f / m`: one in the row of each velocity.

    Raises
    ------
    UsageError
        When positions and velocities cannot be identified in the matrices, or when the model is sampled.
    """
    where = f"force on model {plant.name!r}"
    if plant.dt is not None:
        raise UsageError(f"{where}: it is sampled; give the continuous model")
    entry = np.zeros((plant.n_states, plant.C.shape[0]))
    for i, row in enumerate(plant.C):
        position = _only_one(row)
        velocity = None if position is None else _only_one(plant.A[position])
        if velocity is None or plant.D[i].any():
            raise UsageError(
                f"{where}: output {plant.output_names[i]!r} is not a position whose velocity is a state; "
                "give the entry of the force yourself"
            )
        entry[velocity, i] = 1.0
    return entry


def static_force_gain(plant: LinearModel, entry: FloatArray | None = None) -> FloatArray:
    """Return the static motion per force and mass with constant references: the open-loop compliance times the mass.

    Parameters
    ----------
    plant : LinearModel
        Continuous model.
    entry : (n, n_outputs) array, optional
        Input matrix of a force per mass; see `force_entry`.

    Returns
    -------
    (n_outputs, n_outputs) array
        Static gain [m kg/N].
    """
    E = force_entry(plant) if entry is None else entry
    return np.asarray(-plant.C @ np.linalg.solve(plant.A, E))


def _only_one(row: FloatArray) -> int | None:
    """Return the index of the only nonzero entry of a row, if that entry is 1."""
    places = np.flatnonzero(row)
    return int(places[0]) if len(places) == 1 and row[places[0]] == 1.0 else None
