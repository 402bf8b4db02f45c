"""Model of any structure whose parameters are polynomials in scheduling variables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.errors import UsageError
from gbid.lpv.domain import check_range
from gbid.structure import LinearModel, evaluate
from gbid.structure.linear import Structure
from gbid.structure.scheduling.monomials import monomials


@dataclass(frozen=True)
class ScheduledModel(Brief):
    """Linear parameter-varying model of any structure.

    Parameters
    ----------
    name : str
        Name of the model.
    structure : Structure
        Equations.
    scheduling : tuple of str
        Names of the scheduling variables.
    exponents : tuple of tuple of int
        Powers of the scheduling variables in each term.
    coefficients : dict of str to floats
        Coefficients of the terms for each parameter that is a surface, in the units of the structure and of the
        scheduling variables.
    domain : dict of str to (lowest, highest)
        Range of each scheduling variable in which the model is valid.
    held : dict of str to float
        Values of the other parameters.
    operating_points : tuple of tuple of float
        Operating points at which models were identified.
    input_names, output_names : tuple of str
        Names of the channels.

    Raises
    ------
    UsageError
        When a parameter of the structure has no value, or when there is one that the structure does not have.
    """

    name: str
    structure: Structure
    scheduling: tuple[str, ...]
    exponents: tuple[tuple[int, ...], ...]
    coefficients: Mapping[str, tuple[float, ...]]
    domain: Mapping[str, tuple[float, float]]
    held: Mapping[str, float] = field(default_factory=dict)
    operating_points: tuple[tuple[float, ...], ...] = ()
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        expected = [parameter.name for parameter in self.structure.parameters]
        given = [*self.coefficients, *self.held]
        wrong = sorted(set(expected) ^ set(given))
        if wrong or len(given) > len(set(given)):
            raise UsageError(f"model {self.name!r}: give coefficients or a value for each of {', '.join(expected)}")
        for key in ("coefficients", "domain", "held"):
            object.__setattr__(self, key, dict(getattr(self, key)))

    def _brief(self) -> Description:
        ranges = [f"{name} {low:g} to {high:g}" for name, (low, high) in self.domain.items()]
        return brief(
            self,
            f"{self.structure.name}",
            name=self.name,
            domain=", ".join(ranges),
            coefficients=f"of {', '.join(self.coefficients)}",
            held=self.held,
        )

    def parameters_at(self, *point: npt.ArrayLike, extrapolate: bool = False) -> dict[str, FloatArray]:
        """Return the parameters at operating points.

        Parameters
        ----------
        *point : float or array
            Scheduling variables in the order of `scheduling`; arrays broadcast against each other.
        extrapolate : bool
            Whether points outside the domain are allowed.

        Returns
        -------
        dict of str to array
            Values of all parameters of the structure, each of the broadcast shape.

        Raises
        ------
        UsageError
            When the number of variables is wrong, a value is not finite, or a point lies outside the domain and
            `extrapolate` is not set.

        Warns
        -----
        ExtrapolationWarning
            When a point lies outside the domain and `extrapolate` is set.
        """
        values = self.checked(point, extrapolate)
        terms = self.terms(values)
        found = {name: np.asarray(terms @ np.asarray(row)) for name, row in self.coefficients.items()}
        shape = terms.shape[:-1]
        return {
            p.name: found[p.name] if p.name in found else np.full(shape, self.held[p.name])
            for p in self.structure.parameters
        }

    def at(self, *point: float, extrapolate: bool = False) -> LinearModel:
        """Return the linear model at one operating point.

        Parameters
        ----------
        *point : float
            Scheduling variables in the order of `scheduling`.
        extrapolate : bool
            Whether a point outside the domain is allowed.

        Returns
        -------
        LinearModel
            In continuous time.

        Raises
        ------
        UsageError
            As for `parameters_at`, and when the point is not one point.
        """
        if any(np.ndim(value) for value in point):
            raise UsageError(f"model {self.name!r}: give one operating point, a number for each scheduling variable")
        values = {name: float(value) for name, value in self.parameters_at(*point, extrapolate=extrapolate).items()}
        return evaluate(self.structure, values, self.input_names, self.output_names)

    def terms(self, values: FloatArray) -> FloatArray:
        """Return the terms of the polynomials at points `values`, (..., n_variables), as an array (..., n_terms)."""
        return monomials(values, self.exponents)

    def checked(self, point: tuple[npt.ArrayLike, ...], extrapolate: bool) -> FloatArray:
        """Return `point` as an array (..., n_variables); outside of the domain it is refused unless `extrapolate`."""
        if len(point) != len(self.scheduling):
            raise UsageError(f"model {self.name!r}: give {', '.join(self.scheduling)}; got {len(point)} values")
        values = np.stack(np.broadcast_arrays(*(np.asarray(each, float) for each in point)), axis=-1)
        if not np.isfinite(values).all():
            raise UsageError(f"model {self.name!r}: a scheduling variable is not finite")
        for i, name in enumerate(self.scheduling):
            check_range(name, values[..., i], self.domain[name], f"model {self.name!r}", extrapolate, stacklevel=5)
        return values
