"""Kinds of structures (linear, nonlinear, scheduled, closed loop), and what a fit needs from each kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import singledispatch
from typing import Any, NamedTuple

import casadi as ca

from gbid.structure.built_in import AXES, STIFFENING, RotorBearing, square
from gbid.structure.linear import LinearStructure, Structure, evaluate, symbolic_matrices
from gbid.structure.models import LinearModel
from gbid.structure.nonlinear import NonlinearModel, NonlinearStructure, nonlinear_model, symbolic_equations
from gbid.structure.parameter import Values, once
from gbid.structure.scheduling import ScheduledStructure, coefficient_names

AnyStructure = Structure | NonlinearStructure | ScheduledStructure
"""Structure of any kind."""
Names = tuple[str, ...]


class Anatomy(NamedTuple):
    """Sizes of a structure, and the parameter names of each part.

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


class Kind(ABC):
    """Structure of one kind with the methods that a fit needs; `kind_of` makes it.

    Attributes
    ----------
    linear, nonlinear, scheduled : structure or None
        The structure if it is linear with constant parameters, nonlinear, or one whose parameters follow signals of the
        recording; the other two are None.
    plant : structure
        The structure without the controller that closes a loop around it.
    state_names : tuple of str
        Names of the states of nonlinear equations; those of a linear structure have none.
    states_at_rest : tuple of int
        States that begin at rest unless the caller says otherwise.
    """

    linear: Structure | None = None
    nonlinear: NonlinearStructure | None = None
    scheduled: ScheduledStructure | None = None
    plant: AnyStructure
    state_names: tuple[str, ...] = ()
    states_at_rest: tuple[int, ...] = ()

    @abstractmethod
    def anatomy(self, driven: Sequence[int] | None = None, moving: Sequence[int] | None = None) -> Anatomy:
        """Return the sizes of the structure, and the parameters of each part.

        Parameters
        ----------
        driven, moving : sequence of int, optional
            Inputs that are not zero, and inputs that move; all by default. A parameter that acts through others alone
            does not count.
        """

    @abstractmethod
    def model(
        self, values: Mapping[str, float], inputs: Names = (), outputs: Names = ()
    ) -> LinearModel | NonlinearModel:
        """Return the model for given parameter values; a nonlinear model has one integrator step per sample."""

    @abstractmethod
    def without_inputs(self) -> AnyStructure:
        """Return the structure without its inputs, for free decays: states, outputs and disturbance gain remain."""

    @abstractmethod
    def with_outputs(self, kept: list[int], names: Names) -> AnyStructure | None:
        """Return the structure with some of its outputs, under new names; None where the equations need all."""


class LinearKind(Kind):
    """Linear structure with constant parameters."""

    def __init__(self, structure: Structure) -> None:
        self._structure = self.linear = self.plant = structure

    def anatomy(self, driven: Sequence[int] | None = None, moving: Sequence[int] | None = None) -> Anatomy:
        """Return the anatomy; see `Kind`."""
        return _linear_anatomy(self._structure, *(each if each is None else tuple(each) for each in (driven, moving)))

    def model(self, values: Mapping[str, float], inputs: Names = (), outputs: Names = ()) -> LinearModel:
        """Return the model; see `Kind`."""
        return evaluate(self._structure, values, inputs, outputs)

    def without_inputs(self) -> AnyStructure:
        """Return the structure without its inputs; see `Kind`."""
        full = self._structure

        def matrices(p: Any) -> Mapping[str, Any]:
            given = full.matrices(p)
            return {letter: given[letter] for letter in ("A", "C", "K", "x0", "feedback") if letter in given}

        return LinearStructure(full.name, full.parameters, matrices, (), full.outputs, intersample=full.intersample)

    def with_outputs(self, kept: list[int], names: Names) -> AnyStructure | None:
        """Return the structure with some of its outputs; None for a sampled closed loop; see `Kind`."""
        full, (p, m) = self._structure, symbolic_matrices(self._structure)
        if m.feedback is not None:
            return None
        part = {"A": m.A, "B": m.B, "C": m.C[kept, :], "D": m.D[kept, :], "K": m.K[:, kept]}
        part |= {"B_delayed": m.B_delayed, "delay": m.delay} if m.has_delay else {}
        part |= {"x0": m.x0} if m.x0.numel() else {}
        at = ca.Function("part", [p], list(part.values()))

        def matrices(q: Any) -> Mapping[str, Any]:
            return dict(zip(part, at.call([_stacked(full, q)]), strict=True))

        return LinearStructure(full.name, full.parameters, matrices, full.inputs, names, intersample=full.intersample)


