"""Frequency and time responses, poles and zeros of a model, with standard deviations from its parameters."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from math import log, sqrt
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive
from gbid.core.tables import Column, Entry, Table
from gbid.discretise.dual import Dual, constant
from gbid.discretise.exact import discretise
from gbid.identify.uncertainty.uncertain_model import (
    ModelLike,
    ModelSlopes,
    UncertainModel,
    as_uncertain,
    plane_covariance,
    std_of,
)
from gbid.structure import LinearModel
from gbid.structure.models import frequency_grid, phase_in_degrees

LEVEL = 0.95
"""Usual probability of a confidence band."""


class Tabled(Brief):
    """Base of values that have a table of numbers."""

    @abstractmethod
    def table(self) -> Table:
        """Return the numbers of this value as one table."""

    def tables(self) -> list[Table]:
        """Return the tables of this value: its one table."""
        return [self.table()]

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


class ChannelCurves(Tabled):
    """Base of curves with a value for each pair (output, input)."""

    input_names: tuple[str, ...]
    output_names: tuple[str, ...]

    def _rows(self, points: FloatArray, *values: FloatArray) -> list[list[Entry]]:
        """Return a row for each output, input and point (n,), from values (n, n_outputs, n_inputs)."""
        return [
            [output, source, float(point), *(float(each[k, i, j]) for each in values)]
            for i, output in enumerate(self.output_names)
            for j, source in enumerate(self.input_names)
            for k, point in enumerate(points)
        ]


def _columns(first: Sequence[str], numbers: Sequence[str]) -> list[Column]:
    """Return table columns: text columns, and number columns with six digits."""
    return [*map(Column, first), *(Column(name, format=6) for name in numbers)]


@dataclass(frozen=True, eq=False)
class Bode(ChannelCurves):
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
        Phase without jumps, counted from the poles (see `phase_in_degrees`), and its standard deviation [degrees].
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
        """Whether standard deviations are known."""
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
        """Return a table for CSV with a row for each output, input and frequency.

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
        names = [f"{value}{kind}" for value in ("magnitude", "phase_deg") for kind in ("", "_std", "_lower", "_upper")]
        columns = _columns(("output", "input"), ("frequency_hz", *names))
        columns[2] = Column("frequency_hz", format=8)
        rows = self._rows(self.frequency_hz, *numbers)
        return Table(f"frequency response of {self.name}", columns, rows, (f"bands of {100 * level:g} %",))


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
    model, (slopes, covariance) = uncertain.model, uncertain.known()
    f = default_grid(uncertain) if frequency_hz is None else np.atleast_1d(np.asarray(frequency_hz, float))
    if not (f > 0).all():
        raise UsageError(f"frequency_hz of a Bode diagram must be above zero; the smallest is {f.min():g} Hz")
    response = model.frequency_response(f)
    changes = response_slopes(model, slopes, f)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = changes / response
    return Bode(
        f,
        response,
        plane_covariance(changes, covariance),
        np.abs(response),
        np.abs(response) * std_of(relative.real, covariance),
        phase_in_degrees(model, f),
        std_of(np.degrees(relative.imag), covariance),
        model.input_names,
        model.output_names,
        model.name,
    )


def default_grid(source: UncertainModel) -> FloatArray:
    """Return frequencies above zero that resolve the poles of a model, up to the Nyquist frequency [Hz]."""
    grid = frequency_grid(source.model)
    highest = 0.5 / source.sample_time if source.sample_time else np.inf
    inside = grid[(grid > 0) & (grid < highest)]
    return np.append(inside, highest) if np.isfinite(highest) and highest > inside[-1:].sum() else inside


def response_slopes(model: LinearModel, slopes: ModelSlopes, frequency_hz: FloatArray) -> ComplexArray:
    """Return derivatives of a model's frequency response with respect to its parameters.

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
    at = s if model.dt is None else np.exp(s * model.dt)
    inverse = np.linalg.inv(at[:, None, None] * np.eye(model.n_states) - model.A)
    left = model.C @ inverse
    drive = np.broadcast_to(model.B, (len(s), *model.B.shape)).astype(complex)
    d_drive = np.broadcast_to(slopes.B[:, None], (len(slopes.B), *drive.shape)).astype(complex)
    if model.delay is not None and model.B_delayed is not None:
        delays = np.exp(-s[:, None] * model.delay)[:, None]
        drive = drive + model.B_delayed * delays
        d_drive = d_drive + slopes.B_delayed[:, None] * delays
        d_drive -= (s[:, None, None] * delays * model.B_delayed) * slopes.delay[:, None, None]
    states = inverse @ drive
    return np.asarray(
        np.einsum("pyn,fnu->pfyu", slopes.C, states, optimize=True)
        + np.einsum("fyn,pnm,fmu->pfyu", left, slopes.A, states, optimize=True)
        + np.einsum("fyn,pfnu->pfyu", left, d_drive, optimize=True)
        + slopes.D[:, None]
    )


def quantile(level: float) -> float:
    """Return the half width of a confidence interval, as a number of standard deviations.

    Raises
    ------
    UsageError
        When the level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise UsageError(f"level = {level}; a probability must lie between 0 and 1, as 0.95")
    return NormalDist().inv_cdf(0.5 + level / 2)


