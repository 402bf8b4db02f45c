"""Fit of a structure to recordings: the public functions `fit`, `profile` and `fit_problem`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray, keep_freed_memory, one_blas_thread
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import GbidError, UsageError
from gbid.core.notes import FitNote
from gbid.core.option_types import takes_options
from gbid.identify.data import column_means, column_variances
from gbid.identify.frequency_fit import USED
from gbid.identify.options import FitArguments
from gbid.identify.pose import FitTask, Measured, PosedProblem, Recordings, apart, pose
from gbid.identify.problem.hessian import gauss_newton
from gbid.identify.problem.solve import NlpFunctions, Trouble, nlp_functions
from gbid.identify.restarts import best_attempt, windows_of
from gbid.identify.result import FitResult, Profile
from gbid.identify.uncertainty.residual_tests import COLOURED
from gbid.structure.kinds import AnyStructure, kind_of
from gbid.structure.parameter import asked_once


def fitted(structure: AnyStructure, recordings: Measured, options: FitArguments) -> FitResult:
    """Return the fit of a structure to recordings; see `fit`."""
    began = time.perf_counter()
    keep_freed_memory()
    with asked_once():
        task = pose(structure, recordings, options)
        # Matrices are small: several BLAS threads would be slower. An unstable start overflows; the status reports it.
        with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            result = best_attempt(task)
            notes = _dependence_notes(task, result)
            if not notes and any(each.name not in task.data.output_names for each in task.dependent):
                task = pose(structure, recordings, options, all_outputs=True)
                result = best_attempt(task)
    result = with_profiles(result.noted(*notes), options.profile)
    if _means_may_matter(task, result):
        result = result.noted(*_note_of_means(structure, recordings, options, result))
    return result.changed(wall_time_s=time.perf_counter() - began)


@takes_options(FitArguments)
def fit(structure: AnyStructure, recordings: Measured, options: FitArguments) -> FitResult:
    """Return the fit of a structure to recordings: prediction errors (paper, Eq. 15), multiple shooting.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        `RotorBearing`, `PiezoPair`, `Plant`, or a user's `LinearStructure` or `NonlinearStructure`; what
        `scheduled` makes of linear ones, for recordings in which scheduling variables change.
    recordings : Recording, FrequencyData or sequence of these
        Recordings to fit. They share all parameters except those in `local`; each has its own initial state.
        Frequency responses are weighted by their standard deviations, alone or in one criterion with recordings.
    **options

    Returns
    -------
    FitResult
        The result, also when the solver did not converge; see `status` and `success`.

    Raises
    ------
    UsageError
        When a name or option is unknown, bounds exclude a start value, or the matrices of the structure have wrong
        shapes.
    DataError
        When the recordings are not sufficient for the fit, or do not determine a parameter because no input moves.
    KeyboardInterrupt
        After Ctrl-C.
    """
    return fitted(structure, recordings, options)


_OF_ERROR = 1e-3  # what a combination leaves of an output, as a part of its error, below which none is measured apart
_NAMED = 4  # outputs of a combination that a note names
_NO_ERROR = 1e-6  # of the size of an output: errors of simulated data without noise


def _dependence_notes(task: FitTask, result: FitResult) -> tuple[str, ...]:
    """Return a note on each dependent output; none if any of their errors is independent."""
    notes = []
    for each in task.dependent:
        weights = np.array([each.weights.get(name, 0.0) for name in task.data.output_names])
        error = float(np.sqrt(weights @ result.error_covariance @ weights))
        if not max(each.left / _OF_ERROR, each.size * _NO_ERROR) < error:
            return ()
        largest = sorted(each.weights, key=lambda name: -abs(each.weights[name]))[:_NAMED]
        parts = [name for name in largest if abs(each.weights[name]) > _OF_ERROR * abs(each.weights[largest[0]])]
        of = " + ".join(f"{each.weights[name]:.4g} {name}" for name in parts)
        what = "contains no new information, and the fit leaves it out"
        if each.name in task.data.output_names:
            what = "has no prediction errors to weight it by; remove it from the structure, or fix its own parameters"
        text = (
            f"output {each.name!r} is a combination of others ({of}) to {each.left / error:.1g} of its error: it {what}"
        )
        notes.append(FitNote.DEPENDENT(text))
    return tuple(notes)


# ---- Profile likelihood of the estimates.


def profile(
    result: FitResult,
    names: Sequence[str] | None = None,
    *,
    level: float = 0.95,
    structure: AnyStructure | None = None,
    recordings: Measured | None = None,
) -> dict[str, Profile]:
    """Return profile likelihoods of estimated parameters: the range of values that the data support.

    A standard deviation is the curvature of the likelihood at the estimate. It is wrong where the likelihood is no
    parabola: short recordings, a delay near zero, a parameter near a bound, two modes that nearly meet. A profile is
    the likelihood itself. The parameter is fixed at values that go outwards from the estimate, and all other unknowns
    are estimated anew, until the likelihood ratio is above the quantile of the chi-square distribution.

    Parameters
    ----------
    result : FitResult
        Result of a fit that converged.
    names : sequence of str, optional
        Full names of the parameters; by default all that were estimated.
    level : float
        Probability of the intervals.
    structure : Structure or NonlinearStructure, optional
        For a result from a file: the structure of its fit.
    recordings : Recording, FrequencyData or sequence of these, optional
        For a result from a file: the data of its fit. It is fitted again, from its estimates.

    Returns
    -------
    dict of str to Profile
        Curve, interval and verdict of each parameter. `gbid.report.plot_profile` draws them.

    Raises
    ------
    UsageError
        When a parameter was not estimated, the fit did not converge, or it was made from other recordings, by another
        structure, or with functions that are not stored (`extra_cost`, `constraints`).

    Notes
    -----
    The interval contains the values with ``2 (l(estimate) - l(value)) / c <= q`` with the log-likelihood l of normal
    white errors, maximised over all other unknowns and the variance of the errors, and the quantile q (Pawitan, In All
    Likelihood, 2001, Sec. 3.4; Raue et al., Bioinformatics 25, 2009, for the verdict). For coloured errors l is no
    likelihood, and twice the difference is not chi-square distributed. The factor ``c = V / (H^-1)`` makes it so for
    one parameter (Kent, Biometrika 69, 1982; Chandler and Bate, Biometrika 94, 2007): V is its variance in the
    covariance that the fit trusts, the robust one for coloured errors, and ``H^-1`` the one that the curvature of l
    gives alone. So the interval of a parabola is that of the standard deviation. For white errors c contains only the
    degrees of freedom. A robust loss keeps the weights of the samples.
    """
    if (structure is None) != (recordings is None):
        raise UsageError("give both structure and recordings, or none of them")
    if structure is not None and recordings is not None:
        result = _fitted_again(result, structure, recordings)
    return {name: result.profile(name, level) for name in (result.free if names is None else names)}


def with_profiles(result: FitResult, wanted: Sequence[str]) -> FitResult:
    """Return a result with the profile likelihoods that its options request; none if the fit did not converge."""
    if not (wanted and result.may_be_profiled):
        return result
    names = [q for q in result.free if wanted == "all" or {q, result.own_names.get(q)} & set(wanted)]
    return result.changed(profiles=profile(result, names))


_SAME_LIKELIHOOD = 0.1  # difference of log-likelihoods: far below what moves the end of an interval


def _fitted_again(result: FitResult, structure: AnyStructure, recordings: Measured) -> FitResult:
    """Return the fit of a stored result, repeated from its estimates."""
    stated, own_names = {q.name for q in structure.parameters}, result.own_names
    start = {own_names.get(q, q): result.parameters[q] for q in result.free if own_names.get(q, q) in stated}
    in_time, responses = apart(recordings)
    known = [field.name for field in fields(result.options) if in_time or field.name in USED]
    settled = {name: getattr(result.options, name) for name in known}
    if any(FitNote.DEPENDENT.value in note for note in result.notes):
        settled["outputs"] = None
    again = fitted(structure, recordings, FitArguments(**{**settled, "start": start, "profile": ()}))
    n_samples = sum(rec.n_samples for rec in in_time) + sum(2 * each.response.size for each in responses)
    if again.free != result.free or not abs(np.log(again.loss / result.loss)) * n_samples < _SAME_LIKELIHOOD:
        raise UsageError(
            f"fitted again from its estimates, {', '.join(result.recordings)} have the loss {again.loss:.6g}, and the "
            f"result {result.loss:.6g}: give the recordings and the structure of the fit; extra_cost and constraints "
            "are not stored: for such a fit use the result before it was stored"
        )
    return again


_OF_MOTION = 0.05  # of the standard deviation of an output, below which its mean is no suspect
_CERTAIN = 4.0  # standard deviations of an offset, beyond chance for a few outputs and recordings
_MOVED = 0.5  # standard deviations by which an estimate moves, from which its interval is a different one


def _means_may_matter(task: FitTask, result: FitResult) -> bool:
    """Return whether a linear structure has coloured residuals, and an output has a mean.

    The mean is what the static gain of the model leaves of it; of an integrator it is the whole.
    """
    if task.options.trend != "none" or kind_of(task.structure).linear is None:
        return False
    if (result.whiteness >= COLOURED / len(result.whiteness)).all():  # what a mean leaves is not white
        return False
    try:
        gain = result.linear_model.static_gain()
    except UsageError:
        gain = np.zeros((len(task.data.output_names), len(task.data.input_names)))
    for r in task.data.records:
        unexplained = np.abs(column_means(r.outputs) - gain @ column_means(r.inputs))
        if (unexplained > _OF_MOTION * np.sqrt(column_variances(r.outputs))).any():
            return True
    return False


def _note_of_means(
    structure: AnyStructure, recordings: Measured, options: FitArguments, result: FitResult
) -> tuple[str, ...]:
    """Return a note if a second fit with output offsets finds significant offsets that shift the estimates."""
    plain = replace(options, profile=(), progress=None)
    try:
        other = fitted(structure, recordings, replace(plain, trend="offset"))
    except GbidError:  # the structure may be too large for the recordings with offsets
        return ()
    offsets = [name for name in other.free if name not in result.free and name.startswith("offset_")]
    certain = [name for name in offsets if abs(other.parameters[name]) > _CERTAIN * other.std[name]]
    both = [name for name in result.free if other.std.get(name, np.nan) > 0]
    by = {name: abs(result.parameters[name] - other.parameters[name]) / other.std[name] for name in both}
    if not (other.success and other.loss < result.loss and certain and max(by.values(), default=0.0) > _MOVED):
        return ()
    most = max(by, key=lambda name: by[name])
    text = (
        f"outputs have means that the inputs do not explain ({', '.join(certain)}): with trend='offset' the loss is "
        f"{other.loss / result.loss:.2g} times this one, and {most} moves by {by[most]:.2g} standard deviations; "
        "estimate the means along (trend='offset'), or subtract them first (gbid.prefilter)"
    )
    return (FitNote.MEANS(text),)


# ---- Nonlinear programme of a fit as CasADi functions.


@dataclass(frozen=True, eq=False)
class FitProblem(Brief):
    """Nonlinear programme (NLP) of a fit: multiple shooting in scaled unknowns.

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
    _problem: PosedProblem = field(repr=False)

    def _brief(self) -> Description:
        about = f"{len(self.names)} unknowns, {len(self.functions.lower)} constraints, {self.n_gaps} of them gaps"
        return brief(self, about, parameters=[q.name for q in self._problem.assembly.free])

    def cost(self, x: Any) -> Any:
        """Return the cost.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.value(x)[0]

    def constraints(self, x: Any) -> Any:
        """Return the constraints: gaps between windows, then constraints of the caller.

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
        """NLP for ``casadi.nlpsol(name, plugin, nlp, {**functions.derivatives, ...})``."""
        x = ca.MX.sym("x", len(self.names))
        f, g = self.functions.value(x)
        return {"x": x, "f": f, "g": g}

    def parameters(self, x: Any) -> dict[str, float]:
        """Return the parameters by name, in physical units.

        Parameters
        ----------
        x : (n,) array
            Scaled unknowns.
        """
        values = (np.asarray(x, float).ravel() * self.scale).tolist()
        return {q.name: v for q, v in zip(self._problem.assembly.free, values, strict=False)}


