"""Static map of the rotor on its bearing (paper, Sec. 3.1 and Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from scipy.special import stdtrit

from gbid.arrays import FloatArray, IntArray
from gbid.brief import Brief, Description, brief
from gbid.errors import UsageError
from gbid.hdf5 import Stored


@dataclass(frozen=True, eq=False)
class StaticMap(Brief):
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

    gain: Annotated[FloatArray, Stored("gain", "static gains", "outputs inputs")]
    covariance: Annotated[FloatArray, Stored("gain^2", "covariance of the gains, row by row", "gains gains")]
    offset: Annotated[FloatArray, Stored("out", "equilibrium without input, for each recording", "recordings outputs")]
    dof: int
    rms: Annotated[FloatArray, Stored("out", "rms deviation from linear", "outputs inputs")]
    largest: Annotated[FloatArray, Stored("out", "largest deviation from linear", "outputs inputs")]
    hysteresis: Annotated[FloatArray, Stored("out", "largest difference between up and down branch", "outputs inputs")]
    hysteresis_std: Annotated[FloatArray, Stored("out", "standard error of the hysteresis", "outputs inputs")]
    recording: Annotated[IntArray, Stored("1", "number of the recording", "plateaus")]
    axis: Annotated[IntArray, Stored("1", "input whose staircase it belongs to; -1 rest, -2 several", "plateaus")]
    direction: Annotated[IntArray, Stored("1", "way of the last step", "plateaus")]
    command: Annotated[FloatArray, Stored("in", "level of the command", "plateaus inputs")]
    input_mean: Annotated[FloatArray, Stored("in", "steady input", "plateaus inputs")]
    input_std: Annotated[FloatArray, Stored("in", "standard error of the steady input", "plateaus inputs")]
    output_mean: Annotated[FloatArray, Stored("out", "steady output", "plateaus outputs")]
    output_std: Annotated[FloatArray, Stored("out", "standard error of the steady output", "plateaus outputs")]
    residual: Annotated[FloatArray, Stored("out", "deviation from linear", "plateaus outputs")]
    drift: Annotated[FloatArray, Stored("out", "change over the steady part", "plateaus outputs")]
    time: Annotated[FloatArray, Stored("s", "begin and end of the steady part", "plateaus 2")]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    units: tuple[str, str]
    conditions: Mapping[str, float] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def _brief(self) -> Description:
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
