"""Delay by sampling and computation, approximated in a continuous loop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Self

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.control.controllers.scheduled import Scheduled, controller_at
from gbid.control.loop.close import Method
from gbid.control.loop.sampled import exact_plant, sampled_loop
from gbid.core.arrays import FloatArray, is_finite, point_label
from gbid.core.errors import UsageError
from gbid.lpv import LPVModel
from gbid.structure import KEY_PARAMETERS, Parameter, PiezoPair, Plant, RotorBearing, pade_delay
from gbid.structure.linear import Structure
from gbid.structure.parameter import Values

PADE_ORDER = 3
"""Order of the Padé delays of a loop that is designed for sampling."""


def loop_delay(sample_time: float | None, computation_s: float | None) -> float:
    """Return the delay by holding the references (half a sample) and by their computation (one sample by default) [s].

    Raises
    ------
    UsageError
        When a time is not allowed, or when a computation time is given without a sample time.
    """
    if sample_time is None:
        if computation_s is not None:
            raise UsageError("computation_s: give sample_time as well")
        return 0.0
    computation = sample_time if computation_s is None else computation_s
    if not (is_finite(sample_time) and sample_time > 0):
        raise UsageError(f"sample_time = {sample_time!r}; give seconds, above 0")
    if not (is_finite(computation) and computation >= 0):
        raise UsageError(f"computation_s = {computation!r}; give seconds, 0 or more")
    return computation + sample_time / 2


def smallest_sampled_damping(
    lpv: LPVModel,
    controller: Structure | Scheduled,
    gains: Mapping[str, float],
    points: Iterable[tuple[float, float]],
    sample_time: float,
    computation_s: float | None,
    method: Method = "tustin",
) -> tuple[float, tuple[float, float]]:
    """Return the smallest damping factor of the sampled loop over points, and its point; -1 when it is unstable.

    Delays are exact.
    """
    found = []
    for point in points:
        K = controller_at(controller, gains, *point)
        loop = sampled_loop(exact_plant(lpv, *point), K, sample_time, computation_s=computation_s, method=method)
        found.append((loop.damping if loop.stable else -1.0, point))
    return min(found)


def delayed_outputs(controller: dict[str, ca.SX], delay_s: float) -> dict[str, ca.SX]:
    """Return a controller with both outputs delayed.

    Parameters
    ----------
    controller : dict of str to casadi.SX
        A (n, n), B (n, 2), C (2, n), D (2, 2).
    delay_s : float
        Delay [s], as a Padé approximation of order `PADE_ORDER`; 0 leaves the controller unchanged.

    Returns
    -------
    dict of str to casadi.SX
        Matrices; the states of the delays follow those of the controller.
    """
    if not delay_s:
        return controller
    A, B, C, D = (controller[letter] for letter in "ABCD")
    late, two = pade_delay(delay_s, PADE_ORDER), ca.SX.eye(2)
    a, b, c, d = (ca.kron(two, M) for M in (late.A, late.B, late.C, late.D))
    return {
        "A": ca.blockcat([[A, ca.SX(A.shape[0], a.shape[0])], [b @ C, a]]),
        "B": ca.vertcat(B, b @ D),
        "C": ca.horzcat(d @ C, c),
        "D": d @ D,
    }


# ---- Calls of CasADi functions of one vector that write directly into numpy arrays.
#
# The usual call with `casadi.DM` copies entry by entry, which takes twenty times as long as the function itself.


@dataclass(frozen=True, eq=False)
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

    function: ca.Function
    m: int
    slopes_of: DirectCall | None = None
    _buffer: Any = field(init=False, repr=False)
    _trigger: Any = field(init=False, repr=False)
    _input: FloatArray = field(init=False, repr=False)
    _outputs: tuple[FloatArray, ...] = field(init=False, repr=False)
    _orders: tuple[npt.NDArray[np.intp], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n_out = range(self.function.n_out())
        assert all(self.function.sparsity_out(i).is_dense() for i in n_out)
        buffer: Any
        buffer, trigger = self.function.buffer()  # its stub asks for a size besides, which a memoryview has
        given = np.zeros(max(self.function.numel_in(0), 1))
        outputs = tuple(np.zeros(max(self.function.numel_out(i), 1)) for i in n_out)
        buffer.set_arg(0, given.data)
        for i, output in enumerate(outputs):
            buffer.set_res(i, output.data)
        orders = tuple(map(self._order, n_out))
        for name, value in (("_buffer", buffer), ("_trigger", trigger), ("_input", given), ("_outputs", outputs)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_orders", orders)

    def _order(self, i: int) -> npt.NDArray[np.intp]:
        """Return the places of the entries of each block in an output; CasADi stores column after column."""
        rows, columns = self.function.size_out(i)
        places = np.arange(rows * columns).reshape(self.m, columns // self.m, rows)
        if self.slopes_of is None:
            return np.ascontiguousarray(places.transpose(0, 2, 1))
        _, p, q = self.slopes_of._orders[i].shape
        return np.ascontiguousarray(places.reshape(self.m, columns // self.m, q, p).transpose(0, 1, 3, 2))

    def __call__(self, x: FloatArray) -> tuple[FloatArray, ...]:
        """Return the blocks of each output: (m, rows, columns), or derivatives (m, d, rows, columns)."""
        self._input[: len(x)] = x
        self._trigger()
        return tuple(output.take(order) for output, order in zip(self._outputs, self._orders, strict=True))


# ---- Closed-loop matrices as functions of the gains, at many operating points at once.


@dataclass(frozen=True)
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

    def of(self, loops: npt.NDArray[np.intp]) -> Self:
        """Return some of the loops."""
        return type(self)(*(getattr(self, entry.name)[loops] for entry in fields(self)))


@dataclass(frozen=True)
class Derivatives(Loops):
    """Matrices of loops and their derivatives by each gain, with the d gains as second axis."""

    dA: FloatArray
    dB: FloatArray
    dC: FloatArray
    dD: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Derivatives]) -> Derivatives:
        """Return the loops of all parts, one part after the other."""
        return cls(*(np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(cls)))


@dataclass(frozen=True, eq=False)
class LoopFamily:
    """Loops of equal size with common gains.

    Parameters
    ----------
    function : casadi.Function
        From the gains (d, 1) to A, B, C, D of all loops side by side: ``(n, n m)`` and so on.
    jacobian : casadi.Function
        From the gains to the derivatives of ``vec(A)``, ... of each loop, side by side: ``(n^2, d m)`` and so on.
    labels : tuple of str
        Name of each loop, for messages.
    points : (m, 2) array, optional
        Pressure [bar] and speed [rpm] of each loop, when they are operating points.
    n_outputs : int
        Number of rows of C of the output sensitivity; the rows below are the control signals. 0: A only.
    sample_time : float, optional
        Sample time of sampled loops [s], whose matrices are then those of the bilinear transform, see `plane`.
    """

    function: ca.Function
    jacobian: ca.Function
    labels: tuple[str, ...]
    points: FloatArray | None = None
    n_outputs: int = 0
    sample_time: float | None = None
    _calls: dict[str, DirectCall] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        matrices = DirectCall(self.function, len(self))
        self._calls.update(matrices=matrices, slopes=DirectCall(self.jacobian, len(self), matrices))

    def __len__(self) -> int:
        return len(self.labels)

    def matrices(self, gains: FloatArray) -> Loops:
        """Return the matrices of all loops."""
        return Loops(*self._calls["matrices"](gains))

    def states(self, gains: FloatArray) -> FloatArray:
        """Return A (m, n, n)."""
        return self.matrices(gains).A

    def derivatives(self, gains: FloatArray) -> Derivatives:
        """Return the matrices with their derivatives."""
        values, slopes = self._calls["matrices"](gains), self._calls["slopes"](gains)
        # an infinite derivative is as useless as NaN, which spreads without warnings
        return Derivatives(*values, *(slope if np.isfinite(slope).all() else _only_finite(slope) for slope in slopes))


def _only_finite(slope: FloatArray) -> FloatArray:
    return np.where(np.isfinite(slope), slope, np.nan)


def families_of(functions: Sequence[ca.Function], n_gains: int) -> tuple[LoopFamily, ...]:
    """Return families of given functions from gains to A, or to A, B, C, D: one family for loops of equal sizes.

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
    """Return the numbers of disturbances and outputs of a function to A, B, C, D; zero of a function to A alone."""
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
        found = function(ca.reshape(g, *function.size_in(0)))
        matrices = list(found) if isinstance(found, tuple | list) else [found, kind(n, 0), kind(0, n), kind(0, 0)]
        every.append([ca.densify(M) for M in matrices])
    slopes = [[ca.densify(ca.jacobian(ca.vec(M), g)) for M in matrices] for matrices in every]
    return LoopFamily(
        ca.Function("matrices", [g], [ca.horzcat(*column) for column in zip(*every, strict=True)]),
        ca.Function("slopes", [g], [ca.horzcat(*column) for column in zip(*slopes, strict=True)]),
        tuple(label for label, _ in group),
        n_outputs=n_d if n_y else 0,
    )