class NonlinearKind(Kind):
    """Nonlinear structure."""

    def __init__(self, structure: NonlinearStructure) -> None:
        self._structure = self.nonlinear = self.plant = structure
        self.state_names = structure.states

    def anatomy(self, driven: Sequence[int] | None = None, moving: Sequence[int] | None = None) -> Anatomy:
        """Return the anatomy; see `Kind`."""
        e = symbolic_equations(self._structure)
        n_u = e.u.numel()
        at = ca.vertcat(*(e.u[i] if driven is None or i in driven else ca.SX(0) for i in range(n_u)))
        acting = ca.substitute([e.dx, e.y], [e.u], [at]) if n_u else [e.dx, e.y]
        acting = [*acting, e.delay[list(range(n_u)) if moving is None else list(moving), :]]
        begun, seen, gain = _by_row(e.x0), _names(acting), _names([e.K])
        return Anatomy(e.x.numel(), n_u, seen | gain, begun, e.K.nnz() > 0, gain - seen.union(*begun))

    def model(self, values: Mapping[str, float], inputs: Names = (), outputs: Names = ()) -> NonlinearModel:
        """Return the model; see `Kind`."""
        return nonlinear_model(self._structure, values, inputs, outputs)

    def without_inputs(self) -> AnyStructure:
        """Return the structure with all inputs zero; see `Kind`."""
        full, rest = self._structure, ca.SX.zeros(len(self._structure.inputs))
        return replace(
            full,
            dynamics=lambda x, _, p: full.dynamics(x, rest, p),
            output=lambda x, _, p: full.output(x, rest, p),
            inputs=(),
            delay=None,
        )

    def with_outputs(self, kept: list[int], names: Names) -> AnyStructure | None:
        """Return the structure with some of its outputs; see `Kind`."""
        full, e = self._structure, symbolic_equations(self._structure)
        y, K = ca.Function("y", [e.x, e.u, e.p], [e.y[kept]]), ca.Function("K", [e.p], [e.K[:, kept]])
        return replace(
            full,
            output=lambda x, u, q: y(x, u, _stacked(full, q)),
            outputs=names,
            disturbance_gain=full.disturbance_gain and (lambda q: K(_stacked(full, q))),
        )


class ScheduledKind(Kind):
    """Structure whose parameters are polynomials in signals of the recording."""

    def __init__(self, structure: ScheduledStructure) -> None:
        self._structure = self.scheduled = self.plant = structure

    def anatomy(self, driven: Sequence[int] | None = None, moving: Sequence[int] | None = None) -> Anatomy:
        """Return the anatomy, with coefficients in place of scheduled parameters; see `Kind`."""
        structure, base = self._structure, kind_of(self._structure.base).anatomy(driven, moving)

        def renamed(names: frozenset[str]) -> frozenset[str]:
            m = len(structure.exponents)
            rows = (coefficient_names(name, m) if name in structure.surfaces else [name] for name in names)
            return frozenset(name for row in rows for name in row)

        return base._replace(
            in_equations=renamed(base.in_equations),
            in_x0=tuple(map(renamed, base.in_x0)),
            gain_only=renamed(base.gain_only),
        )

    def model(self, values: Mapping[str, float], inputs: Names = (), outputs: Names = ()) -> LinearModel:
        """Return the base model in the middle of the range, from the first coefficient of each surface; see `Kind`."""
        structure = self._structure
        first = {key: values[coefficient_names(key, 1)[0]] for key in structure.surfaces}
        middle = {q.name: first[q.name] if q.name in first else values[q.name] for q in structure.base.parameters}
        return evaluate(structure.base, middle, inputs, outputs)

    def without_inputs(self) -> AnyStructure:
        """Return the structure unchanged: a scheduled structure needs its inputs; see `Kind`."""
        return self._structure

    def with_outputs(self, kept: list[int], names: Names) -> AnyStructure | None:
        """Return the structure with some outputs of its base; see `Kind`."""
        base = kind_of(self._structure.base).with_outputs(kept, names)
        return base and replace(self._structure, base=base)  # type: ignore[arg-type]  # linear, as its base


