"""Linear model structures: symbolic state-space matrices as functions of parameters, and feedback of a controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isnan
from typing import Any, NamedTuple, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import checks_arguments
from gbid.discretise import Hold
from gbid.discretise.dual import Dual
from gbid.discretise.exact import Exponentials, delayed_taps, discretise
from gbid.structure.models import LinearModel
from gbid.structure.parameter import Parameter, Values, as_vector, once, set_fields

# ---- Feedback of a controller, with matrices of symbols, numbers or duals.


class LoopParts(NamedTuple):
    """State-space matrices of a plant or a loop, as casadi.SX, arrays or `Dual`.

    ``x' = A x + B w + K e``, ``y = C x + D w + e``.
    """

    A: Any
    B: Any
    C: Any
    D: Any
    K: Any


class ControlLaw(NamedTuple):
    """Controller ``z' = A z + B s``, ``r = C z + D s`` with measured outputs s, as casadi.SX, arrays or `Dual`.

    Attributes
    ----------
    A, B, C, D
        (n, n), (n, n_measured), (n_r, n), (n_r, n_measured).
    drive, feed
        Matrices from r to the states and to the outputs of the plant that it acts on; None without a plant.
    late, delay
        Matrix from r to the states of the plant through exact delays (n_states, n_r), and the delays [s] (n_r, 1); None
        without a plant.
    """

    A: Any
    B: Any
    C: Any
    D: Any
    drive: Any = None
    feed: Any = None
    late: Any = None
    delay: Any = None


class HeldFeedback(NamedTuple):
    """Sampled controller in feedback with a continuous plant; its output is held between samples.

    Attributes
    ----------
    law : ControlLaw
        The controller as casadi.SX, from sample to sample.
    measured : tuple of int
        Outputs that it measures.
    set_point : bool
        Whether the injected signal is a set point, see `closed_parts`.
    sample_time : float
        Time between samples [s].
    memory : int
        Past samples of the inputs of the plant that its exact delays need. They are states between those of the plant
        and those of the controller.
    """

    law: ControlLaw
    measured: tuple[int, ...]
    set_point: bool
    sample_time: float
    memory: int = 0

    @property
    def n_states(self) -> int:
        """Number of states of the controller, including its memory of past inputs."""
        return int(self.law.A.shape[0]) + self.memory * int(self.law.drive.shape[1])

    def refuse_other_data(self, name: str, holds: Sequence[str], sample_time: float) -> None:
        """Refuse data with a sample time unlike the controller's, or with inputs that are not held.

        Raises
        ------
        UsageError
            When the data have another sample time, or inputs that are not held.
        """
        if not np.isclose(self.sample_time, sample_time, rtol=1e-6, atol=0):
            raise UsageError(
                f"{name}: the controller runs every {self.sample_time:g} s, the recordings are sampled at "
                f"{sample_time:g} s"
            )
        if "foh" in holds:
            raise UsageError(
                f"{name}: intersample = 'foh'; the injected signal is held like the output of the controller; use 'zoh'"
            )

    def close(
        self, plant: LoopParts, law: ControlLaw, A: Any, n_injected: int, whole: Exponentials | None = None
    ) -> LoopParts:
        """Return the discrete-time loop of a plant with held inputs and this controller.

        Parameters
        ----------
        plant : LoopParts
            The plant in samples, as arrays or `Dual`; its first inputs are what is injected.
        law : ControlLaw
            The numbers of `law`, with `drive` in samples.
        A : (n, n) array or Dual
            State matrix of the plant in continuous time.
        n_injected : int
            Number of injected signals.
        whole : Exponentials, optional
            Those of ``A`` over a sample, where they are known.

        Notes
        -----
        An exact delay of d samples and a part of one acts with the inputs of the samples k - d and k - d - 1. So the
        last inputs are states of the loop, which is exact for every delay.

        Raises
        ------
        UsageError
            When a delay is negative or longer than the memory.
        """
        if not self.memory:
            return closed_parts(plant, law, self.measured, self.set_point)
        n, n_r = law.drive.shape
        size = n + self.memory * n_r
        x_in, slots = np.eye(size, n), np.split(np.eye(size)[:, n:], self.memory, axis=1)
        F = x_in @ plant.A @ x_in.T + sum(after @ slot.T for slot, after in pairwise(slots))
        enter: Any = slots[0]
        for inputs, delay in _equal_delays(law.delay):
            taps = delayed_taps(A, law.late @ np.eye(n_r)[:, inputs], delay, self.sample_time, "zoh", whole=whole)
            if taps.shift > self.memory:
                raise UsageError(
                    f"a delay of {taps.shift} samples in a loop exceeds the {self.memory} samples of its upper bound; "
                    "raise the bound"
                )
            for lag, column in enumerate(taps.columns[1:], start=taps.shift):
                reached = x_in @ column @ np.eye(n_r)[inputs]
                if lag == 0:
                    enter = enter + reached
                else:  # at the upper bound the last column is zero
                    F = F + reached @ slots[min(lag, self.memory) - 1].T
        injected = np.eye(n_r, plant.B.shape[1]) * (np.arange(plant.B.shape[1]) < n_injected) * (not self.set_point)
        held = LoopParts(F, x_in @ plant.B + enter @ injected, plant.C @ x_in.T, plant.D, x_in @ plant.K)
        return closed_parts(held, law._replace(drive=x_in @ law.drive + enter), self.measured, self.set_point)


def _equal_delays(delay: Any) -> list[tuple[list[int], Any]]:
    """Return the inputs grouped by delay, from (n_r, 1): equal delays need one matrix exponential."""
    groups: dict[bytes | float, tuple[list[int], Any]] = {}
    for i in range(delay.shape[0]):
        one = delay.rows([i]) if isinstance(delay, Dual) else float(delay[i, 0])
        key = one.value.tobytes() + one.slope.tobytes() if isinstance(one, Dual) else one
        groups.setdefault(key, ([], one))[0].append(i)
    return list(groups.values())


def closed_parts(plant: LoopParts, law: ControlLaw, measured: Sequence[int], set_point: bool) -> LoopParts:
    r"""Return the closed loop of a plant and a controller; states of the plant come first.

    The controller measures the outputs with their errors, so that the errors e drive it, too:

    .. math:: x' &= A x + B w + B_r r + K e, \quad y = C x + D w + D_r r + e \\
              z' &= A_K z + B_K S y, \quad r = C_K z + D_K S y

    where S selects the measured outputs.

    Parameters
    ----------
    plant : LoopParts
        The plant, from what is injected.
    law : ControlLaw
        The controller. Its D or its `feed` must be zero.
    measured : sequence of int
        Outputs that the controller measures.
    set_point : bool
        Whether w is a set point: the controller gets ``S y - w``. The columns of `plant.B` are then zero.

    Returns
    -------
    LoopParts
    """
    n, n_z, n_y = plant.A.shape[0], law.A.shape[0], plant.C.shape[0]
    reference = np.eye(len(measured), plant.B.shape[1]) * set_point  # the set point as the first columns
    x_in, z_in, S, less = (
        constant_like(plant.A, matrix)
        for matrix in (np.eye(n + n_z, n), np.eye(n + n_z)[:, n:], np.eye(n_y)[list(measured)], reference)
    )
    via = x_in @ law.drive @ law.D + z_in @ law.B  # from what the controller gets to all states
    C = plant.C @ x_in.T + law.feed @ law.C @ z_in.T
    A = x_in @ plant.A @ x_in.T + x_in @ law.drive @ law.C @ z_in.T + z_in @ law.A @ z_in.T + via @ S @ C
    B = x_in @ plant.B + via @ (S @ plant.D - less)
    return LoopParts(A, B, C, plant.D, x_in @ plant.K + via @ S)


def constant_like(kind: Any, matrix: FloatArray) -> Any:
    """Return a constant matrix in the type of a factor: casadi.DM for casadi.SX, else an array."""
    return ca.sparsify(ca.DM(matrix)) if isinstance(kind, ca.SX) else matrix


_SYMBOLS = (
    "parameters are CasADi symbols: use casadi functions (casadi.sqrt for math.sqrt, casadi.fmax for max, "
    "casadi.if_else for if) and nested lists or casadi.SX.zeros(n, m) for a matrix that is filled entry by entry"
)
"""What to do about Python that needs numbers."""


class Matrices(NamedTuple):
    """State-space matrices of a structure as casadi.SX.

    ``xd(t) = A x(t) + B u(t) + B_delayed u(t - delay) + K e(t)``, ``y = C x + D u + e``. Without exact delays `delay`
    is empty and `B_delayed` has no entries. ``x(0) = x0``; without a stated initial state `x0` is empty.

    Attributes
    ----------
    A, B, C, D, K : casadi.SX
        (n, n), (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs), (n, n_outputs).
    B_delayed, delay : casadi.SX
        (n, n_inputs), (n_inputs, 1) [s].
    x0 : casadi.SX
        (n, 1).
    feedback : HeldFeedback, optional
        Sampled controller that closes a loop around these matrices, which are then those of the plant. Its states
        follow those of the plant, also in `x0`.
    """

    A: ca.SX
    B: ca.SX
    C: ca.SX
    D: ca.SX
    K: ca.SX
    B_delayed: ca.SX
    delay: ca.SX
    x0: ca.SX
    feedback: HeldFeedback | None = None

    @property
    def has_delay(self) -> bool:
        """Whether inputs have exact delays."""
        return self.delay.numel() > 0

    @property
    def n_states(self) -> int:
        """Number of states, including the controller's."""
        return int(self.A.shape[0]) + (self.feedback.n_states if self.feedback else 0)


