"""Frequency response curves of a loop (paper, Figs. 20 and 21)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief
from gbid.control.loop.norm import largest_singular_values
from gbid.control.loop.sensitivity import sensitivities
from gbid.structure import LinearModel


@dataclass(frozen=True, eq=False)
class SensitivityData(Brief):
    """Frequency responses of a loop, channel by channel.

    Attributes
    ----------
    frequency_hz : (n_frequencies,) array
        Frequencies [Hz].
    output : (n_frequencies, 2, 2) array
        S_o (Fig. 20).
    control : (n_frequencies, 2, 2) array
        K S_o (Fig. 20).
    open_loop : (n_frequencies, 2, 2) array
        G (Fig. 21).
    plant : (n_frequencies, 2, 2) array
        S_o G (Fig. 21).
    output_largest, control_largest : (n_frequencies,) array
        Largest singular values of S_o and K S_o.
    input_names, output_names : tuple of str
        Channels of r and p.
    """

    frequency_hz: FloatArray
    output: ComplexArray
    control: ComplexArray
    open_loop: ComplexArray
    plant: ComplexArray
    output_largest: FloatArray
    control_largest: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]


def sensitivity_data(
    plant: LinearModel, controller: LinearModel, frequency_hz: npt.ArrayLike | None = None
) -> SensitivityData:
    """Return the curves of Figs. 20 and 21.

    Parameters
    ----------
    plant, controller : LinearModel
        G from r to p (exact delays allowed) and K from p to r.
    frequency_hz : (n_frequencies,) array, optional
        Frequencies [Hz]; by default 600 from 1 to 1000 Hz with logarithmic spacing.

    Returns
    -------
    SensitivityData

    Raises
    ------
    UsageError
        When the two do not form a loop, or when frequencies are not finite.
    """
    f = np.geomspace(1.0, 1000.0, 600) if frequency_hz is None else np.atleast_1d(np.asarray(frequency_hz, float))
    loop = sensitivities(plant, controller)
    output, control = loop.response("output", f), loop.response("control", f)
    return SensitivityData(
        f,
        output,
        control,
        plant.frequency_response(f),
        loop.response("plant", f),
        largest_singular_values(output),
        largest_singular_values(control),
        plant.input_names,
        plant.output_names,
    )
