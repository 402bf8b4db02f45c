"""Structure whose parameters are polynomials in signals of the recording, such as pressure and speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gbid.brief import Brief
from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.structure.linear import Structure
from gbid.structure.parameter import Parameter
from gbid.structure.plant import Plant
from gbid.structure.rotor_bearing import KEY_PARAMETERS, RotorBearing
from gbid.structure.scheduling.monomials import SCHEDULING, Exponents, exponents_of
from gbid.structure.scheduling.schedule import coefficient_names

HIGHEST_ORDER = 3


@dataclass(frozen=True)
class ScheduledStructure(Brief):
    """Linear structure whose parameters follow signals of the recording; made by `gbid.scheduled`.

    Attributes
    ----------
    base : Structure
        Equations at constant scheduling variables.
    scheduling : tuple of str
        Signals, or conditions of recordings in which they are constant.
    surfaces : tuple of str
        Parameters that are polynomials; the others are constant.
    order : int
        Order of the polynomials.
    piece_s : float
        Longest time with constant parameters [s].
    """

    base: Structure
    scheduling: tuple[str, ...]
    surfaces: tuple[str, ...]
    order: int
    piece_s: float

    @property
    def name(self) -> str:
        """Name of the structure."""
        return f"scheduled {self.base.name}"

    @property
    def inputs(self) -> tuple[str, ...]:
        """Inputs of the base."""
        return self.base.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs of the base."""
        return self.base.outputs

    @property
    def intersample(self) -> Hold | tuple[Hold, ...]:
        """Inter-sample behaviour of the inputs of the base."""
        return self.base.intersample

    @property
    def exponents(self) -> Exponents:
        """Powers of the scheduling variables in each term."""
        return exponents_of(self.order, len(self.scheduling))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients of the surfaces, then the other parameters of the base.

        The variables are scaled to -1 to 1 over the range of the recordings: a coefficient has the unit of its
        parameter.
        """
        found: list[Parameter] = []
        for q in self.base.parameters:
            if q.name in self.surfaces:
                names = coefficient_names(q.name, len(self.exponents))
                found += [Parameter(name, unit=q.unit) for name in names]
        return (*found, *(q for q in self.base.parameters if q.name not in self.surfaces))

    @property
    def pade_order(self) -> int:
        """Order of the delays of the base; 1 where they are exact or there are none."""
        bearing: Any = self.base.bearing if isinstance(self.base, Plant) else self.base
        return bearing.pade_order if isinstance(bearing, RotorBearing) else 1


def scheduled(
    structure: Structure,
    scheduling: str | Sequence[str] = SCHEDULING,
    *,
    surfaces: Sequence[str] | None = None,
    order: int = 2,
    piece_s: float = 0.1,
) -> ScheduledStructure:
    """Return a structure whose parameters are polynomials in signals of the recording (paper, Eqs. 16 to 18).

    `gbid.fit` estimates the coefficients straight from recordings in which the scheduling variables change, such as
    run-ups. The parameters are constant in short pieces, those of the mean of the variables there, and the state passes
    on from piece to piece.

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
        When a surface is no parameter of the structure, or a number is out of range.
    """
    names = [q.name for q in structure.parameters]
    variables = (scheduling,) if isinstance(scheduling, str) else tuple(scheduling)
    default = [n for n in KEY_PARAMETERS if n in names] or [q.name for q in structure.parameters if q.start != 0.0]
    chosen = tuple(default if surfaces is None else surfaces)
    if not variables or len(set(variables)) < len(variables):
        raise UsageError(f"scheduling = {list(variables)}; give each variable once, and at least one")
    if not chosen or (unknown := [name for name in chosen if name not in names]):
        text = ", ".join(unknown) if chosen else "none"
        raise UsageError(f"surfaces: {text}; the structure {structure.name!r} has {', '.join(names)}")
    if not 0 <= order <= HIGHEST_ORDER:
        raise UsageError(f"order = {order}; choose 0 to {HIGHEST_ORDER}")
    if not piece_s > 0:
        raise UsageError(f"piece_s = {piece_s} s; it must be above 0")
    return ScheduledStructure(structure, variables, chosen, order, piece_s)
