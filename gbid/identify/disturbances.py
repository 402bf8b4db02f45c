"""Trend and hum of the outputs, estimated by a fit: terms, parameters and regressors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.polynomial import legendre

from gbid.core.arrays import FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.identify.options import FitOptions, TrendName
from gbid.structure import LinearModel, NonlinearModel, Parameter


@dataclass(frozen=True)
class Trend:
    """Trend of one output.

    Attributes
    ----------
    n_terms : int
        Number of terms of the polynomial: 0 none, 1 an offset, 2 a linear drift, and so on.
    random_walk : bool
        Whether the offset is a random walk. Then there is no polynomial.
    """

    n_terms: int
    random_walk: bool = False


@dataclass(frozen=True)
class Term:
    """Term of a trend or hum: one coefficient of one output.

    Attributes
    ----------
    name : str
        Name of the coefficient, such as ``trend1_p_x``.
    output : int
        Position of the output.
    column : int
        Column of `Disturbances.regressors`.
    power : int
        The unit of the coefficient is the unit of the output divided by this power of seconds.
    """

    name: str
    output: int
    column: int
    power: int = 0


@dataclass(frozen=True)
class Disturbances:
    """Disturbances added to the outputs: polynomials of time, sinusoids, random walks.

    Attributes
    ----------
    outputs : tuple of str
        Names of the output channels.
    trends : tuple of Trend
        Trend of each output.
    hum : tuple of float
        Known frequencies of sinusoids in all outputs [Hz].
    """

    outputs: tuple[str, ...] = ()
    trends: tuple[Trend, ...] = ()
    hum: tuple[float, ...] = ()

    @property
    def n_polynomials(self) -> int:
        """Largest number of polynomial terms of an output."""
        return max((trend.n_terms for trend in self.trends), default=0)

    @property
    def n_columns(self) -> int:
        """Number of regressors."""
        return self.n_polynomials + 2 * len(self.hum)

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """Coefficients of polynomials and sinusoids: offsets of all outputs, then slopes, and so on."""
        terms = [
            Term(f"trend{power}_{name}" if power else f"offset_{name}", output, power, power)
            for power in range(self.n_polynomials)
            for output, (name, trend) in enumerate(zip(self.outputs, self.trends, strict=True))
            if power < trend.n_terms
        ]
        for k, frequency in enumerate(self.hum):
            for j, part in enumerate(("cos", "sin")):
                column = self.n_polynomials + 2 * k + j
                terms += [Term(f"hum{frequency:.10g}_{part}_{name}", i, column) for i, name in enumerate(self.outputs)]
        return tuple(terms)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all coefficients and gains."""
        return (*(term.name for term in self.terms), *map(self.gain_name, self.walking))

    def gain_name(self, output: int) -> str:
        """Return the name of the gain of an output's random walk."""
        return f"walk_{self.outputs[output]}"

    @property
    def walking(self) -> tuple[int, ...]:
        """Outputs whose offset follows a random walk."""
        return tuple(i for i, trend in enumerate(self.trends) if trend.random_walk)

    def instead_of_walks(self, n_terms: int) -> Disturbances:
        """Return the disturbances with polynomials of a given number of terms in place of random walks."""
        trends = tuple(Trend(n_terms) if trend.random_walk else trend for trend in self.trends)
        return replace(self, trends=trends)

    def walk_gains(self, sample_time: float) -> tuple[Parameter, ...]:
        """Return the gains of the random walks: ``db/dt = gain e`` for the offset b and the error e of an output.

        Of an error, the offset takes the share ``gain * sample_time`` over. This share lies between 0 and 1.
        """
        upper = 1 / sample_time
        return tuple(
            Parameter(self.gain_name(i), _FIRST_SHARE / sample_time, 0.0, upper, unit="1/s") for i in self.walking
        )

    def units(self, output_units: Sequence[str]) -> dict[str, str]:
        """Return the units of all coefficients and gains, by name."""
        units = {}
        for term in self.terms:
            unit = output_units[term.output]
            seconds = "" if term.power < 2 else f"^{term.power}"
            units[term.name] = f"{unit or 1}/s{seconds}" if term.power else unit
        return {**units, **dict.fromkeys(map(self.gain_name, self.walking), "1/s")}

    def matrix(self, coefficients: Sequence[ca.SX], n_outputs: int) -> ca.SX:
        """Return the matrix from regressors to outputs, (n_outputs, n_columns), from coefficients of `terms`."""
        matrix = ca.SX(n_outputs, self.n_columns)
        for term, coefficient in zip(self.terms, coefficients, strict=True):
            if term.output < n_outputs:  # recordings with more outputs than the structure are refused later
                matrix[term.output, term.column] = coefficient
        return matrix

    @cached_property
    def places(self) -> tuple[IntArray, IntArray]:
        """Row and column in `matrix` of each of the `terms`."""
        rows, columns = np.array([(term.output, term.column) for term in self.terms], np.int64).reshape(-1, 2).T
        return rows, columns

    def closest(self, outputs: FloatArray, columns: FloatArray) -> FloatArray:
        """Return the least-squares coefficients as a matrix from regressors to outputs, (n_outputs, n_columns).

        Parameters
        ----------
        outputs : (n_samples, n_outputs) array
            What the disturbances are to explain.
        columns : (n_samples, n_columns) array
            Regressors at these samples.
        """
        size = np.maximum(np.abs(columns).max(axis=0, initial=0.0), np.finfo(float).tiny)
        matrix, (rows, of_terms) = np.zeros((outputs.shape[1], self.n_columns)), self.places
        for i, output in enumerate(outputs.T):
            chosen = of_terms[rows == i]
            scaled = columns[:, chosen] / size[chosen]
            matrix[i, chosen] = np.linalg.lstsq(scaled, output, rcond=None)[0] / size[chosen]
        return matrix

    def with_walks_as_states(
        self, model: LinearModel | NonlinearModel, parameters: Mapping[str, float]
    ) -> LinearModel | NonlinearModel:
        """Return a model with an additional last state for each output whose offset follows a random walk.

        `parameters` are those of the fit, with the gains of the random walks. Without random walks it is the model.
        """
        gains = [parameters[self.gain_name(output)] for output in self.walking]
        return model.with_integrators(list(self.walking), gains) if gains else model

    def regressors(self, time: FloatArray) -> FloatArray:
        """Return the regressors of a record at given times [s], (n_samples, n_columns).

        The polynomials are those of Legendre over the record, with one as their highest coefficient: ``1``, ``t - t_m``
        with the middle t_m of the record, and so on [s^k]. They are almost orthogonal, so the offset is the mean of the
        trend, and the first coefficient is the mean slope. Cosine and sine begin at the first sample.
        """
        since = time - time[0]
        half = float(since[-1]) / 2 or 1.0
        scaled = since / half - 1
        columns = []
        for power in range(self.n_polynomials):
            unit = np.eye(power + 1)[power]
            highest = legendre.leg2poly(unit)[-1]
            columns.append(legendre.legval(scaled, unit) * half**power / highest)
        phase = 2 * np.pi * since
        for frequency in self.hum:
            columns += [np.cos(frequency * phase), np.sin(frequency * phase)]
        return np.stack(columns, axis=1) if columns else np.zeros((len(time), 0))


