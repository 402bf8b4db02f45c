"""Scheduled structures: parameters as polynomials in scheduling variables (paper, Eq. 16)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb, prod
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive
from gbid.structure.built_in import KEY_PARAMETERS
from gbid.structure.linear import OnBase, Structure
from gbid.structure.parameter import Parameter

TERMS = ("1", "P", "Omega", "Omega P", "P^2", "Omega^2")
"""Terms in the order of the coefficients; P in bar, Omega in rpm."""

SCHEDULING = ("pressure_bar", "speed_rpm")
"""Scheduling variables of a gas bearing."""

EXPONENTS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
"""Powers of (P, Omega) of each term."""

Exponents = tuple[tuple[int, ...], ...]


def exponents_of(order: int, n_variables: int = 2) -> Exponents:
    """Return the exponents of all terms up to a total order; for two variables in the order of `TERMS`."""
    if n_variables == 2:
        higher = [(i, total - i) for total in range(3, order + 1) for i in range(total, -1, -1)]
        return (*(e for e in EXPONENTS if sum(e) <= order), *higher)
    chosen = (c for total in range(order + 1) for c in combinations_with_replacement(range(n_variables), total))
    return tuple(tuple(c.count(i) for i in range(n_variables)) for c in chosen)


def term_name(exponent: Sequence[int], scheduling: Sequence[str] = SCHEDULING) -> str:
    """Return the name of a term: as in `TERMS` for a gas bearing, else such as ``"current^2 gap"``."""
    if tuple(scheduling) == SCHEDULING:
        if tuple(exponent) in EXPONENTS:
            return TERMS[EXPONENTS.index((exponent[0], exponent[1]))]
        scheduling = ("P", "Omega")
    powers = zip(scheduling, exponent, strict=True)
    return " ".join(f"{name}^{power}" if power > 1 else name for name, power in powers if power) or "1"


def monomials(points: FloatArray, exponents: Sequence[Sequence[int]]) -> FloatArray:
    """Return the terms ``P^i Omega^j ...`` at points (..., n_variables) in physical units, (..., n_terms)."""
    return np.stack([np.prod(points ** np.array(e), axis=-1) for e in exponents], axis=-1)


@dataclass(frozen=True)
class Schedule:
    r"""Terms of the surfaces of a fit, in variables scaled to -1 to 1 over the range of the recordings.

    The term of exponents (i, j) is :math:`\pi^i \omega^j` with
    :math:`\pi = (P - P_c) / P_h`: P_c is the centre of the range and P_h half its width. So the terms are of the order
    of one, and the first coefficient is the value at the centre.

    Attributes
    ----------
    variables : tuple of str
        Scheduling variables.
    low, high : tuple of float
        Range of each over the recordings.
    surfaces : tuple of str
        Parameters that are surfaces.
    exponents : tuple of tuple of int
        Powers of the variables in each term.
    pieces : int
        Number of pieces with constant parameters, in all recordings.
    pade_order : int
        Order of the delays of the structure.
    """

    variables: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    surfaces: tuple[str, ...]
    exponents: Exponents
    pieces: int
    pade_order: int = 1

    @property
    def centre(self) -> FloatArray:
        """Middle of the range of each variable, (n_variables,)."""
        return np.asarray((np.array(self.low, float) + np.array(self.high, float)) / 2, np.float64)

    @property
    def half(self) -> FloatArray:
        """Half the width of the range of each variable, (n_variables,); 1 for a constant variable."""
        half = np.asarray((np.array(self.high, float) - np.array(self.low, float)) / 2, np.float64)
        return np.asarray(np.where(half > 0, half, 1.0))

    def terms(self, points: FloatArray) -> FloatArray:
        """Return the terms at points (..., n_variables), shape (..., n_terms)."""
        return monomials((points - self.centre) / self.half, self.exponents)

    def names(self, key: str) -> list[str]:
        """Return the names of the coefficients of a surface."""
        return coefficient_names(key, len(self.exponents))

    @property
    def to_own_units(self) -> FloatArray:
        """Matrix from scaled coefficients of a surface to coefficients in physical units, (m, m).

        ``(P - c)^i = sum_k comb(i, k) P^k (-c)^(i - k)``, a product over the variables. All lower terms are there.
        """
        m = len(self.exponents)
        matrix = np.zeros((m, m))
        for column, of in enumerate(self.exponents):
            for row, to in enumerate(self.exponents):
                if all(k <= i for k, i in zip(to, of, strict=True)):
                    matrix[row, column] = prod(
                        comb(i, k) * (-c) ** (i - k) / h**i
                        for i, k, c, h in zip(of, to, self.centre, self.half, strict=True)
                    )
        return matrix


def coefficient_names(key: str, n_terms: int) -> list[str]:
    """Return the names of the coefficients of a surface, numbered as in the paper: ``k_xx_0`` to ``k_xx_5``."""
    return [f"{key}_{i}" for i in range(n_terms)]


# ---- Structure with parameters that are polynomials in signals of the recording.

HIGHEST_ORDER = 3


@dataclass(frozen=True)
class ScheduledStructure(OnBase, Brief):
    """Linear structure whose parameters are polynomials in signals of the recording; `gbid.scheduled` makes it.

    Attributes
    ----------
    base : Structure
        Equations at constant scheduling variables.
    scheduling : tuple of str
        Signals, or conditions of recordings in which they are constant.
    surfaces : tuple of str
        Parameters that are polynomials; the others are constant.
    exponents : tuple of tuple of int
        Powers of the scheduling variables in each term, with all lower powers of each.
    piece_s : float
        Longest time with constant parameters [s].
    """

    scheduling: tuple[str, ...]
    surfaces: tuple[str, ...]
    exponents: Exponents
    piece_s: float

    @property
    def name(self) -> str:
        """Name of the structure."""
        return f"scheduled {self.base.name}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients of the surfaces, then the constant parameters of the base.

        The variables are scaled to -1 to 1 over the range of the recordings: a coefficient has the unit of its
        parameter.
        """
        coefficients: list[Parameter] = []
        for q in self.base.parameters:
            if q.name in self.surfaces:
                names = coefficient_names(q.name, len(self.exponents))
                coefficients += [Parameter(name, unit=q.unit) for name in names]
        return (*coefficients, *(q for q in self.base.parameters if q.name not in self.surfaces))