@runtime_checkable
class Structure(Protocol):
    """Protocol of a model structure: equations and parameters for a fit, independent of any solver.

    Attributes
    ----------
    name : str
        Name of the structure.
    parameters : tuple of Parameter
        Parameters in order.
    inputs, outputs : tuple of str
        Default input and output signals of a recording; a fit can name others.
    intersample : {"zoh", "foh"}
        Default inter-sample behaviour of the inputs; a fit can name another.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def parameters(self) -> tuple[Parameter, ...]: ...  # noqa: D102
    @property
    def inputs(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def outputs(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def intersample(self) -> Hold | tuple[Hold, ...]: ...  # noqa: D102

    def matrices(self, p: Values) -> Mapping[str, Any]:
        """Return ``{"A", "B", "C", "D", "K"}`` as CasADi matrices of the parameters; D and K may be left out.

        A structure without inputs may leave out B as well.

        ``"B_delayed"`` (n, n_inputs) and ``"delay"`` (n_inputs, 1) [s] together define an exact input delay. ``"x0"``
        (n, 1) is the initial state, when it is a function of the parameters.

        Parameters
        ----------
        p : Values
            Parameters by name, ``p.k`` or ``p["k"]``, numbers or symbols.
        """
        ...


@dataclass(frozen=True)
class OnBase:
    """Structure that takes inputs, outputs and inter-sample behaviour from a base structure.

    Attributes
    ----------
    base : Structure
        Structure at one operating point.
    """

    base: Structure

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


@dataclass(frozen=True)
class LinearStructure(Brief):
    """Linear model structure defined by a user.

    Parameters
    ----------
    name : str
        Name of the structure.
    parameters : sequence of Parameter
        Parameters. Start values that are left out are estimated from the data.
    matrices : callable
        ``matrices(p) -> {"A", "B", "C", "D", "K"}``: CasADi matrices (or nested lists of symbols and numbers)
        of the continuous-time model for parameters ``p["name"]`` (also ``p.name``). D and K may be left out, and B for
        a structure without inputs.
        ``"B_delayed"`` and ``"delay"`` (one per input, s) add inputs with exact delays. ``"x0"`` (one per state) is the
        initial state of every recording as a function of the parameters, such as the angle of a pendulum that is
        released at rest.
    inputs, outputs : str or sequence of str
        Signals of the recordings; ``"p.x"`` selects one channel. ``inputs=()`` for a structure that only decays.
    intersample : {"zoh", "foh"}
        Inter-sample behaviour of the inputs.

    Raises
    ------
    UsageError
        When two parameters have the same name, or when there are no outputs.

    Examples
    --------
    >>> def arm(p):
    ...     return {"A": [[0, 1], [0, -p.b1]], "B": [[0], [p.K2]], "C": [[1, 0]]}
    >>> LinearStructure("arm", [Parameter("b1", 1.0), Parameter("K2", 1.0)], arm, "u", "y").inputs
    ('u',)
    """

    name: str
    parameters: tuple[Parameter, ...]
    matrices: Callable[[Values], Mapping[str, Any]]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    intersample: Hold = "zoh"

    @checks_arguments
    def __init__(
        self,
        name: str,
        parameters: Sequence[Parameter],
        matrices: Callable[[Values], Mapping[str, Any]],
        inputs: str | Sequence[str] = "u",
        outputs: str | Sequence[str] = "y",
        intersample: Hold | tuple[Hold, ...] = "zoh",
    ) -> None:
        names = {"inputs": as_names(inputs), "outputs": as_names(outputs)}
        set_fields(self, {**locals(), **names, "parameters": tuple(parameters)})
        if not self.outputs:
            raise UsageError(f"structure {name!r}: no outputs")


def as_names(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return one signal name or several as a tuple."""
    return (names,) if isinstance(names, str) else tuple(names)


