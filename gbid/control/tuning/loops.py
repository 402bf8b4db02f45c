"""Closed loops at many operating points as functions of the gains: matrices and their derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self, TypeVar

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy

from gbid.control.controllers.structures import Scheduled
from gbid.core.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.structure import LinearModel
from gbid.structure.delay import pade_delay
from gbid.structure.linear import Structure
from gbid.structure.parameter import Values

PADE_ORDER = 3
"""Order of the Padé delays of a loop that is designed for sampling."""


# ---- Calls of CasADi functions of one vector that write directly into numpy arrays.
#
# The usual call with `casadi.DM` copies entry by entry, which takes twenty times as long as the function itself.


class DirectCall:
    """CasADi function from one vector to dense matrices, each with m blocks side by side.

    Parameters
    ----------
    function : casadi.Function
        The function.
    m : int
        Number of blocks.
    slopes_of : DirectCall, optional
        Matrices whose derivatives these are: each block then has the derivatives of ``vec`` of a block of that.
    """

    def __init__(self, function: ca.Function, m: int, slopes_of: DirectCall | None = None) -> None:
        n_out = range(function.n_out())
        assert all(function.sparsity_out(i).is_dense() for i in n_out)
        buffer: Any
        buffer, self._trigger = function.buffer()  # its stub asks for a size besides, which a memoryview has
        self._buffer, self._input = buffer, np.zeros(max(function.numel_in(0), 1))
        self._outputs = [np.zeros(max(function.numel_out(i), 1)) for i in n_out]
        buffer.set_arg(0, self._input.data)
        self._orders: list[npt.NDArray[np.intp]] = []
        for i, output in enumerate(self._outputs):
            buffer.set_res(i, output.data)
            # places of the entries of each block; CasADi stores column after column
            rows, columns = function.size_out(i)
            places = np.arange(rows * columns).reshape(m, columns // m, rows)
            if slopes_of is None:
                self._orders.append(np.ascontiguousarray(places.transpose(0, 2, 1)))
            else:
                _, p, q = slopes_of._orders[i].shape
                self._orders.append(np.ascontiguousarray(places.reshape(m, columns // m, q, p).transpose(0, 1, 3, 2)))

    def __call__(self, x: FloatArray) -> list[FloatArray]:
        """Return the blocks of each output: (m, rows, columns), or derivatives (m, d, rows, columns)."""
        self._input[: len(x)] = x
        self._trigger()
        return list(map(np.take, self._outputs, self._orders))


# ---- Closed-loop matrices as functions of the gains, at many operating points at once.


@dataclass(frozen=True, eq=False)
class Loops:
    """Matrices of m loops: A (m, n, n), B (m, n, n_d), C (m, n_y, n), D (m, n_y, n_d)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def finite(self) -> bool:
        """Whether B, C and D are finite."""
        return all(np.isfinite(M).all() for M in (self.B, self.C, self.D))

    def of(self, loops: IntArray) -> Self:
        """Return the loops with the given indices."""
        return type(self)(*(getattr(self, entry.name)[loops] for entry in fields(self)))


