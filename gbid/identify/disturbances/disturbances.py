"""Trends and hum of the outputs as a fit estimates them: their terms, parameters and regressors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from gbid.arrays import FloatArray, IntArray
from gbid.structure import Parameter


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
    """Term of a trend or a hum: one coefficient of one output.

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
    """Disturbances that are added to the outputs: polynomials of time, sinusoids, random walks.

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
        """Largest number of terms of a polynomial."""
        return max((trend.n_terms for trend in self.trends), default=0)

    @property
    def n_columns(self) -> int:
        """Number of regressors."""
        return self.n_polynomials + 2 * len(self.hum)

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """Coefficients of polynomials and sinusoids: those of the first power of all outputs, then of the next."""
        found = [
            Term(f"trend{power}_{name}" if power else f"offset_{name}", output, power, power)
            for power in range(self.n_polynomials)
            for output, (name, trend) in enumerate(zip(self.outputs, self.trends, strict=True))
            if power < trend.n_terms
        ]
        for i, frequency in enumerate(self.hum):
            for j, part in enumerate(("cos", "sin")):
                column = self.n_polynomials + 2 * i + j
                found += [
                    Term(f"hum{frequency:.10g}_{part}_{name}", output, column)
                    for output, name in enumerate(self.outputs)
                ]
        return tuple(found)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all coefficients and gains."""
        return (*(term.name for term in self.terms), *map(self.gain_name, self.walking))

    def gain_name(self, output: int) -> str:
        """Return the name of the gain of a random walk."""
        return f"walk_{self.outputs[output]}"

    @property
    def walking(self) -> tuple[int, ...]:
        """Outputs whose offset is a random walk."""
        return tuple(i for i, trend in enumerate(self.trends) if trend.random_walk)

    def instead_of_walks(self, n_terms: int) -> Disturbances:
        """Return the disturbances with polynomials of so many terms in place of random walks."""
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

    def matrix(self, coefficients: FloatArray) -> FloatArray:
        """Return the matrix from regressors to outputs, (..., n_outputs, n_columns), for coefficients of `terms`."""
        found = np.zeros((*coefficients.shape[:-1], len(self.outputs), self.n_columns))
        found[(..., *self.places)] = coefficients
        return found

    @cached_property
    def places(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of `terms` in `matrix`."""
        return (
            np.array([term.output for term in self.terms], dtype=np.int64),
            np.array([term.column for term in self.terms], dtype=np.int64),
        )

    def closest(self, outputs: FloatArray, columns: FloatArray) -> FloatArray:
        """Return the matrix of the coefficients with the smallest squares, (n_outputs, n_columns).

        Parameters
        ----------
        outputs : (n_samples, n_outputs) array
            What the disturbances are to explain.
        columns : (n_samples, n_columns) array
            Regressors at these samples.
        """
        size = np.maximum(np.abs(columns).max(axis=0, initial=0.0), np.finfo(float).tiny)
        found = np.zeros((outputs.shape[1], self.n_columns))
        for output in range(outputs.shape[1]):
            own = self.places[1][self.places[0] == output]
            scaled = columns[:, own] / size[own]
            found[output, own] = np.linalg.lstsq(scaled, outputs[:, output], rcond=None)[0] / size[own]
        return found

    def regressors(self, n_samples: int, sample_time: float) -> FloatArray:
        """Return the regressors of a record, (n_samples, n_columns).

        The polynomials are those of Legendre over the record, with one as their highest coefficient: ``1``, ``t - t_m``
        with the middle t_m of the record, and so on [s^k]. They are almost orthogonal, so the offset is the mean of the
        trend, and the first coefficient is the mean slope. Cosine and sine begin at the first sample.
        """
        half = max((n_samples - 1) / 2, 0.5)
        scaled = (np.arange(n_samples) - (n_samples - 1) / 2) / half
        columns = []
        for power in range(self.n_polynomials):
            unit = np.eye(power + 1)[power]
            highest = legendre.leg2poly(unit)[-1]
            columns.append(legendre.legval(scaled, unit) * (half * sample_time) ** power / highest)
        phase = 2 * np.pi * sample_time * np.arange(n_samples)
        for frequency in self.hum:
            columns += [np.cos(frequency * phase), np.sin(frequency * phase)]
        return np.stack(columns, axis=1) if columns else np.zeros((n_samples, 0))


_FIRST_SHARE = 0.01  # of an error that a random walk takes over, at the start
UNDISTURBED = Disturbances()
"""No disturbances."""