@once
def symbolic_matrices(structure: Structure) -> tuple[ca.SX, Matrices]:
    """Return the matrices of a structure as functions of one symbolic vector of its parameters.

    Returns
    -------
    casadi.SX
        The parameters, (n_parameters, 1), in the order of the structure.
    Matrices
        Matrices of checked shape; B, D and K are zero when they were left out.

    Raises
    ------
    UsageError
        When the function of the structure fails or returns matrices of wrong shape.
    """
    p = ca.vertcat(*(ca.SX.sym(parameter.name) for parameter in structure.parameters))
    where = f"structure {structure.name!r}"
    try:
        given = dict(structure.matrices(Values.of(structure.parameters, p)))
        feedback: HeldFeedback | None = given.pop("feedback", None)
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(f"{where}: matrices(p) failed: {in_one_line(error)}; {_SYMBOLS}") from error
    missing = [letter for letter in "AC" if letter not in given]
    unknown = [letter for letter in given if letter not in Matrices._fields]
    if missing or unknown or ("delay" in given) != ("B_delayed" in given):
        raise UsageError(
            f"{where}: matrices(p) must give A and C, and may give B, D, K, x0, and B_delayed with delay; "
            f"got {', '.join(given) or 'nothing'}"
        )
    sx = {letter: _as_matrix(value, letter, where) for letter, value in given.items()}
    n, n_y = sx["A"].shape[0], sx["C"].shape[0]
    n_u = next((sx[letter].shape[1] for letter in ("B", "D", "B_delayed") if letter in sx), 0)
    expected = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u), "K": (n, n_y), "B_delayed": (n, n_u)}
    expected["delay"] = (n_u if "delay" in sx else 0, 1)
    expected["x0"] = (n + (feedback.n_states if feedback else 0) if "x0" in sx else 0, 1)
    sx = {letter: sx.get(letter, ca.SX(*shape)) for letter, shape in expected.items()}
    for letter, shape in expected.items():
        if sx[letter].shape != shape:
            raise UsageError(f"{where}: {letter} has shape {sx[letter].shape}, expected {shape}")
    if foreign := ca.Function("m", [p], list(sx.values()), {"allow_free": True}).free_sx():
        letter = next(each for each in expected if ca.depends_on(sx[each], ca.vertcat(*foreign)))
        names = ", ".join(symbol.name() for symbol in foreign if ca.depends_on(sx[letter], symbol))
        raise UsageError(f"{where}: {letter} contains symbols that are not parameters: {names}")
    return p, Matrices(**sx, feedback=feedback)


