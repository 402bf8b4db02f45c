"""The nonlinear programme of a fit as functions of CasADi."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Unpack

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.identify.nlp.functions.casadi_callback import Trouble
from gbid.identify.nlp.functions.nlp_functions import NlpFunctions, nlp_functions
from gbid.identify.nlp.hessian import GaussNewton
from gbid.identify.problem.assembly import automatic_window
from gbid.identify.problem.request import Posed, RequestOptions, request
from gbid.recording import Recording
from gbid.structure import AnyStructure, NonlinearStructure
from gbid.threads import one_blas_thread


@dataclass(frozen=True, eq=False)
class FitProblem(Brief):
    """Nonlinear programme of a fit: multiple shooting in scaled unknowns.

    The unknowns are the free parameters and the states at the starts of the shooting windows. Times `scale` they are in
    their own units. The cost is half the logarithm of the criterion. The constraints are the gaps between windows, and
    the constraints of the caller.

    Attributes
    ----------
    names : tuple of str
        Names of the unknowns; ``"run 1[3].x2"`` is the second state at the start of the fourth window of a recording.
    start, lower, upper : (n,) array
        Start and bounds of the unknowns, scaled.
    scale : (n,) array
        Scales of the unknowns.
    n_gaps : int
        Number of the constraints that are gaps; they are the first.
    functions : NlpFunctions
        Functions of CasADi as ``casadi.nlpsol`` takes them, with the bounds of the constraints.
    """

    names: tuple[str, ...]
    start: FloatArray
    lower: FloatArray
    upper: FloatArray
    scale: FloatArray
    n_gaps: int
    functions: NlpFunctions
    _posed: Posed = field(repr=False)

    def _brief(self) -> Description:
        about = f"{len(self.names)} unknowns, {len(self.functions.lower)} constraints, {self.n_gaps} of them gaps"
        return brief(self, about, parameters=[q.name for q in self._posed.assembly.free])

    def cost(self, x: Any) -> Any:
        """Return the cost.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.value(x)[0]

    def constraints(self, x: Any) -> Any:
        """Return the constraints: gaps, then those of the caller.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.value(x)[1]

    def gradient(self, x: Any) -> Any:
        """Return the gradient of the cost.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.gradient(x, [])[1]

    def jacobian(self, x: Any) -> Any:
        """Return the Jacobian of the constraints, sparse.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.jacobian(x, [])[1]

    def hessian(self, x: Any, multipliers: Any = 0) -> Any:
        """Return the Hessian of the Lagrangian, sparse and symmetric.

        That of the squared errors is the one of Gauss and Newton, without second derivatives of the predictions. That
        of an extra cost and, times the `multipliers` of the constraints, of constraints of the caller is exact.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        multipliers : (m,) array or casadi.MX
            Multipliers of the constraints; zero by default.
        """
        return ca.triu2symm(self.functions.hessian(x, [], 1, multipliers))

    @property
    def sparsity(self) -> dict[Literal["jacobian", "hessian"], ca.Sparsity]:
        """Sparsity of the Jacobian of the constraints, and of the upper triangle of the Hessian."""
        return {"jacobian": self.functions.jacobian.sparsity_out(1), "hessian": self.functions.hessian.sparsity_out(0)}

    @property
    def nlp(self) -> dict[str, ca.MX]:
        """The programme for ``casadi.nlpsol(name, plugin, nlp, {**functions.derivatives, ...})``."""
        x = ca.MX.sym("x", len(self.names))
        f, g = self.functions.value(x)
        return {"x": x, "f": f, "g": g}

    def parameters(self, x: Any) -> dict[str, float]:
        """Return the parameters by name, in their own units.

        Parameters
        ----------
        x : (n,) array
            Scaled unknowns.
        """
        own = np.asarray(x, float).ravel() * self.scale
        return {q.name: float(v) for q, v in zip(self._posed.assembly.free, own, strict=False)}


def fit_problem(
    structure: AnyStructure,
    recordings: Recording | Sequence[Recording],
    *,
    window: int | Literal["auto"] | None = "auto",
    **options: Unpack[RequestOptions],
) -> FitProblem:
    """Return the nonlinear programme that `gbid.fit` would solve, as functions of CasADi.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        The structure.
    recordings : Recording or sequence of Recording
        The recordings.
    window : int, None or "auto"
        Number of samples in a shooting window, as for `gbid.fit`.
    **options
        Options of `gbid.fit` that settle the problem: inputs, outputs, focus, intersample, criterion, horizon,
        output_weights, start, fixed, bounds, prior, extra_cost, constraints, local, offsets, trend, hum, initial_state,
        left_out, scaling, engine.

    Returns
    -------
    FitProblem
        The problem at the start values.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    asked = request(structure, recordings, options)
    samples = automatic_window(asked.data, asked.focus) if window == "auto" else window
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        posed = asked.posed(asked.first.values, samples)
    problem = posed.problem
    states = asked.structure.states if isinstance(asked.structure, NonlinearStructure) else ()
    starts = _names_of_starts(posed, [record.name for record in asked.data.records], states)
    return FitProblem(
        (*(q.name for q in posed.assembly.free), *starts),
        np.clip(posed.unknowns, posed.lower, posed.upper),
        posed.lower,
        posed.upper,
        problem.pack(np.ones(problem.n_theta), np.ones((problem.n_windows, problem.n_states))) ** -1,
        problem.n_gaps,
        nlp_functions(problem, GaussNewton(problem), Trouble()),
        posed,
    )


def _names_of_starts(posed: Posed, records: Sequence[str], states: Sequence[str]) -> list[str]:
    """Return the names of the states at the starts of all windows, in the order of the windows."""
    problem = posed.problem
    following = {int(a): int(b) for a, b in problem.links}
    named: dict[int, str] = {}
    for name, window in zip(records, posed.assembly.record_window, strict=True):
        at, count = int(window), 0
        named[at] = f"{name}[0]"
        while at in following:
            at, count = following[at], count + 1
            named[at] = f"{name}[{count}]"
    own = [*states, *(f"x{i + 1}" for i in range(len(states), problem.n_states))]
    return [f"{named[i]}.{state}" for i in range(problem.n_windows) for state in own]