# ---- Step and impulse responses of a model, with standard deviations.

Excited = Literal["step", "impulse"]
_SAMPLES = 600  # usual number of points
_SETTLED, _PERIODS = 6.0, 15.0  # usual duration: time constants of the slowest pole, and periods of the slowest mode


@dataclass(frozen=True, eq=False)
class TimeResponse(ChannelCurves):
    """Step or impulse response of a model at rest, for each input.

    Attributes
    ----------
    kind : {"step", "impulse"}
        What each input does at time zero.
    time_s : (n,) array
        Times [s].
    value : (n, n_outputs, n_inputs) array
        Responses, in units of the output per unit of the input, for an impulse per unit and second.
    std : (n, n_outputs, n_inputs) array
        Standard deviations; nan for a model without uncertainty.
    input_names, output_names : tuple of str
        Names of the channels.
    name : str
        Name of the model.
    """

    kind: Excited
    time_s: FloatArray
    value: FloatArray
    std: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    name: str

    def _brief(self) -> Description:
        about = f"{self.kind} response of {self.name}, {len(self.time_s)} times to {self.time_s[-1]:.4g} s"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    @property
    def has_band(self) -> bool:
        """Whether standard deviations are known."""
        return bool(np.isfinite(self.std).any())

    def band(self, level: float = LEVEL) -> tuple[FloatArray, FloatArray]:
        """Return the limits of a confidence band at each time.

        Parameters
        ----------
        level : float
            Probability of the band.

        Returns
        -------
        lower, upper : (n, n_outputs, n_inputs) array
            Limits.
        """
        half = quantile(level) * self.std
        return self.value - half, self.value + half

    def table(self) -> Table:
        """Return a table for CSV with a row for each output, input and time."""
        columns = _columns(("output", "input"), ("time_s", "response", "std"))
        return Table(f"{self.kind} response of {self.name}", columns, self._rows(self.time_s, self.value, self.std))


def time_response(source: ModelLike, kind: Excited = "step", duration_s: Positive | None = None) -> TimeResponse:
    """Return the step or impulse response of a model with standard deviations.

    Parameters
    ----------
    source : LinearModel, FitResult or UncertainModel
        The model, in continuous time. A plain `LinearModel` has no standard deviations: they are nan.
    kind : {"step", "impulse"}
        What each input does at time zero.
    duration_s : float, optional
        Time until which the response is computed [s]; by default until it has settled.

    Returns
    -------
    TimeResponse

    Raises
    ------
    UsageError
        When the kind is unknown, the duration is not positive, or the model is discrete.

    Notes
    -----
    States and their derivatives are computed exactly from sample to sample. A delayed input gives the same response
    later, by ``y(t - tau)``, with the derivative ``-dy/dt`` by the delay. The impulse of a feedthrough is not shown.
    """
    uncertain = as_uncertain(source)
    model, (slopes, covariance) = uncertain.model, uncertain.known()
    if model.dt is not None:
        raise UsageError(f"model {model.name!r} is discrete; simulate() gives its responses")
    if duration_s is None:
        duration_s = _settling(model)
    t = np.linspace(0.0, duration_s, _SAMPLES)
    value = np.zeros((len(t), *model.D.shape))
    change = np.zeros((len(slopes.A), *value.shape))
    A, C = Dual(np.array(model.A), slopes.A), Dual(np.array(model.C), slopes.C)
    for j in range(model.D.shape[1]):
        parts: list[tuple[FloatArray, FloatArray, float, FloatArray | None]] = [(model.B, slopes.B, 0.0, None)]
        if model.B_delayed is not None and model.delay is not None:
            parts.append((model.B_delayed, slopes.B_delayed, float(model.delay[j]), slopes.delay[:, j]))
        for matrix, slope, delay, d_delay in parts:
            b = Dual(matrix[:, [j]], slope[:, :, [j]])
            if not (b.value.any() or b.slope.any()):
                continue
            for total, course in zip((value, change), _course(A, b, C, t - delay, kind, d_delay), strict=True):
                total[..., j] += course
        if kind == "step":
            value[:, :, j] += model.D[:, j]
            change[..., j] += slopes.D[:, None, :, j]
    std = std_of(change, covariance)
    return TimeResponse(kind, t, value, std, model.input_names, model.output_names, model.name)