def evaluate(
    structure: Structure,
    values: Mapping[str, float],
    input_names: tuple[str, ...] = (),
    output_names: tuple[str, ...] = (),
) -> LinearModel:
    """Return the numeric model of a structure for given parameter values.

    Parameters
    ----------
    structure : Structure
        The structure.
    values : dict of str to float
        A value for every parameter.
    input_names, output_names : tuple of str, optional
        Names of the channels.

    Returns
    -------
    LinearModel
        In continuous time.

    Raises
    ------
    UsageError
        When a value is missing or the matrices are not finite.
    """
    return model_function(structure)(values, input_names, output_names)


@once
def model_function(structure: Structure) -> Callable[..., LinearModel]:
    """Return a function from parameter values to the numeric model; the symbolic matrices are computed once."""
    p, symbolic = symbolic_matrices(structure)
    feedback = symbolic.feedback
    law = tuple(feedback.law) if feedback else ()
    function = ca.Function("matrices", [p], [ca.densify(m) for m in (*symbolic[:7], *law)])

    def model(values: Mapping[str, float], inputs: tuple[str, ...], outputs: tuple[str, ...]) -> LinearModel:
        numeric = function(ca.DM(as_vector(structure, values)))
        A, B, C, D, K, B_delayed, delay, *control_law = (np.array(m, dtype=float).reshape(m.shape) for m in numeric)
        if feedback:
            A, B, C, D, K = _in_samples(feedback, LoopParts(A, B, C, D, K), ControlLaw(*control_law))
        return LinearModel(
            A,
            B,
            C,
            D,
            K if K.any() else None,
            dt=feedback.sample_time if feedback else None,
            B_delayed=B_delayed if symbolic.has_delay else None,
            delay=delay[:, 0] if symbolic.has_delay else None,
            input_names=inputs,
            output_names=outputs,
            name=structure.name,
        )

    return model