@dataclass(frozen=True, eq=False)
class LoopEquations:
    r"""Closed loop of an LPV plant and a controller structure, symbolic in gains, pressure and speed.

    With the plant ``x' = A x + B r, p = C x`` (Eq. 20), the controller ``K`` and a disturbance d on the measured
    position, ``r = K (p + d)``:

    .. math:: A_{cl} = \begin{pmatrix} A + B D_K C & B C_K \\ B_K C & A_K \end{pmatrix},\quad
              B_{cl} = \begin{pmatrix} B D_K \\ B_K \end{pmatrix}

    The outputs are ``p + d = S_o d`` and ``r = K S_o d`` (Eq. 22).

    Parameters
    ----------
    gains : tuple of Parameter
        Gains of the controller.
    function : casadi.Function
        ``(gains, scenario) -> A, B, C, D``. A scenario has pressure [bar], speed [rpm] and a deviation of each of the
        fourteen key parameters.
    jacobian : casadi.Function
        ``(gains, scenario)`` to the derivatives of ``vec`` of each matrix by the gains.
    """

    gains: tuple[Parameter, ...]
    function: ca.Function
    jacobian: ca.Function

    def family(self, scenarios: FloatArray, labels: Sequence[str] | None = None) -> LoopFamily:
        """Return the loops at given scenarios (m, 16), or at (m, 2) pressures and speeds."""
        S = np.zeros((len(scenarios), 2 + len(KEY_PARAMETERS)))
        S[:, : scenarios.shape[1]] = scenarios
        m, g = len(S), ca.MX.sym("gains", len(self.gains))
        args = [ca.repmat(g, 1, m), ca.DM(S.T)]
        if labels is None:
            labels = [point_label(P, Omega) for P, Omega in S[:, :2]]
        mapped: list[Any] = [f.map(m)(*args) for f in (self.function, self.jacobian)]
        values, slopes = (ca.Function("loops", [g], list(outputs)) for outputs in mapped)
        return LoopFamily(values, slopes, tuple(labels), np.ascontiguousarray(S[:, :2]), 2)


