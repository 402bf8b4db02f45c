"""The one-step-ahead predictor of a linear structure, discretised, with its parameter derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.discretise import check_holds, discretise, squarings_for
from gbid.errors import UsageError
from gbid.structure import Parameter, Structure, symbolic_matrices

FloatArray = npt.NDArray[np.float64]
Focus = Literal["prediction", "simulation"]


class PredictorValues(NamedTuple):
    """Numbers of the recursion at one parameter vector.

    ``x[k+1] = F x[k] + G z[k]``, ``yhat[k] = C x[k] + H z[k]`` with the regressors
    ``z[k] = [u[k], u[k+1] of first-order-hold inputs, y[k] when the disturbance gain is in use]``, and the
    derivatives with respect to the free parameters.

    Attributes
    ----------
    F : (n, n)
    G : (n, n_z)
    C : (n_y, n)
    H : (n_y, n_z)
    dF : (n_p, n, n)
    dG : (n_p, n, n_z)
    dC : (n_p, n_y, n)
    dH : (n_p, n_y, n_z)
    """

    F: FloatArray
    G: FloatArray
    C: FloatArray
    H: FloatArray
    dF: FloatArray
    dG: FloatArray
    dC: FloatArray
    dH: FloatArray


@dataclass(frozen=True, eq=False)
class Predictor:
    """A structure made ready for one set of free parameters, sample time, hold and focus.

    Attributes
    ----------
    free : tuple of Parameter
        The parameters to be estimated, in order.
    unused : tuple of str
        Parameters that this focus does not see (the disturbance gain in simulation focus).
    n_states, n_inputs, n_outputs, n_z : int
        Sizes of state, input, output and regressor.
    lead : tuple of int
        Inputs whose next sample is a regressor too.
    feeds_back : bool
        Whether measured outputs are regressors.
    squarings : int
        Doublings in the matrix exponential.
    """

    free: tuple[Parameter, ...]
    unused: tuple[str, ...]
    n_states: int
    n_inputs: int
    n_outputs: int
    lead: tuple[int, ...]
    feeds_back: bool
    squarings: int
    _continuous: ca.Function
    _function: ca.Function
    _sample_time: float

    @property
    def n_z(self) -> int:
        """Number of regressors."""
        return self.n_inputs + len(self.lead) + (self.n_outputs if self.feeds_back else 0)

    def at(self, theta: FloatArray) -> PredictorValues:
        """Evaluate at values of the free parameters, shape (n_free,)."""
        n, n_y, n_z, n_p = self.n_states, self.n_outputs, self.n_z, len(self.free)
        raw = self._function(theta)
        values = [np.asarray(m, float) for m in raw]
        shapes = [(n, n), (n, n_z), (n_y, n), (n_y, n_z)]
        # CasADi stacks columns: a flat column-major matrix per parameter.
        derivatives = [
            d.reshape(-1, n_p).T.reshape(n_p, shape[1], shape[0]).transpose(0, 2, 1)
            for d, shape in zip(values[4:], shapes, strict=True)
        ]
        return PredictorValues(*(v.reshape(s) for v, s in zip(values[:4], shapes, strict=True)), *derivatives)

    def regressors(self, inputs: FloatArray, outputs: FloatArray) -> FloatArray:
        """Return ``z``, shape (n_samples, n_z), for one record.

        The sample after the last is not known; its place holds the last one, which enters no prediction.
        """
        parts = [inputs]
        if self.lead:
            following = np.vstack([inputs[1:], inputs[-1:]])
            parts.append(following[:, list(self.lead)])
        if self.feeds_back:
            parts.append(outputs)
        return np.hstack(parts)

    def enough_squarings(self, theta: FloatArray) -> bool:
        """Whether the matrix exponential was built with enough doublings for these parameter values."""
        A = np.asarray(self._continuous(theta), float)
        return bool(squarings_for([A * self._sample_time]) <= self.squarings)


def build_predictor(
    structure: Structure,
    fixed: Mapping[str, float],
    sample_time: float,
    intersample: str | Sequence[str],
    focus: Focus,
    samples: Sequence[Mapping[str, float]],
) -> Predictor:
    """Build the predictor symbolically.

    Parameters
    ----------
    structure : Structure
    fixed : dict of str to float
        Parameters that keep a value.
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or sequence of these
        Behaviour of the inputs between samples.
    focus : {"prediction", "simulation"}
        Whether the disturbance gain feeds measured outputs back (Eqs. 10, 15) or the model runs on its own.
    samples : sequence of dict
        Parameter values at which the matrix exponential must be exact (the start, corners of the bounds).

    Returns
    -------
    Predictor

    Raises
    ------
    UsageError
        When nothing is left to estimate.

    Notes
    -----
    The continuous model with input u and disturbance e is discretised exactly, u held as asked and e held
    between samples; with ``e[k] = y[k] - C x[k] - D u[k]`` the predictor is
    ``x[k+1] = (Ad - Kd C) x[k] + (Bd - Kd D) u[k] + Kd y[k]``.
    """
    p, m = symbolic_matrices(structure)
    holds = check_holds(intersample, m.B.shape[1])
    n, n_u, n_y = m.A.shape[0], m.B.shape[1], m.C.shape[0]
    K = m.K if focus == "prediction" else ca.SX(n, n_y)
    feeds_back = K.nnz() > 0
    seen = {symbol.name() for symbol in ca.symvar(ca.veccat(m.A, m.B, m.C, m.D, K))}
    unused = tuple(q.name for q in structure.parameters if q.name not in seen and q.name not in fixed)
    free = tuple(q for q in structure.parameters if q.name not in fixed and q.name in seen)
    if not free:
        raise UsageError(f"structure {structure.name!r}: no free parameter to estimate")

    held = {**{name: 0.0 for name in unused}, **fixed}
    theta = ca.vertcat(*(p[i] for i, q in enumerate(structure.parameters) if q in free))
    constants = [(p[i], held[q.name]) for i, q in enumerate(structure.parameters) if q not in free]
    matrices: list[Any] = [m.A, m.B, m.C, m.D, K]
    if constants:
        symbols, numbers = zip(*constants, strict=True)
        matrices = ca.substitute(matrices, [ca.vertcat(*symbols)], [ca.vertcat(*numbers)])
        matrices = [ca.sparsify(matrix) for matrix in matrices]
    A, B, C, D, K = matrices

    continuous = ca.Function("A", [theta], [ca.densify(A)])
    vectors = [np.array([float(sample[q.name]) for q in free]) for sample in samples]
    squarings = squarings_for([np.asarray(continuous(v), float) * sample_time for v in vectors])

    joined = ca.horzcat(B, K) if feeds_back else B
    all_holds = (*holds, *("zoh",) * n_y) if feeds_back else holds
    discrete = discretise(A, joined, sample_time, all_holds, squarings)
    lead = tuple(i for i, hold in enumerate(holds) if hold == "foh")
    now, Kd = discrete.G_now[:, :n_u], discrete.G_now[:, n_u:]
    F = discrete.F - Kd @ C if feeds_back else discrete.F
    parts = [now - Kd @ D if feeds_back else now]
    if lead:
        parts.append(discrete.G_next[:, list(lead)])
    if feeds_back:
        parts.append(Kd)
    G = ca.horzcat(*parts)
    H = ca.horzcat(D, ca.SX(n_y, G.shape[1] - n_u))
    outputs = [F, G, C, H]
    jacobians = [ca.jacobian(ca.vec(ca.densify(matrix)), theta) for matrix in outputs]
    function = ca.Function("predictor", [theta], [ca.densify(e) for e in (*outputs, *jacobians)], {"cse": True})
    return Predictor(free, unused, n, n_u, n_y, lead, feeds_back, squarings, continuous, function, sample_time)