def _in_samples(feedback: HeldFeedback, plant: LoopParts, law: ControlLaw) -> LoopParts:
    """Return the discrete-time loop of a continuous plant and a sampled controller."""
    n_w, n_r = plant.B.shape[1], law.drive.shape[1]
    held = discretise(plant.A, np.hstack([plant.B, law.drive, plant.K]), feedback.sample_time)
    B, drive, K = np.split(held.G_now, [n_w, n_w + n_r], axis=1)
    return feedback.close(plant._replace(A=held.F, B=B, K=K), law._replace(drive=drive), plant.A, n_w)


def in_one_line(error: BaseException) -> str:
    """Return type and text of an exception in a user's code, on one line; of several lines the last."""
    lines = str(error).split("\n")
    return f"{type(error).__name__}: {lines[-1].strip()}"


def _as_matrix(value: Any, letter: str, where: str) -> ca.SX:
    """Return lists, arrays, numbers or CasADi matrices as SX; a flat list is a row for C, else a column."""
    try:
        if isinstance(value, ca.SX | ca.DM):
            matrix = ca.SX(value)
        else:
            if isinstance(value, np.ndarray) and not value.size:
                return ca.SX(*np.atleast_2d(value).shape)
            given = value.tolist() if isinstance(value, np.ndarray) else value
            rows = list(given) if isinstance(given, list | tuple) else [given]
            if rows and not any(isinstance(row, list | tuple) for row in rows):
                rows = [rows] if letter == "C" else [[entry] for entry in rows]
            if rows and not any(rows):  # no columns, as B of a structure without inputs
                return ca.SX(len(rows), 0)
            matrix = ca.SX(ca.vertcat(*(ca.horzcat(*(ca.SX(entry) for entry in row)) for row in rows)))
    except Exception as error:
        raise UsageError(f"{where}: {letter} is not a matrix: {in_one_line(error)}") from None
    if _contains_nan(matrix):
        entries = [(row, column) for row in range(matrix.shape[0]) for column in range(matrix.shape[1])]
        row, column = next(entry for entry in entries if _contains_nan(matrix[entry]))
        raise UsageError(f"{where}: {letter}[{row}, {column}] is nan: a parameter lost its symbol; {_SYMBOLS}")
    return matrix


def _contains_nan(matrix: ca.SX) -> bool:
    """Return whether an expression contains the constant nan, as ``float(symbol)`` is."""
    f = ca.Function("entries", ca.symvar(matrix), [matrix])
    constants = (f.instruction_constant(i) for i in range(f.n_instructions()) if f.instruction_id(i) == ca.OP_CONST)
    return any(isnan(value) for value in constants)