def scheduled(
    structure: Structure,
    scheduling: str | Sequence[str] = SCHEDULING,
    *,
    surfaces: Sequence[str] | None = None,
    order: Annotated[int, Ge(0), Le(HIGHEST_ORDER)] = 2,
    piece_s: Positive = 0.1,
) -> ScheduledStructure:
    """Return a structure whose parameters are polynomials in signals of the recording (paper, Eqs. 16 to 18).

    `gbid.fit` estimates the coefficients straight from recordings in which the scheduling variables change, such as
    run-ups. The parameters are constant in short pieces, those of the mean of the variables there, and the state passes
    on from piece to piece. The fit makes pieces shorter where the estimates need it.

    Parameters
    ----------
    structure : Structure
        `RotorBearing`, `Plant`, or a linear structure of a user. Delays may be exact.
    scheduling : str or sequence of str
        Signals with one channel; in a recording without the signal the condition of that name.
    surfaces : sequence of str, optional
        Parameters that are polynomials. By default the fourteen key parameters where the structure has them, else all
        but those with a start value of zero, which disturbance gains have.
    order : int
        Order of the polynomials, 0 to 3.
    piece_s : float
        Longest time with constant parameters [s].

    Returns
    -------
    ScheduledStructure

    Raises
    ------
    UsageError
        When a surface is no parameter of the structure, a number is out of range, or the film of a bearing stiffens.
    """
    if getattr(structure, "film", "linear") != "linear":
        raise UsageError(
            "scheduled: film = 'stiffening' is nonlinear, and a scheduled structure is linear; leave it out"
        )
    names = [q.name for q in structure.parameters]
    variables = (scheduling,) if isinstance(scheduling, str) else tuple(scheduling)
    default = [n for n in KEY_PARAMETERS if n in names] or [q.name for q in structure.parameters if q.start != 0.0]
    chosen = tuple(default if surfaces is None else surfaces)
    if not variables or len(set(variables)) < len(variables):
        raise UsageError(f"scheduling = {list(variables)}; give each variable once, and at least one")
    if not chosen or (unknown := [name for name in chosen if name not in names]):
        text = ", ".join(unknown) if chosen else "none"
        raise UsageError(f"surfaces: {text}; the structure {structure.name!r} has {', '.join(names)}")
    return ScheduledStructure(structure, variables, chosen, exponents_of(order, len(variables)), piece_s)