def _course(
    A: Dual, b: Dual, C: Dual, t: FloatArray, kind: Excited, d_delay: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return the outputs (n, n_y) at times `t` from the excitation at zero, and derivatives (n_p, n, n_y)."""
    n_p, step = len(A.slope), float(t[1] - t[0])
    value, change = np.zeros((len(t), len(C.value))), np.zeros((n_p, len(t), len(C.value)))
    begun = np.flatnonzero(t >= 0)
    if not len(begun):
        return value, change
    F, G, _ = discretise(A, b, step, "zoh")
    first_F, first_G, _ = discretise(A, b, max(float(t[begun[0]]), 1e-12 * step), "zoh")
    x = first_G if kind == "step" else first_F @ b
    drive = G if kind == "step" else constant(np.zeros(b.shape), n_p)
    for k in begun:
        y = C @ x
        value[k], change[:, k] = y.value[:, 0], y.slope[:, :, 0]
        if d_delay is not None:
            speed = A.value @ x.value + (b.value if kind == "step" else 0.0)
            change[:, k] -= np.outer(d_delay, C.value @ speed[:, 0])
        x = F @ x + drive
    return value, change


def _settling(model: LinearModel) -> float:
    """Return the duration of a response plot [s]: until settled, at most some periods of the slowest mode."""
    poles = model.poles()
    rates = np.abs(poles.real)[np.abs(poles.real) > 1e-9 * np.abs(poles).max(initial=0.0)]
    longest = _SETTLED / float(rates.min()) if len(rates) else 1.0
    pairs = np.abs(poles[poles.imag > 0])
    if len(pairs):
        periods = _PERIODS * 2 * np.pi / float(pairs.min())
        longest = min(longest, periods) if len(rates) else periods
    return longest + (0.0 if model.delay is None else float(model.delay.max(initial=0.0)))


# ---- Poles and zeros of a model, with covariances.

_FAR = 1e6  # smallest size of a zero, relative to the fastest pole, that counts as infinite


@dataclass(frozen=True, eq=False)
class PoleZero(Tabled):
    """Poles and zeros of a model in continuous time.

    Attributes
    ----------
    poles : (n_poles,) complex array
        Poles [rad/s], by rising magnitude.
    pole_covariance : (n_poles, 2, 2) array
        Covariance of real and imaginary part; nan for a model without uncertainty.
    zeros : (n_zeros,) complex array
        Transmission zeros [rad/s]. Empty for a model with different numbers of inputs and outputs, and where an input
        acts both with and without a delay.
    zero_covariance : (n_zeros, 2, 2) array
        The same for the zeros.
    name : str
        Name of the model.
    """

    poles: ComplexArray
    pole_covariance: FloatArray
    zeros: ComplexArray
    zero_covariance: FloatArray
    name: str

    def _brief(self) -> Description:
        return brief(self, f"{self.name}, {len(self.poles)} poles, {len(self.zeros)} zeros")

    @property
    def has_ellipses(self) -> bool:
        """Whether covariances are known."""
        return bool(np.isfinite(self.pole_covariance).any())

    def table(self) -> Table:
        """Return a table for CSV with a row for each pole and zero."""
        rows: list[list[Entry]] = []
        kinds = (("pole", self.poles, self.pole_covariance), ("zero", self.zeros, self.zero_covariance))
        for kind, s, cov in ((kind, *pair) for kind, *both in kinds for pair in zip(*both, strict=True)):
            std_re, std_im = np.sqrt(np.diag(cov)).tolist()
            size = float(abs(s))
            damping = -float(s.real) / size if size else None
            rows.append([kind, float(s.real), std_re, float(s.imag), std_im, size / (2 * np.pi), damping])
        names = ("real", "real_std", "imaginary", "imaginary_std", "frequency_hz", "damping")
        return Table(f"poles and zeros of {self.name}", _columns(("kind",), names), rows)


def pole_zero(source: ModelLike) -> PoleZero:
    """Return poles and zeros of a model with their covariances.

    Parameters
    ----------
    source : LinearModel, FitResult or UncertainModel
        The model. Those of a discrete model are converted to continuous time.

    Returns
    -------
    PoleZero

    Notes
    -----
    Both are eigenvalues of a pencil ``M - lambda N``: of the poles ``A - lambda I``, of the zeros the system matrix
    ``[A - lambda I, B; C, D]``. With left and right eigenvectors w and v, ``d lambda = w' dM v / (w' N v)``. Where two
    poles almost coincide, the derivatives are very large and an ellipse is not a good picture of the uncertainty.
    """
    uncertain = as_uncertain(source)
    model, (slopes, covariance) = uncertain.model, uncertain.known()
    rate = max(float(np.abs(np.linalg.eigvals(model.A)).max(initial=0.0)), 1e-300)
    poles, pole_slopes = _pencil(model.A, np.eye(model.n_states), rate, slopes.A)
    zeros, zero_slopes = _zeros(model, slopes, rate)
    if model.dt is not None:
        with np.errstate(divide="ignore"):
            poles, zeros = (np.asarray(np.log(each) / model.dt, complex) for each in (poles, zeros))
    spreads = (plane_covariance(each, covariance) for each in (pole_slopes, zero_slopes))
    return PoleZero(poles, next(spreads), zeros, next(spreads), model.name)


def ellipse(covariance: FloatArray, level: float = LEVEL) -> FloatArray:
    """Return points on the border of a confidence region of two zero-mean normal variables.

    Parameters
    ----------
    covariance : (2, 2) array
        Their covariance; singular for a segment of a line.
    level : float
        Probability of the region.

    Returns
    -------
    (60, 2) array
        Points of the closed edge.
    """
    variances, axes = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 60)
    single = variances[0] <= 1e-9 * variances[1]  # one variable only, as for a real pole
    radius = quantile(level) if single else sqrt(-2 * log(1 - level))
    return np.asarray(
        radius * np.column_stack([np.cos(angle), np.sin(angle)]) * np.sqrt(np.maximum(variances, 0)) @ axes.T
    )


def _pencil(M: FloatArray, N: FloatArray, rate: float, dM: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the finite generalised eigenvalues by ascending magnitude, and derivatives (n_free, n)."""
    values, left, right = scipy.linalg.eig(M / rate, N, left=True, right=True)
    keep = np.flatnonzero(np.isfinite(values) & (np.abs(values) < _FAR))
    keep = keep[np.lexsort((values[keep].imag, np.abs(values[keep])))]
    values, left, right = values[keep] * rate, left[:, keep].conj(), right[:, keep]
    size = np.einsum("ni,nm,mi->i", left, N, right)
    with np.errstate(divide="ignore", invalid="ignore"):
        return values, np.einsum("ni,pnm,mi->pi", left, dM, right, optimize=True) / size


