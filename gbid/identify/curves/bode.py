"""Frequency response of a model with standard deviations, propagated from the covariance of its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief, Description, brief
from gbid.errors import UsageError
from gbid.identify.curves.uncertain_model import ModelLike, ModelSlopes, as_uncertain, std_of
from gbid.structure import LinearModel, frequency_grid
from gbid.tables.table import Column, Entry, Table

_STEPS_PER_TURN, _MOST_STEPS = 8, 20_000  # for the phase of a delay
LEVEL = 0.95
"""Usual probability of a confidence band."""


@dataclass(frozen=True, eq=False)
class Bode(Brief):
    """Frequency response of a model, with standard deviations.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    response : (n, n_outputs, n_inputs) complex array
        Frequency response, in units of the output per unit of the input.
    covariance : (n, n_outputs, n_inputs, 2, 2) array
        Covariance of real and imaginary part; nan for a model without uncertainty.
    magnitude, magnitude_std : (n, n_outputs, n_inputs) array
        Magnitude and its standard deviation.
    phase_deg, phase_std_deg : (n, n_outputs, n_inputs) array
        Phase without jumps, and its standard deviation [degrees].
    input_names, output_names : tuple of str
        Names of the channels.
    name : str
        Name of the model.
    """

    frequency_hz: FloatArray
    response: ComplexArray
    covariance: FloatArray
    magnitude: FloatArray
    magnitude_std: FloatArray
    phase_deg: FloatArray
    phase_std_deg: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    name: str

    def _brief(self) -> Description:
        about = f"{self.name}, {len(self.frequency_hz)} frequencies"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    @property
    def has_band(self) -> bool:
        """Whether there are standard deviations."""
        return bool(np.isfinite(self.magnitude_std).any())

    def magnitude_band(self, level: float = LEVEL) -> tuple[FloatArray, FloatArray]:
        """Return the limits of a confidence band of the magnitude at each frequency.

        Parameters
        ----------
        level : float
            Probability of the band.

        Returns
        -------
        lower, upper : (n, n_outputs, n_inputs) array
            Limits. They are symmetric in decibels, and so never negative.
        """
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            factor = np.exp(quantile(level) * self.magnitude_std / self.magnitude)
            return self.magnitude / factor, self.magnitude * factor

    def phase_band(self, level: float = LEVEL) -> tuple[FloatArray, FloatArray]:
        """Return the limits of a confidence band of the phase at each frequency.

        Parameters
        ----------
        level : float
            Probability of the band.

        Returns
        -------
        lower, upper : (n, n_outputs, n_inputs) array
            Limits [degrees].
        """
        half = quantile(level) * self.phase_std_deg
        return self.phase_deg - half, self.phase_deg + half

    def table(self, level: float = LEVEL) -> Table:
        """Return the numbers as a table, with a row for each output, input and frequency; for CSV.

        Parameters
        ----------
        level : float
            Probability of the confidence bands.

        Returns
        -------
        Table
        """
        bands = (*self.magnitude_band(level), *self.phase_band(level))
        numbers = (self.magnitude, self.magnitude_std, *bands[:2], self.phase_deg, self.phase_std_deg, *bands[2:])
        columns = (
            *(Column("output"), Column("input"), Column("frequency_hz", format=8)),
            *(Column(f"magnitude{kind}", format=6) for kind in ("", "_std", "_lower", "_upper")),
            *(Column(f"phase_deg{kind}", format=6) for kind in ("", "_std", "_lower", "_upper")),
        )
        rows: list[list[Entry]] = [
            [output, source, float(f), *(float(values[k, i, j]) for values in numbers)]
            for i, output in enumerate(self.output_names)
            for j, source in enumerate(self.input_names)
            for k, f in enumerate(self.frequency_hz)
        ]
        return Table(f"frequency response of {self.name}", columns, rows, (f"bands of {100 * level:g} %",))

    def to_frame(self) -> Any:
        """Return the table as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return self.table().to_frame()