_FIRST_SHARE = 0.01  # of an error that a random walk takes over, at the start
UNDISTURBED = Disturbances()
"""No disturbances."""


TREND_WORDS = {"none": Trend(0), "offset": Trend(1), "linear": Trend(2), "random walk": Trend(0, random_walk=True)}
"""Trends of an output by their words; a number is the degree of a polynomial."""


def disturbances_of(options: FitOptions, outputs: tuple[str, ...], sample_time: float) -> Disturbances:
    """Return the disturbances of the outputs that the options `trend` and `hum` of a fit select.

    Parameters
    ----------
    options : FitOptions
        Options of the fit.
    outputs : tuple of str
        Names of the output channels.
    sample_time : float
        Time between samples [s]; 0 when it is not known yet.

    Raises
    ------
    UsageError
        When an option does not fit the outputs or the sample time.
    """
    trend, hum = options.trend, options.hum
    if isinstance(trend, Mapping):
        if unknown := [name for name in trend if name not in outputs]:
            raise UsageError(
                f"trend names {unknown[0]!r}, which is no output of the fit; they are {', '.join(outputs)}"
            )
        trends = tuple(_trend(trend.get(name, "none")) for name in outputs)
    else:
        trends = (_trend(trend),) * len(outputs)
    if options.focus == "simulation" and any(each.random_walk for each in trends):
        raise UsageError("trend = 'random walk' is for focus = 'prediction'; give a degree for a simulation")
    frequencies = (hum,) if isinstance(hum, int | float) else tuple(hum)
    highest = 1 / (2 * sample_time) if sample_time else math.inf
    for frequency in frequencies:
        if not (math.isfinite(frequency) and 0 < frequency < highest):
            raise UsageError(f"hum = {frequency} Hz; give frequencies above 0 and below {highest:g} Hz", "hum")
    if len({f"{frequency:.10g}" for frequency in frequencies}) < len(frequencies):
        raise UsageError(f"hum = {list(frequencies)}: a frequency is given twice; give each once", "hum")
    return Disturbances(outputs, trends, tuple(float(f) for f in frequencies))


def _trend(name: TrendName) -> Trend:
    return TREND_WORDS[name] if isinstance(name, str) else Trend(name + 1)