def loop_equations(
    lpv: LPVModel,
    controller: Structure | Scheduled,
    actuator: dict[str, float] | None = None,
    *,
    delay_s: float = 0.0,
) -> LoopEquations:
    """Return the symbolic closed loop for all operating points.

    Parameters
    ----------
    lpv : LPVModel
        Model of the plant.
    controller : Structure or Scheduled
        Controller from p to r; see `gbid.controller_structure` and `gbid.control.scheduled`.
    actuator : dict of str to float, optional
        Parameters of Eq. 12 [rad/s, m/m]; by default those of the model.
    delay_s : float
        Additional delay of the loop by sampling and computation [s].

    Returns
    -------
    LoopEquations

    Raises
    ------
    UsageError
        When there are no actuators, or when the controller does not have two inputs and two outputs.
    """
    actuators = dict(lpv.actuators if actuator is None else actuator)
    missing = [parameter.name for parameter in PiezoPair().parameters if parameter.name not in actuators]
    if missing:
        raise UsageError(f"model {lpv.name!r} has no actuator {', '.join(missing)}; give actuator={{...}}")
    gains = tuple(controller.parameters)
    g, s = ca.SX.sym("gains", len(gains)), ca.SX.sym("scenario", 2 + len(KEY_PARAMETERS))
    key = lpv.key_parameters(s[0], s[1])
    values = {**actuators, **{name: key[name] + s[2 + i] for i, name in enumerate(KEY_PARAMETERS)}}
    plant = Plant(RotorBearing(lpv.pade_order, disturbance_gain="none"), PiezoPair(), outputs=("p",))
    G = plant.matrices(Values(values))
    K = delayed_outputs(controller_matrices(controller, gains, g, s), delay_s)
    n, n_K = G["A"].shape[0], K["A"].shape[0]
    A = ca.blockcat([[G["A"] + G["B"] @ K["D"] @ G["C"], G["B"] @ K["C"]], [K["B"] @ G["C"], K["A"]]])
    B = ca.vertcat(G["B"] @ K["D"], K["B"])
    C = ca.blockcat([[G["C"], ca.SX(2, n_K)], [K["D"] @ G["C"], K["C"]]])
    D = ca.vertcat(ca.SX.eye(2), K["D"])
    assert A.shape == (n + n_K, n + n_K)
    matrices = [ca.densify(ca.SX(M)) for M in (A, B, C, D)]
    slopes = [ca.densify(ca.jacobian(ca.vec(M), g)) for M in matrices]
    return LoopEquations(gains, ca.Function("loop", [g, s], matrices), ca.Function("slopes", [g, s], slopes))