def _zeros(model: LinearModel, slopes: ModelSlopes, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the transmission zeros and derivatives (n_free, n).

    There are none for a system that is not square, or with an input that acts both promptly and with a delay.
    """
    n_y, n_u = model.D.shape
    prompt = model.B.any(axis=0) | model.D.any(axis=0)
    delayed = np.zeros(n_u, bool) if model.B_delayed is None else model.B_delayed.any(axis=0)
    if n_y != n_u or not n_u or (prompt & delayed).any():
        return np.zeros(0, complex), np.zeros((len(slopes.A), 0), complex)
    B = model.B if model.B_delayed is None else model.B + model.B_delayed
    M = np.block([[model.A, B], [model.C, model.D]])
    # Columns and rows of about one size: the zeros do not depend on the units of inputs and outputs.
    size = max(float(np.abs(model.A).max(initial=0.0)), 1e-300)
    columns, rows = np.ones(len(M)), np.ones(len(M))
    columns[model.n_states :] = size / _sizes(np.vstack([B, model.D]), 0)
    rows[model.n_states :] = size / _sizes(np.hstack([model.C, model.D]), 1)
    scale = np.outer(rows, columns)
    upper = np.concatenate([slopes.A, slopes.B + slopes.B_delayed], axis=2)
    dM = np.concatenate([upper, np.concatenate([slopes.C, slopes.D], axis=2)], axis=1)
    return _pencil(M * scale, np.diag([1.0] * model.n_states + [0.0] * n_u), rate, dM * scale)


def _sizes(matrix: FloatArray, axis: int) -> FloatArray:
    size = np.linalg.norm(matrix, axis=axis)
    return np.asarray(np.where(size > 0, size, 1.0))
