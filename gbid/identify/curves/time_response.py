"""Step and impulse responses of a model with standard deviations, propagated from the covariance of its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.discretise import Dual, constant, discretise
from gbid.errors import UsageError
from gbid.identify.curves.bode import LEVEL, quantile
from gbid.identify.curves.uncertain_model import ModelLike, ModelSlopes, as_uncertain, std_of
from gbid.structure import LinearModel
from gbid.tables.table import Column, Entry, Table

Excited = Literal["step", "impulse"]
_SAMPLES = 600  # usual number of points
_SETTLED, _PERIODS = 6.0, 15.0  # usual duration: time constants of the slowest pole, and periods of the slowest mode


@dataclass(frozen=True, eq=False)
class TimeResponse(Brief):
    """Response of a model at rest to a unit step or a unit impulse of each input.

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
        """Whether there are standard deviations."""
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
        """Return the numbers as a table, with a row for each output, input and time; for CSV."""
        rows: list[list[Entry]] = [
            [output, source, float(t), float(self.value[k, i, j]), float(self.std[k, i, j])]
            for i, output in enumerate(self.output_names)
            for j, source in enumerate(self.input_names)
            for k, t in enumerate(self.time_s)
        ]
        numbers = [Column(name, format=6) for name in ("time_s", "response", "std")]
        return Table(f"{self.kind} response of {self.name}", [Column("output"), Column("input"), *numbers], rows)

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


def time_response(source: ModelLike, kind: Excited = "step", duration_s: float | None = None) -> TimeResponse:
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
    model, known = uncertain.model, uncertain.known()
    if kind not in ("step", "impulse"):
        raise UsageError(f"kind = {kind!r}; choose 'step' or 'impulse'")
    if model.dt is not None:
        raise UsageError(f"model {model.name!r} is discrete; simulate() gives its responses")
    if duration_s is None:
        duration_s = _settling(model)
    elif not (np.isfinite(duration_s) and duration_s > 0):
        raise UsageError(f"duration_s = {duration_s}; it must be a positive number")
    t = np.linspace(0.0, duration_s, _SAMPLES)
    n_p = 0 if known is None else len(known[1])
    slopes = _no_slopes(model) if known is None else known[0]
    value = np.zeros((len(t), *model.D.shape))
    change = np.zeros((n_p, *value.shape))
    A, C = Dual(np.array(model.A), slopes.A), Dual(np.array(model.C), slopes.C)
    for j in range(model.D.shape[1]):
        parts: list[tuple[FloatArray, FloatArray, float, FloatArray | None]] = [(model.B, slopes.B, 0.0, None)]
        if model.B_delayed is not None and model.delay is not None:
            parts.append((model.B_delayed, slopes.B_delayed, float(model.delay[j]), slopes.delay[:, j]))
        for matrix, slope, delay, d_delay in parts:
            b = Dual(matrix[:, [j]], slope[:, :, [j]])
            if not (b.value.any() or b.slope.any()):
                continue
            found, moved = _course(A, b, C, t - delay, kind, d_delay)
            value[:, :, j] += found
            change[..., j] += moved
        if kind == "step":
            value[:, :, j] += model.D[:, j]
            change[..., j] += slopes.D[:, None, :, j]
    std = np.full(value.shape, np.nan) if known is None else std_of(change, known[1])
    return TimeResponse(kind, t, value, std, model.input_names, model.output_names, model.name)


def _course(
    A: Dual, b: Dual, C: Dual, t: FloatArray, kind: Excited, d_delay: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return the outputs (n, n_y) after the instant zero of `t`, and their derivatives (n_p, n, n_y)."""
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


def _no_slopes(model: LinearModel) -> ModelSlopes:
    n, (n_y, n_u) = model.n_states, model.D.shape
    shapes = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u), "B_delayed": (n, n_u), "delay": (n_u,)}
    return ModelSlopes(**{name: np.zeros((0, *shape)) for name, shape in shapes.items()})


def _settling(model: LinearModel) -> float:
    """Return a duration that shows the response [s]: settled, but not longer than some periods of the slowest mode."""
    poles = model.poles()
    rates = np.abs(poles.real)[np.abs(poles.real) > 1e-9 * np.abs(poles).max(initial=0.0)]
    longest = _SETTLED / float(rates.min()) if len(rates) else 1.0
    pairs = np.abs(poles[poles.imag > 0])
    if len(pairs):
        periods = _PERIODS * 2 * np.pi / float(pairs.min())
        longest = min(longest, periods) if len(rates) else periods
    return longest + (0.0 if model.delay is None else float(model.delay.max(initial=0.0)))