def controller_matrices(
    controller: Structure | Scheduled,
    gains: tuple[Parameter, ...],
    g: ca.SX,
    s: ca.SX,
    size: tuple[int, int] = (2, 2),
) -> dict[str, ca.SX]:
    """Return the symbolic matrices A, B, C, D of a controller.

    Parameters
    ----------
    controller : Structure or Scheduled
        The controller.
    gains : tuple of Parameter
        Its gains.
    g, s : casadi.SX
        Values of the gains; pressure [bar] and speed [rpm].
    size : (n_outputs, n_inputs)
        Number of outputs and of inputs.

    Raises
    ------
    UsageError
        When a matrix has another shape.
    """
    values = Values.of(gains, g)
    if isinstance(controller, Scheduled):
        given = dict(controller.matrices(values, s[0], s[1]))
    else:
        given = dict(controller.matrices(values))
    given.setdefault("D", ca.SX(*size))
    K = {letter: _as_sx(given[letter]) for letter in "ABCD"}
    n, (n_r, n_p) = K["A"].shape[0], size
    for letter, shape in {"A": (n, n), "B": (n, n_p), "C": (n_r, n), "D": (n_r, n_p)}.items():
        if K[letter].shape != shape:
            raise UsageError(f"controller {controller.name!r}: {letter} has shape {K[letter].shape}, expected {shape}")
    return K


def _as_sx(value: Any) -> ca.SX:
    if isinstance(value, list | tuple):
        return ca.SX(ca.vertcat(*(ca.horzcat(*row) if isinstance(row, list | tuple) else row for row in value)))
    return ca.SX(value)