@takes_options(FitArguments)
def fit_problem(structure: AnyStructure, recordings: Recordings, options: FitArguments) -> FitProblem:
    """Return the nonlinear programme that `gbid.fit` would solve, as CasADi functions.

    Options of the solver and of the standard deviations have no effect.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        The structure.
    recordings : Recording or sequence of Recording
        The recordings.
    **options

    Returns
    -------
    FitProblem
        The problem at the start values.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    task = pose(structure, recordings, options)
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        problem = task.problem(task.begin.values, windows_of(task)[0])
    shooting = problem.shooting
    return FitProblem(
        (*(q.name for q in problem.assembly.free), *_names_of_starts(problem)),
        np.clip(problem.unknowns, *shooting.box),
        *shooting.box,
        shooting.pack(np.ones(shooting.n_theta), np.ones((shooting.n_windows, shooting.n_states))) ** -1,
        shooting.n_gaps,
        nlp_functions(shooting, gauss_newton(shooting), Trouble()),
        problem,
    )


def _names_of_starts(problem: PosedProblem) -> list[str]:
    """Return names of the start states of all windows, in the order of the windows."""
    shooting, task, named = problem.shooting, problem.task, dict[int, str]()
    for record, first in zip(task.data.records, problem.assembly.record_window, strict=True):
        named |= {window: f"{record.name}[{i}]" for i, window in enumerate(shooting.windows_from(first))}
    names = kind_of(task.structure).state_names
    states = [*names, *(f"x{i + 1}" for i in range(len(names), shooting.n_states))]
    return [f"{named[i]}.{state}" for i in range(shooting.n_windows) for state in states]
