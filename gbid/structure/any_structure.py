"""What a fit asks of a structure of any kind: sizes, where its parameters act, and its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi as ca

from gbid.structure.linear import Structure, evaluate, symbolic_matrices
from gbid.structure.nonlinear.at_values import nonlinear_model
from gbid.structure.nonlinear.equations import symbolic_equations
from gbid.structure.nonlinear.film_bearing import film_bearing
from gbid.structure.nonlinear.nonlinear_model import NonlinearModel
from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure
from gbid.structure.numeric.linear_model import LinearModel
from gbid.structure.rotor_bearing import RotorBearing
from gbid.structure.scheduling.schedule import coefficient_names
from gbid.structure.scheduling.scheduled_structure import ScheduledStructure

AnyStructure = Structure | NonlinearStructure | ScheduledStructure
"""Structure of any kind."""


class Anatomy(NamedTuple):
    """Sizes of a structure, and the names of the parameters that act in its parts.

    Attributes
    ----------
    n_states, n_inputs : int
        Numbers of states and inputs.
    in_equations : frozenset of str
        Parameters that act through something else than the initial state.
    in_x0 : tuple of frozenset of str
        Parameters in the stated initial value of each state; empty when the structure states none.
    has_gain : bool
        Whether there is a disturbance gain.
    gain_only : frozenset of str
        Parameters on which only the disturbance gain depends.
    """

    n_states: int
    n_inputs: int
    in_equations: frozenset[str]
    in_x0: tuple[frozenset[str], ...]
    has_gain: bool
    gain_only: frozenset[str]


def equations_of(structure: AnyStructure) -> AnyStructure:
    """Return the structure with which a fit computes: that of a bearing whose film stiffens is nonlinear."""
    nonlinear = isinstance(structure, RotorBearing) and structure.film != "linear"
    return film_bearing(structure) if nonlinear else structure  # type: ignore[arg-type]  # a bearing, see above


def anatomy(
    structure: AnyStructure, driven: Sequence[int] | None = None, moving: Sequence[int] | None = None
) -> Anatomy:
    """Return the anatomy of a structure.

    Parameters
    ----------
    structure : Structure, NonlinearStructure or ScheduledStructure
        The structure.
    driven, moving : sequence of int, optional
        Inputs that are not zero, and inputs that move; all by default. A parameter that acts through others alone does
        not count.
    """
    if isinstance(structure, ScheduledStructure):
        return _of_scheduled(structure, anatomy(structure.base, driven, moving))
    if isinstance(structure, NonlinearStructure):
        e = symbolic_equations(structure)
        n_u = e.u.numel()
        at = ca.vertcat(*(e.u[i] if driven is None or i in driven else ca.SX(0) for i in range(n_u)))
        acting = ca.substitute([e.dx, e.y], [e.u], [at]) if n_u else [e.dx, e.y]
        acting = [*acting, e.delay[list(range(n_u)) if moving is None else list(moving), :]]
        only = _names([e.K]) - _names([*acting, e.x0])
        return Anatomy(e.x.numel(), n_u, _names([*acting, e.K]), _by_row(e.x0), e.K.nnz() > 0, only)
    _, m = symbolic_matrices(structure)
    every = list(range(m.B.shape[1]))
    own = every if driven is None else list(driven)
    parts = [m.A, m.C, m.B[:, own], m.D[:, own], m.B_delayed[:, own], *(m.feedback.law if m.feedback else ())]
    if m.has_delay:
        parts.append(m.delay[every if moving is None else list(moving), :])
    only = _names([m.K]) - _names([*parts, m.x0])
    has_gain = m.K.nnz() > 0 or m.feedback is not None
    return Anatomy(m.n_states, len(every), _names([*parts, m.K]), _by_row(m.x0), has_gain, only)


def model_of(
    structure: AnyStructure,
    values: Mapping[str, float],
    input_names: tuple[str, ...] = (),
    output_names: tuple[str, ...] = (),
    *,
    steps: int = 1,
) -> LinearModel | NonlinearModel:
    """Return the model of a structure for given parameter values; `steps` is for nonlinear ones.

    That of a scheduled structure is its base in the middle of the range, where only the first coefficients count.
    """
    if isinstance(structure, ScheduledStructure):
        first = {key: values[coefficient_names(key, 1)[0]] for key in structure.surfaces}
        own = {q.name: first[q.name] if q.name in first else values[q.name] for q in structure.base.parameters}
        return evaluate(structure.base, own, input_names, output_names)
    if isinstance(structure, NonlinearStructure):
        return nonlinear_model(structure, values, input_names, output_names, steps=steps)
    return evaluate(structure, values, input_names, output_names)


def _of_scheduled(structure: ScheduledStructure, base: Anatomy) -> Anatomy:
    """Return the anatomy with the coefficients in place of the parameters that are surfaces."""

    def renamed(names: frozenset[str]) -> frozenset[str]:
        m = len(structure.exponents)
        rows = (coefficient_names(name, m) if name in structure.surfaces else [name] for name in names)
        return frozenset(name for row in rows for name in row)

    return base._replace(
        in_equations=renamed(base.in_equations),
        in_x0=tuple(map(renamed, base.in_x0)),
        gain_only=renamed(base.gain_only),
    )


def _by_row(x0: ca.SX) -> tuple[frozenset[str], ...]:
    return tuple(_names([row]) for row in ca.vertsplit(x0)) if x0.numel() else ()


def _names(parts: Sequence[ca.SX]) -> frozenset[str]:
    inside = {symbol.name() for part in parts for symbol in ca.symvar(ca.veccat(part))}
    return frozenset(inside)