@dataclass(frozen=True, eq=False)
class Derivatives(Loops):
    """Matrices of m loops, and derivatives of ``[[A, B], [C, D]]`` by d gains as products ``left core right``.

    Gains change a loop by the few signals of its controller only, so that these factors are small.

    Attributes
    ----------
    left : (m, n + n_y, k) array
        Effect of the changed signals.
    core : (m, d, k, l) array
        Derivatives of the controller by each gain.
    right : (m, l, n + n_d) array
        Signals that the controller takes.
    through : (m, l, k) array
        Effect of the changed signals on those that the controller takes, in no time.
    """

    left: FloatArray
    core: FloatArray
    right: FloatArray
    through: FloatArray

    def factors(self, loops: IntArray, rows: ComplexArray, columns: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return ``row left`` (k, p) and ``right column`` (k, l) for rows and columns of k loops.

        Rows (k, n) and columns (k, n) are those of A, with n_y and n_d more entries those of all matrices.
        """
        left, right = self.left[loops, : rows.shape[1]], self.right[loops][:, :, : columns.shape[1]]
        return (rows[:, None] @ left)[:, 0], (right @ columns[:, :, None])[:, :, 0]

    def along(self, loops: IntArray, rows: ComplexArray, columns: ComplexArray) -> ComplexArray:
        """Return ``row d[[A, B], [C, D]] column`` (k, d) for rows and columns of k loops, see `factors`."""
        inner, outer = self.factors(loops, rows, columns)
        return bilinear(inner, self.core[loops], outer)

    def second(
        self, bend: FloatArray, loops: IntArray, inner: ComplexArray, outer: ComplexArray, resolvent: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        r"""Return products and second derivatives of k perturbed loops.

        Parameters
        ----------
        bend : (m, d, d, k, l) array
            Second derivatives of the controller, of each loop or of all.
        loops, inner, outer
            Loops, and factors a (k, p) and b (k, l) as those of `factors`.
        resolvent : (k, n, n) array
            R, by which a change of the states acts on itself.

        Returns
        -------
        tuple of array
            With the derivatives :math:`K_p` of the controller :math:`a K_p` (k, d, l), :math:`K_p b` (k, d, p), and
            :math:`a K_{pq} b + a K_p R' K_q b + a K_q R' K_p b` (k, d, d), :math:`R'` being R between the signals.
        """
        n, (_, d, *size) = resolvent.shape[-1], self.core.shape
        core, bend = self.core[loops], bend[loops % len(bend)].reshape(len(loops), d * d, *size)
        by_row, by_column = (inner[:, None, None] @ core)[:, :, 0], (core @ outer[:, None, :, None])[..., 0]
        inside = self.right[loops][:, :, :n] @ resolvent @ self.left[loops, :n] + self.through[loops]
        cross = by_row @ inside @ by_column.swapaxes(1, 2)
        return by_row, by_column, bilinear(inner, bend, outer).reshape(cross.shape) + cross + cross.swapaxes(1, 2)


def bilinear(w: ComplexArray, M: FloatArray, v: ComplexArray) -> ComplexArray:
    """Return ``w M v`` of rows w (k, i), real matrices M (k, d, i, j) and columns v (k, j): (k, d)."""
    both = (w[:, :, None] * v[:, None, :]).reshape(len(w), w.shape[1] * v.shape[1])
    # One real product for real and imaginary part is faster than a complex copy of M.
    product = M.reshape(*M.shape[:2], both.shape[1]) @ np.stack([both.real, both.imag], axis=-1)
    return np.asarray(product[..., 0] + 1j * product[..., 1])


class Unmoved(NamedTuple):
    """Stable modes that no gain within the bounds moves, and gains that move no mode; see `gbid.control.tuning.reach`.

    Attributes
    ----------
    shift : (m, n, n) array
        Added to A, it makes these modes fast, so that they have no part in the objective.
    modes : tuple of (loop, rate)
        The modes: number of the loop and rate in continuous time [rad/s].
    idle : (d,) array of bool
        Gains that move no mode of these loops.
    """

    shift: FloatArray
    modes: tuple[tuple[int, complex], ...]
    idle: BoolArray


@dataclass(frozen=True, eq=False)
class LoopFamily(ABC):
    """Loops with matrices of equal size and common gains.

    Parameters
    ----------
    labels : tuple of str
        Name of each loop, for messages.
    points : (m, n_variables) array, optional
        Scheduling variables of each loop, when they are operating points.
    n_outputs : int
        Number of rows of C of the output sensitivity; the rows below are the control signals. 0: A only.
    sample_time : float, optional
        Sample time of sampled loops [s], whose matrices are then those of the bilinear transform, see `plane`.
    unmoved : Unmoved, optional
        Modes that no gain moves, which A does not have then.
    """

    labels: tuple[str, ...]
    points: FloatArray | None = None
    n_outputs: int = 0
    sample_time: float | None = None
    unmoved: Unmoved | None = None

    def __len__(self) -> int:
        return len(self.labels)

    @abstractmethod
    def matrices(self, gains: FloatArray) -> Loops:
        """Return the matrices of all loops."""

    @abstractmethod
    def derivatives(self, gains: FloatArray) -> Derivatives:
        """Return the matrices with their derivatives."""

    @abstractmethod
    def core(self, gains: FloatArray) -> FloatArray:
        """Return the core of the derivatives (m, d, k, l); m is 1 if the core is equal for all loops."""

    def bend(self, gains: FloatArray, steps: FloatArray) -> FloatArray:
        """Return derivatives (m, d, d, k, l) of the core by the gains, by differences with given steps (d,)."""
        near = np.stack(list(map(self.core, gains + np.diag(steps))), axis=1)
        return np.asarray((near - self.core(gains)[:, None]) / steps[:, None, None, None])

    def states(self, gains: FloatArray, loops: slice = slice(None)) -> FloatArray:
        """Return the system matrices A of the chosen loops (m, n, n)."""
        return self.matrices(gains).A[loops]


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionLoops(LoopFamily):
    """Loops whose matrices are given CasADi functions of the gains.

    Parameters
    ----------
    function : casadi.Function
        From the gains (d, 1) to A, B, C, D of all loops side by side: ``(n, n m)`` and so on.
    jacobian : casadi.Function
        From the gains to the derivatives of ``vec(A)``, ... of each loop, side by side: ``(n^2, d m)`` and so on.
    labels, points, n_outputs, sample_time, unmoved
        See `LoopFamily`.
    """

    function: ca.Function
    jacobian: ca.Function

    @cached_property
    def _calls(self) -> tuple[DirectCall, DirectCall]:
        matrices = DirectCall(self.function, len(self))
        return matrices, DirectCall(self.jacobian, len(self), matrices)

    def matrices(self, gains: FloatArray) -> Loops:
        """Return the matrices of all loops."""
        A, *others = self._calls[0](gains)
        return Loops(A if self.unmoved is None else A + self.unmoved.shift, *others)

    def derivatives(self, gains: FloatArray) -> Derivatives:
        """Return the matrices with their derivatives; left and right factors are unit matrices."""
        loops, core = self.matrices(gains), self.core(gains)
        rows, columns = core.shape[2:]
        left, right = (np.broadcast_to(M, (len(core), *M.shape)) for M in map(np.eye, (rows, columns)))
        through = np.zeros((len(core), columns, rows))
        return Derivatives(loops.A, loops.B, loops.C, loops.D, left, core, right, through)

    def core(self, gains: FloatArray) -> FloatArray:
        """Return the derivatives of all entries of the matrices."""
        dA, dB, dC, dD = self._calls[1](gains)
        core = np.concatenate([np.concatenate([dA, dB], axis=3), np.concatenate([dC, dD], axis=3)], axis=2)
        # an infinite derivative is as useless as NaN, which spreads without warnings
        return np.where(np.isfinite(core), core, np.nan)


def families_of(functions: Sequence[ca.Function], n_gains: int) -> tuple[LoopFamily, ...]:
    """Return families of loops from functions of the gains to A, or to A, B, C, D: one family for each size.

    Raises
    ------
    UsageError
        When a function does not have one input of n_gains numbers and a square matrix as its first output, or when its
        B, C, D do not fit.
    """
    by_size: dict[tuple[int, ...], list[tuple[str, ca.Function]]] = {}
    for i, function in enumerate(functions):
        if not isinstance(function, ca.Function):
            raise UsageError(f"A_of_gains[{i}] is not a casadi.Function")
        n, columns = function.size_out(0)
        if function.n_in() != 1 or function.numel_in(0) != n_gains or n != columns or n == 0:
            raise UsageError(
                f"A_of_gains[{i}] ({function.name()}): {function.n_in()} inputs of {function.size_in(0)} to "
                f"{(n, columns)}; it must take one vector of {n_gains} gains and give a square matrix"
            )
        by_size.setdefault((n, *_outputs(function, i, n)), []).append((f"A[{i}]", function))
    return tuple(_family_of_functions(group, n_gains, *sizes[1:]) for sizes, group in by_size.items())


def _outputs(function: ca.Function, i: int, n: int) -> tuple[int, int]:
    """Return the numbers of disturbances and outputs of a function to A, B, C, D; (0, 0) for a function to A only."""
    if function.n_out() == 1:
        return 0, 0
    sizes = [function.size_out(j) for j in range(function.n_out())]
    n_d, n_y = sizes[1][1], sizes[2][0] if len(sizes) == 4 else 0
    if len(sizes) != 4 or sizes[1:] != [(n, n_d), (n_y, n), (n_y, n_d)] or not 0 < n_d <= n_y:
        raise UsageError(
            f"A_of_gains[{i}] ({function.name()}): outputs of {', '.join(map(str, sizes))}; it must give A, or A, B, "
            "C, D from d disturbances to at least d outputs: first S_o, then the control signals"
        )
    return n_d, n_y


def _family_of_functions(group: list[tuple[str, ca.Function]], n_gains: int, n_d: int, n_y: int) -> LoopFamily:
    kind: Any = ca.SX if all(function.is_a("SXFunction") for _, function in group) else ca.MX
    g = kind.sym("gains", n_gains)
    n, every = group[0][1].size_out(0)[0], []
    for _, function in group:
        outputs = function(ca.reshape(g, *function.size_in(0)))
        matrices = list(outputs) if isinstance(outputs, tuple | list) else [outputs, kind(n, 0), kind(0, n), kind(0, 0)]
        every.append([ca.densify(M) for M in matrices])
    slopes = [[ca.densify(ca.jacobian(ca.vec(M), g)) for M in matrices] for matrices in every]
    matrices, jacobian = ([ca.horzcat(*column) for column in zip(*rows, strict=True)] for rows in (every, slopes))
    return FunctionLoops(
        tuple(label for label, _ in group),
        n_outputs=n_d if n_y else 0,
        function=ca.Function("matrices", [g], matrices),
        jacobian=ca.Function("slopes", [g], jacobian),
    )


# ---- Loops of plants and one controller: continuous, or sampled in the plane of the search.


class PlantMatrices(Loops):
    """Matrices of m plants of equal size: A (m, n, n), B (m, n, n_r), C (m, n_p, n), D (m, n_p, n_r)."""

    @classmethod
    def stacked(cls, models: Sequence[LinearModel]) -> PlantMatrices:
        """Return models of equal size as stacked matrices.

        Smaller models get additional states without connection. They decay fast, at different rates, so that the closed
        loop stays diagonalisable.
        """
        n, shape = max(model.n_states for model in models), models[0].D.shape
        A, B, C = (np.zeros((len(models), *size)) for size in ((n, n), (n, shape[1]), (shape[0], n)))
        fastest = max(float(np.abs(model.poles()).max()) if model.n_states else 1.0 for model in models)
        for i, model in enumerate(models):
            k = model.n_states
            A[i, :k, :k], B[i, :k], C[i, :, :k] = model.A, model.B, model.C
            spare = 1 + 0.1 * np.arange(n - k)
            A[i, k:, k:] = np.diag(0.02 * spare if model.dt is not None else -fastest * spare)
        return cls(A, B, C, np.array([model.D for model in models]))

    def delayed(self, delay_s: float) -> PlantMatrices:
        """Return the plants with all inputs delayed by Padé filters, whose states follow the states of the plant."""
        if not delay_s:
            return self
        filters, each = pade_delay(delay_s, PADE_ORDER), np.eye(self.B.shape[2])
        a, b, c, d = (np.kron(each, np.array(ca.DM(getattr(filters, letter)))) for letter in "ABCD")
        m, n = self.A.shape[:2]
        a, b = (np.broadcast_to(matrix, (m, *matrix.shape)) for matrix in (a, b))
        A = np.block([[self.A, self.B @ c], [np.zeros((m, a.shape[1], n)), a]])
        return PlantMatrices(
            A, np.concatenate([self.B @ d, b], axis=1), np.concatenate([self.C, self.D @ c], axis=2), self.D @ d
        )

    def in_plane(self, sample_time: float) -> PlantMatrices:
        """Return sampled plants in the plane of the search, ``w = (2 / T) (z - 1) / (z + 1)``."""
        eye, scale = np.eye(self.A.shape[-1]), 2 / np.sqrt(sample_time)
        P = inverses(self.A + eye)
        CP = self.C @ P
        return PlantMatrices(2 / sample_time * (eye - 2 * P), scale * P @ self.B, scale * CP, self.D - CP @ self.B)


_Number = TypeVar("_Number", np.float64, np.complex128)


def inverses(matrices: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
    """Return inverses of matrices; NaN or infinite for a singular matrix (algebraic loop, pole at z = -1)."""
    try:
        return np.asarray(np.linalg.inv(matrices), matrices.dtype)
    except np.linalg.LinAlgError:
        results = np.full(matrices.shape, np.nan, matrices.dtype)
        for place in np.ndindex(*matrices.shape[:-2]):
            with suppress(np.linalg.LinAlgError):
                results[place] = np.linalg.inv(matrices[place])
        return results


@dataclass(frozen=True, eq=False)
class ControllerLaw:
    """Matrices ``K = [[A, B], [C, D]]`` of a controller structure and their derivatives by the gains.

    A controller that is sampled by the trapezoidal rule (Tustin) is itself in the plane of the search.

    Attributes
    ----------
    n_states : int
        Number of states n of the controller.
    function, jacobian : casadi.Function
        From gains and point (scheduling variables) to K, and to the derivatives of ``vec(K)``.
    scheduled : bool
        Whether K depends on the point.
    held_s : float, optional
        Sample time of a controller with held inputs [s], whose matrices are those in the plane of the search.
    """

    n_states: int
    function: ca.Function
    jacobian: ca.Function
    scheduled: bool
    held_s: float | None = None

    @classmethod
    def of(cls, structure: Structure | Scheduled, shape: tuple[int, int], held_s: float | None = None) -> ControllerLaw:
        """Return the control law of a structure with given numbers of outputs and inputs.

        Raises
        ------
        UsageError
            When a matrix of the structure has another shape.
        """
        gains = tuple(structure.parameters)
        place = structure.domain.variables if isinstance(structure, Scheduled) else ()
        g, point = ca.SX.sym("gains", len(gains)), ca.SX.sym("point", len(place))
        given = structure.matrices(Values.of(gains, g), *ca.vertsplit(point))
        if not {"A", "C"} <= set(given):
            raise UsageError(f"controller {structure.name!r}: give A and C; without states SX(0, 0), SX(outputs, 0)")
        n, (n_r, n_p) = _as_sx(given["A"]).shape[0], shape
        sizes = {"A": (n, n), "B": (n, n_p), "C": (n_r, n), "D": (n_r, n_p)}
        matrices = {letter: _as_sx(given.get(letter, ca.SX(*size))) for letter, size in sizes.items()}
        for letter, size in sizes.items():
            if matrices[letter].shape != size:
                raise UsageError(
                    f"controller {structure.name!r}: {letter} has shape {matrices[letter].shape}, expected {size}"
                )
        K = ca.densify(ca.blockcat([[matrices["A"], matrices["B"]], [matrices["C"], matrices["D"]]]))
        slopes = ca.densify(ca.jacobian(ca.vec(K), g))
        function, jacobian = (ca.Function(name, [g, point], [M]) for name, M in (("law", K), ("slopes", slopes)))
        return cls(n, function, jacobian, bool(place), held_s)

    def at(self, points: FloatArray) -> tuple[DirectCall, DirectCall]:
        """Return K and its derivatives as functions of the gains, at points (m, n_variables) if K depends on them."""
        where = points.T if self.scheduled else np.zeros((0, 1))
        m, g = where.shape[1], ca.MX.sym("gains", self.function.size1_in(0))
        arguments = ca.repmat(g, 1, m), ca.DM(where)
        calls = [ca.Function("at_points", [g], [each.map(m)(*arguments)]) for each in (self.function, self.jacobian)]
        values = DirectCall(calls[0], m)
        return values, DirectCall(calls[1], m, values)

    def in_plane(self, K: FloatArray) -> FloatArray:
        r"""Return K (m, ., .) in the plane of the search, with held inputs for zero-order hold.

        With :math:`M = \begin{pmatrix} A & B \\ 0 & 0 \end{pmatrix}` the matrices of the state are
        :math:`(2/T) \tanh(M T/2)`, those of the output ``[C, D]`` minus ``T/2 C`` times them.
        """
        T, n = self.held_s, self.n_states
        if T is None:
            return K
        top = _tanh(_with_inputs(K, n), T)[..., :n, :]
        return np.concatenate([top, K[..., n:, :] - T / 2 * K[..., n:, :n] @ top], axis=-2)

    def slopes_in_plane(self, K: FloatArray, dK: FloatArray) -> FloatArray:
        """Return the derivatives (m, d, ., .) of `in_plane` by the gains, from the derivatives of K."""
        T, n = self.held_s, self.n_states
        if T is None:
            return dK
        # the derivative of a function of a matrix is a block of that function of [[M, dM], [0, M]]
        dM = _with_inputs(dK, n)
        M = np.broadcast_to(_with_inputs(K, n)[:, None], dM.shape)
        both = _tanh(np.block([[M, dM], [np.zeros(dM.shape), M]]), T)[..., :n, :]
        top, change = both[..., : dM.shape[-1]], both[..., dM.shape[-1] :]
        below = dK[..., n:, :] - T / 2 * (dK[..., n:, :n] @ top + K[:, None, n:, :n] @ change)
        return np.concatenate([change, below], axis=-2)


def _with_inputs(K: FloatArray, n: int) -> FloatArray:
    """Return square matrices of states and inputs, ``[[A, B], [0, 0]]``, of a controller with n states."""
    M = np.zeros((*K.shape[:-2], K.shape[-1], K.shape[-1]))
    M[..., :n, :] = K[..., :n, :]
    return M


def _tanh(M: FloatArray, T: float) -> FloatArray:
    """Return ``(2 / T) tanh(M T / 2)`` of matrices (..., n, n)."""
    E, eye = scipy.linalg.expm(T * M), np.eye(M.shape[-1])
    return np.asarray(2 / T * (E - eye) @ inverses(E + eye))


def _as_sx(value: Any) -> ca.SX:
    if isinstance(value, list | tuple):
        return ca.SX(ca.vertcat(*(ca.horzcat(*row) if isinstance(row, list | tuple) else row for row in value)))
    return ca.SX(value)


class Path(NamedTuple):
    """Names of the signals from and to which a response is taken; see `gbid.control.PeakResponse`."""

    sources: tuple[str, ...]
    targets: tuple[str, ...]


class Ports(NamedTuple):
    """Disturbances w and outputs q of m loops, with ``x' = A x + B r + E w``, ``p = C x + D r + F w``.

    The outputs are ``q = H x + J_r r + J_w w`` with the references r below them, of which `rows` are kept.
    """

    E: FloatArray
    F: FloatArray
    H: FloatArray
    J_r: FloatArray
    J_w: FloatArray
    rows: list[int]


@dataclass(frozen=True, eq=False)
class WholePlants:
    """Plants with all their channels; a controller drives some inputs and measures some outputs.

    Parameters
    ----------
    plants : PlantMatrices
        Continuous plants.
    inputs, outputs : tuple of str
        Names of all channels.
    driven, measured : tuple of str
        Channels of the controller, in the order of its outputs and inputs.
    """

    plants: PlantMatrices
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    driven: tuple[str, ...]
    measured: tuple[str, ...]

    def along(self, path: Path) -> tuple[PlantMatrices, Ports]:
        """Plants with the channels of the controller, and the disturbances and outputs of a path.

        Raises
        ------
        UsageError
            When the plant has no such signals.
        """
        A, B, C, D = vars(self.plants).values()
        r, p = [self.inputs.index(name) for name in self.driven], [self.outputs.index(name) for name in self.measured]
        for what, names, known, kinds in (
            ("source", path.sources, (*self.inputs, *self.measured), "inputs and measured outputs"),
            ("target", path.targets, (*self.outputs, *self.driven), "outputs and driven inputs"),
        ):
            for name in names:
                if name not in known:
                    raise UsageError(f"no {what} {name!r}; there are the {kinds} {', '.join(known)}")
        q = [self.outputs.index(name) for name in path.targets if name in self.outputs]
        E, J = np.zeros((*A.shape[:2], len(path.sources))), np.zeros((len(A), len(self.outputs), len(path.sources)))
        for i, name in enumerate(path.sources):
            if name in self.inputs:
                E[:, :, i], J[:, :, i] = B[:, :, self.inputs.index(name)], D[:, :, self.inputs.index(name)]
            else:
                J[:, self.outputs.index(name), i] = 1.0
        places = iter(range(len(q)))
        rows = [next(places) if name in self.outputs else len(q) + self.driven.index(name) for name in path.targets]
        ports = Ports(E, J[:, p], C[:, q], D[:, q][:, :, r], J[:, q], rows)
        return PlantMatrices(A, B[:, :, r], C[:, p], D[:, p][:, :, r]), ports


@dataclass(frozen=True, eq=False, kw_only=True)
class ControlLoops(LoopFamily):
    r"""Loops of plants given by their matrices, with the controller ``r = K (p + d)``.

    The outputs are ``p + d = S_o d`` and ``r = K S_o d`` (Eq. 22). With the states z of the controller, the system
    matrix of the loop from ``(x, z, d)`` to ``(x', z', p + d, r)`` is

    .. math:: S = S_0 + L\, (I - K E)^{-1} K\, R

    where R leads to ``(z, C x + d)``, L leads from ``(z', r)``, and E adds the feedthrough D r of the plant. With
    `ports` the disturbances and outputs are other signals of the plant.

    Parameters
    ----------
    plants : PlantMatrices
        The plants; sampled ones in the plane of the search.
    law : ControllerLaw
        The controller.
    companion : LoopFamily, optional
        The same loops in continuous time, for measures that need it.
    whole : callable, optional
        Returns the plants with all their channels.
    ports : Ports, optional
        Disturbances and outputs in place of d and ``p + d``.
    labels, points, n_outputs, sample_time, unmoved
        See `LoopFamily`.
    """

    plants: PlantMatrices
    law: ControllerLaw
    companion: ControlLoops | None = None
    whole: Callable[[], WholePlants] | None = None
    ports: Ports | None = None
    _paths: dict[Path, ControlLoops] = field(default_factory=dict, init=False, repr=False)

    def along(self, path: Path) -> ControlLoops:
        """Return the continuous loops with the disturbances and outputs of a path.

        Raises
        ------
        UsageError
            When the plant has no such signals.
        """
        if self.companion is not None:
            return self.companion.along(path)
        if path not in self._paths:
            assert self.whole is not None
            plants, ports = self.whole().along(path)
            self._paths[path] = replace(self, plants=plants, ports=ports, n_outputs=len(path.targets), unmoved=None)
        return self._paths[path]

    @cached_property
    def _calls(self) -> tuple[DirectCall, DirectCall]:
        assert self.points is not None
        return self.law.at(self.points)

    @cached_property
    def _frame(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Matrices of the loop that do not depend on the gains: S_0, L, R and E, each (m, ., .)."""
        plants, k = self.plants, self.law.n_states
        m, n, n_r = plants.B.shape
        n_p = plants.C.shape[1]
        unit = np.broadcast_to(np.eye(n_p), (m, n_p, n_p))
        ports = self.ports or Ports(np.zeros((m, n, n_p)), unit, plants.C, plants.D, unit, [])
        n_q, n_w = ports.J_w.shape[1:]
        rest = np.zeros((m, n + k + n_q + n_r, n + k + n_w))
        rest[:, :n, :n], rest[:, n + k : -n_r, :n] = plants.A, ports.H
        rest[:, :n, n + k :], rest[:, n + k : -n_r, n + k :] = ports.E, ports.J_w
        left = np.zeros((m, rest.shape[1], k + n_r))
        left[:, :n, k:], left[:, n : n + k, :k] = plants.B, np.eye(k)
        left[:, n + k : -n_r, k:], left[:, -n_r:, k:] = ports.J_r, np.eye(n_r)
        right = np.zeros((m, k + n_p, rest.shape[2]))
        right[:, :k, n : n + k], right[:, k:, :n], right[:, k:, n + k :] = np.eye(k), plants.C, ports.F
        through = np.zeros((m, k + n_p, k + n_r))
        through[:, k:, k:] = plants.D
        n = n + k
        kept = slice(None) if self.ports is None else [*range(n), *(n + row for row in ports.rows)]
        return rest[:, kept], left[:, kept], right, through

    def states(self, gains: FloatArray, loops: slice = slice(None)) -> FloatArray:
        """Return the system matrices A of the chosen loops (m, n, n)."""
        return self.matrices(gains, loops).A

    def matrices(self, gains: FloatArray, loops: slice = slice(None)) -> Loops:
        """Return the matrices of the chosen loops."""
        K, (rest, left, right, E) = self.law.in_plane(self._calls[0](gains)[0]), self._frame
        if loops != slice(None):
            K = K[loops] if self.law.scheduled else K
            rest, left, right, E = rest[loops], left[loops], right[loops], E[loops]
        if E.any():
            K = inverses(np.eye(K.shape[-2]) - K @ E) @ K
        system, n = rest + left @ K @ right, self.plants.A.shape[-1] + self.law.n_states
        A = system[:, :n, :n].copy() if self.unmoved is None else system[:, :n, :n] + self.unmoved.shift[loops]
        return Loops(A, system[:, :n, n:], system[:, n:, :n], system[:, n:, n:])

    def derivatives(self, gains: FloatArray) -> Derivatives:
        """Return the matrices with their derivatives."""
        (_, left, right, E), core, loops = self._frame, self.core(gains), self.matrices(gains)
        if E.any():  # (I - E K)^-1 = I + E (I - K E)^-1 K
            K = self.law.in_plane(self._calls[0](gains)[0])
            inverse = inverses(np.eye(K.shape[-2]) - K @ E)
            left, right = left @ inverse, right + E @ inverse @ K @ right
        core = np.broadcast_to(core, (len(self), *core.shape[1:]))
        return Derivatives(loops.A, loops.B, loops.C, loops.D, left, core, right, E)

    def core(self, gains: FloatArray) -> FloatArray:
        """Return the derivatives of the controller matrices by the gains."""
        values, slopes = self._calls
        return self.law.slopes_in_plane(values(gains)[0], slopes(gains)[0])