@once
def _linear_anatomy(structure: Structure, driven: Sequence[int] | None, moving: Sequence[int] | None) -> Anatomy:
    """Return the anatomy of a linear structure; see `Kind`."""
    _, m = symbolic_matrices(structure)
    every = list(range(m.B.shape[1]))
    columns = every if driven is None else list(driven)
    parts = [
        m.A,
        m.C,
        m.B[:, columns],
        m.D[:, columns],
        m.B_delayed[:, columns],
        *(m.feedback.law if m.feedback else ()),
    ]
    if m.has_delay:
        parts.append(m.delay[every if moving is None else list(moving), :])
    begun, acting, gain = _by_row(m.x0), _names(parts), _names([m.K])
    has_gain = m.K.nnz() > 0 or m.feedback is not None
    return Anatomy(m.n_states, len(every), acting | gain, begun, has_gain, gain - acting.union(*begun))


@singledispatch
def kind_of(structure: Any) -> Kind:
    """Return the kind of a structure, with the methods that a fit needs."""
    return LinearKind(structure)


kind_of.register(NonlinearStructure, NonlinearKind)
kind_of.register(ScheduledStructure, ScheduledKind)


def _stacked(structure: Structure | NonlinearStructure, values: Any) -> Any:
    """Return parameter values (symbols or numbers) as one column, in the order of the structure."""
    return ca.vertcat(*(values[q.name] for q in structure.parameters))


def _by_row(x0: ca.SX) -> tuple[frozenset[str], ...]:
    return tuple(_names([row]) for row in ca.vertsplit(x0)) if x0.numel() else ()


def _names(parts: Sequence[ca.SX]) -> frozenset[str]:
    return frozenset(symbol.name() for symbol in ca.symvar(ca.veccat(*parts)))


# ---- Rotor bearing with a stiffening film, as a nonlinear structure.


def equations_of(structure: AnyStructure) -> AnyStructure:
    """Return the equations of a structure for a fit: nonlinear ones for a bearing with a stiffening film."""
    nonlinear = isinstance(structure, RotorBearing) and structure.film != "linear"
    return film_bearing(structure) if nonlinear else structure  # type: ignore[arg-type]  # a bearing, see above


def film_bearing(bearing: RotorBearing) -> NonlinearStructure:
    """Return the nonlinear equations of a rotor bearing with a stiffening film.

    The linear part is that of `RotorBearing.matrices`, with its delays as filters or exact. The film adds
    ``s |p|^2 K p`` to the acceleration.

    Parameters
    ----------
    bearing : RotorBearing
        The bearing, with ``film="stiffening"``.
    """
    order = bearing.pade_order
    exact = order is None

    def dynamics(x: Any, u: Any, p: Values) -> Any:
        linear = bearing.matrices(p)
        film = p[STIFFENING] * (x[0] ** 2 + x[1] ** 2) * (square(p, "k") @ x[:2])
        drive = linear["B"] + linear["B_delayed"] if exact else linear["B"]
        return linear["A"] @ x + drive @ u + ca.vertcat(ca.SX(2, 1), film, ca.SX(x.numel() - 4, 1))

    filters = [f"late_{axis}{i}" for axis in AXES for i in range(order or 0)]
    return NonlinearStructure(
        bearing.name,
        bearing.parameters,
        ["p_x", "p_y", "v_x", "v_y", *filters],
        dynamics,
        lambda x, _u, _p: x[:2],
        [f"{signal}.{axis}" for signal in bearing.inputs for axis in AXES],
        [f"{bearing.outputs[0]}.{axis}" for axis in AXES],
        intersample=bearing.intersample,
        disturbance_gain=None if bearing.disturbance_gain == "none" else lambda p: bearing.matrices(p)["K"],
        delay=(lambda p: bearing.matrices(p)["delay"]) if exact else None,
    )