def bode(source: ModelLike, frequency_hz: npt.ArrayLike | None = None) -> Bode:
    """Return the frequency response of a model with standard deviations.

    Parameters
    ----------
    source : LinearModel, FitResult or UncertainModel
        The model. A plain `LinearModel` has no standard deviations: they are nan.
    frequency_hz : (n,) array, optional
        Frequencies above zero [Hz], ascending; by default a grid that is dense around the poles.

    Returns
    -------
    Bode
        Values and standard deviations for each pair of input and output.

    Raises
    ------
    UsageError
        When a frequency is not above zero, or when an undamped pole lies exactly on it.

    Notes
    -----
    With ``R = (s I - A)^-1`` and ``X = R (B + B_d exp(-s tau))`` the derivative by a parameter is
    ``dG = dC X + C R (dA X + dB + (dB_d - s B_d d tau) exp(-s tau)) + dD``. The derivatives of the matrices are exact.
    The covariance of the real and imaginary part follows to first order (delta method); with
    ``dG / G = d ln|G| + i d arg G`` so do those of magnitude and phase. To first order is not enough where the
    standard deviation of a resonance frequency is as large as the width of the resonance.
    """
    uncertain = as_uncertain(source)
    model = uncertain.model
    f = default_grid(model) if frequency_hz is None else np.atleast_1d(np.asarray(frequency_hz, float))
    if not (f > 0).all():
        raise UsageError(f"frequency_hz of a Bode diagram must be above zero; the smallest is {f.min():g} Hz")
    response = model.frequency_response(f)
    known = uncertain.known()
    shape = response.shape
    covariance = np.full((*shape, 2, 2), np.nan)
    magnitude_std, phase_std = np.full(shape, np.nan), np.full(shape, np.nan)
    if known is not None:
        slopes = response_slopes(model, known[0], f)
        parts = np.stack([slopes.real, slopes.imag], axis=-1)
        covariance = np.einsum("pfyua,pq,qfyub->fyuab", parts, known[1], parts, optimize=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = slopes / response
        magnitude_std = np.abs(response) * std_of(relative.real, known[1])
        phase_std = std_of(np.degrees(relative.imag), known[1])
    return Bode(
        f,
        response,
        covariance,
        np.abs(response),
        magnitude_std,
        np.degrees(_unwrapped(model, f, response)),
        phase_std,
        model.input_names,
        model.output_names,
        model.name,
    )


def default_grid(model: LinearModel) -> FloatArray:
    """Return frequencies above zero that show the poles of a model [Hz]."""
    grid = frequency_grid(model)
    return np.asarray(grid[grid > 0])


def _unwrapped(model: LinearModel, f: FloatArray, response: ComplexArray) -> FloatArray:
    """Return the phase without jumps [rad]; between the frequencies steps are small enough for the longest delay."""
    longest = 0.0 if model.delay is None else float(model.delay.max(initial=0.0))
    turns = min(int(_STEPS_PER_TURN * longest * float(f.max() - f.min())), _MOST_STEPS)
    if turns < 2:
        return np.asarray(np.unwrap(np.angle(response), axis=0))
    fine, position = np.unique(np.concatenate([f, np.linspace(f.min(), f.max(), turns)]), return_inverse=True)
    phase = np.unwrap(np.angle(model.frequency_response(fine)), axis=0)
    return np.asarray(phase[position[: len(f)]])


def response_slopes(model: LinearModel, slopes: ModelSlopes, frequency_hz: FloatArray) -> ComplexArray:
    """Return the derivatives of the frequency response of a continuous-time model by its parameters.

    Parameters
    ----------
    model : LinearModel
        The model.
    slopes : ModelSlopes
        Derivatives of its matrices.
    frequency_hz : (n,) array
        Frequencies [Hz].

    Returns
    -------
    (n_free, n, n_outputs, n_inputs) complex array
        Derivatives.
    """
    s = 2j * np.pi * frequency_hz
    inverse = np.linalg.inv(s[:, None, None] * np.eye(model.n_states) - model.A)
    left = model.C @ inverse
    drive = np.broadcast_to(model.B, (len(s), *model.B.shape)).astype(complex)
    d_drive = np.broadcast_to(slopes.B[:, None], (len(slopes.B), *drive.shape)).astype(complex)
    if model.delay is not None and model.B_delayed is not None:
        late = np.exp(-s[:, None] * model.delay)[:, None]
        drive = drive + model.B_delayed * late
        d_drive = d_drive + slopes.B_delayed[:, None] * late
        d_drive -= (s[:, None, None] * late * model.B_delayed) * slopes.delay[:, None, None]
    states = inverse @ drive
    return np.asarray(
        np.einsum("pyn,fnu->pfyu", slopes.C, states, optimize=True)
        + np.einsum("fyn,pnm,fmu->pfyu", left, slopes.A, states, optimize=True)
        + np.einsum("fyn,pfnu->pfyu", left, d_drive, optimize=True)
        + slopes.D[:, None]
    )


def quantile(level: float) -> float:
    """Return the half width of a confidence interval in standard deviations.

    Raises
    ------
    UsageError
        When the level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise UsageError(f"level = {level}; a probability must lie between 0 and 1, as 0.95")
    return NormalDist().inv_cdf(0.5 + level / 2)
