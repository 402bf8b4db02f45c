"""Static map of the rotor on its bearing (paper, Sec. 3.1 and Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import stdtrit

from gbid.arrays import FloatArray
from gbid.brief import brief
from gbid.errors import UsageError


@dataclass(frozen=True, eq=False)
class StaticMap:
    r"""Steady positions over steady inputs, and the straight lines fitted to them.

    .. math:: \bar p_{i,k} = \sum_j g_{ij} \bar u_{j,k} + c_{i,m(k)} + e_{i,k}

    for plateau k of recording m. It is made by `characterise_staircase`. Inputs and outputs are in `units`.

    Attributes
    ----------
    gain : (n_outputs, n_inputs) array
        Static gain g; NaN for an input that no recording moves.
    covariance : (n_outputs * n_inputs, n_outputs * n_inputs) array
        Covariance of the gains, row by row (g_xx, g_xy, g_yx, g_yy); NaN where the gain is NaN.
    offset : (n_recordings, n_outputs) array
        c, the equilibrium without input, of each recording.
    dof : int
        Degrees of freedom: plateaus minus unknowns per output.
    rms, largest : (n_outputs, n_inputs) array
        Root mean square and largest deviation e of output i from a straight line on the staircase of input j (Sec.
        3.1).
    hysteresis, hysteresis_std : (n_outputs, n_inputs) array
        Largest difference of e between the up and the down branch at the same input, and its standard error. It is the
        largest of many values, so noise alone gives up to about three standard errors.
    recording : (n_plateaus,) array
        Number of the recording of each plateau.
    axis : (n_plateaus,) array
        Input whose staircase contains the plateau. -1 is rest, which counts for every input. -2 means that several
        inputs are away from rest; such a plateau counts for the gain, but not for the deviations.
    direction : (n_plateaus,) array
        1 when the last step was up, -1 when it was down, 0 before the first step.
    command : (n_plateaus, n_inputs) array
        Level of the reference.
    input_mean, input_std : (n_plateaus, n_inputs) array
        Steady mean of the input and its standard error.
    output_mean, output_std, residual : (n_plateaus, n_outputs) array
        Steady mean of the output, its standard error, and e.
    drift : (n_plateaus, n_outputs) array
        Change of the output over the steady part.
    time : (n_plateaus, 2) array
        Start and end of the steady part [s].
    input_names, output_names : tuple of str
        Names of the channels, ``"u_x"`` and so on.
    units : tuple of str
        Units of input and output.
    conditions : dict of str to float
        Operating point.
    sources : tuple of str
        Names of the recordings.
    notes : tuple of str
        Remarks for the reader of the result.
    """

    gain: FloatArray
    covariance: FloatArray
    offset: FloatArray
    dof: int
    rms: FloatArray
    largest: FloatArray
    hysteresis: FloatArray
    hysteresis_std: FloatArray
    recording: FloatArray
    axis: FloatArray
    direction: FloatArray
    command: FloatArray
    input_mean: FloatArray
    input_std: FloatArray
    output_mean: FloatArray
    output_std: FloatArray
    residual: FloatArray
    drift: FloatArray
    time: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    units: tuple[str, str]
    conditions: Mapping[str, float] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return brief(
            self,
            f"{len(self.sources)} recordings, {len(self.axis)} plateaus",
            input_names=self.input_names,
            output_names=self.output_names,
            gain=self.gain,
            rms=self.rms,
            largest=self.largest,
            hysteresis=self.hysteresis,
            notes=self.notes,
        )

    @property
    def gain_std(self) -> FloatArray:
        """Standard deviations of the gains, (n_outputs, n_inputs)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)).reshape(self.gain.shape))

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return confidence intervals of the gains, from Student's t distribution.

        Parameters
        ----------
        level : float
            Confidence level between 0 and 1.

        Returns
        -------
        (n_outputs, n_inputs, 2) array
            Lower and upper ends.

        Raises
        ------
        UsageError
            When `level` is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise UsageError(f"level = {level}; give a share between 0 and 1")
        half = stdtrit(self.dof, 0.5 + level / 2) * self.gain_std
        return np.stack([self.gain - half, self.gain + half], axis=-1)

    def panel(self, output: int, source: int) -> dict[str, FloatArray]:
        """Return the arrays of one panel of Fig. 5: output i over input j.

        Parameters
        ----------
        output, source : int
            i and j.

        Returns
        -------
        dict of str to array
            ``input``, ``output`` (without the offset and without the effect of the other inputs), ``std`` and
            ``direction`` of the plateaus of that staircase in the order of time, and ``line_input`` and
            ``line_output`` (two points).
        """
        with_stairs = np.isin(self.recording, self.recording[self.axis == source])
        chosen = with_stairs & ((self.axis == source) | (self.axis == -1))
        u = self.input_mean[chosen, source]
        ends = np.array([u.min(), u.max()]) if u.size else np.zeros(2)
        return {
            "input": u,
            "output": self.gain[output, source] * u + self.residual[chosen, output],
            "std": self.output_std[chosen, output],
            "direction": self.direction[chosen],
            "line_input": ends,
            "line_output": self.gain[output, source] * ends,
        }
