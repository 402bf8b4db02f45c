"""Fit of a structure to frequency responses alone: nonlinear least squares in standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from gbid.core.arrays import BoolArray, ComplexArray, FloatArray
from gbid.core.errors import UsageError
from gbid.core.notes import FitNote
from gbid.discretise.dual import Dual
from gbid.identify.data import FitData, Record
from gbid.identify.disturbances import UNDISTURBED
from gbid.identify.frequency_data import FrequencyData, ResponseErrors, ResponseSums, check_linear
from gbid.identify.judge import not_determined
from gbid.identify.options import FitArguments
from gbid.identify.predictor import build_predictor, matrices_with_slopes
from gbid.identify.problem.solve import TOLERANCES, Progress
from gbid.identify.result import FitResult, FitStatus, StdKind
from gbid.identify.start.black_box import Target
from gbid.identify.start.start import Begin, begin_values, has_no_starts, matched
from gbid.identify.uncertainty.covariance import UNDETERMINED, Covariance, spreads_of
from gbid.identify.uncertainty.profiles import ConstrainedFit, Walker
from gbid.identify.uncertainty.uncertain_model import ModelSlopes
from gbid.structure import AnyStructure, Parameter, Structure, as_names, kind_of, symbolic_matrices

_ACCURACY = 1e-3  # smallest relative standard deviation that a match of start values believes
_FAR = 0.3  # part of a response that counts as its error at first: far from a resonance its slopes lead nowhere
_UNLIKELY = 0.01  # probability of larger errors, for all outputs, below which the stated ones are too small
_FOLLOWS = 4.0  # standard deviations of the correlation of neighbouring errors, beyond chance
_SAMPLES = (2_000, 20_000)  # of the motion for start values
USED = ("inputs", "outputs", "start", "fixed", "bounds", "prior", "max_iterations", "progress", "profile")
"""Options of `gbid.fit` that have a meaning for frequency responses alone."""


def fitted_to_responses(
    stated: AnyStructure,
    parameters: tuple[Parameter, ...],
    responses: Sequence[FrequencyData],
    options: FitArguments,
) -> FitResult:
    """Return the fit of a structure to frequency responses.

    Parameters
    ----------
    stated : Structure
        Linear structure with constant parameters.
    parameters : tuple of Parameter
        Its parameters with the starts, fixed values and bounds of the caller.
    responses : sequence of FrequencyData
        The responses.
    options : FitArguments
        Options; those of samples have no meaning here and are refused.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.

    Notes
    -----
    The criterion is ``sum |G(f) - G_measured(f)|^2 / std^2`` over real and imaginary parts (Pintelon and Schoukens,
    System Identification, 2012, Sec. 9.11): with the stated errors it is the likelihood. Delays are exact. The errors
    of neighbours that a spectral window correlates count as fewer.
    """
    structure = check_linear(stated)
    if symbolic_matrices(structure)[1].feedback is not None:
        raise UsageError(
            f"{structure.name} is a sampled loop; fit its plant to the responses of inputs and outputs to the reference"
            " (FrequencyData.channels(..., reference=), in the YAML responses: [{file: ..., reference: r}])"
        )
    refuse_other_options(options)
    inputs = structure.inputs if options.inputs is None else as_names(options.inputs)
    outputs = structure.outputs if options.outputs is None else as_names(options.outputs)
    data = [each.channels(inputs, outputs) for each in responses]
    begin = _begin(structure, parameters, data[0], options)
    fixed = {q.name: begin.values[q.name] for q in parameters if q.fixed}
    predictor = build_predictor(structure, fixed, 1.0, "zoh", "simulation")
    free, names = predictor.free, np.array([q.name for q in predictor.free])
    errors = [ResponseErrors(each, predictor, np.arange(len(free)), len(free)) for each in data]
    known = _prior_of(names, options.prior or {})
    box = np.array([next((q.lower, q.upper) for q in parameters if q.name == name) for name in names]).T
    start = np.array([begin.values[name] for name in names])
    problem = _LeastSquares(errors, known, box, options.max_iterations)
    solution, evaluations = _least(problem, start, options.progress)
    theta = np.asarray(solution.x, float)
    held = np.asarray(solution.active_mask != 0)
    at_end, sums = [each.at(theta) for each in errors], [each.sums(theta) for each in errors]
    offsets = theta - known[0], known[1]
    spread, rest = _spread(errors, at_end, sums, offsets, held)
    unbound = _spread(errors, at_end, sums, offsets, np.zeros_like(held))[0] if held.any() else spread
    left = [error for error, _ in at_end]
    p_values, follows = _tests(errors, left, int((~held).sum()))
    refused = bool((p_values < _UNLIKELY / len(p_values)).any())
    doubtful = refused or p_values.size > 1 or any(each.of_loop for each in data)
    kind: StdKind = "robust" if doubtful else "white"
    chosen = spread.of(kind)
    values = dict(zip(names.tolist(), theta.tolist(), strict=True))
    estimates = {q.name: values.get(q.name, fixed.get(q.name, 0.0)) for q in parameters}
    sigma = np.where(held | spread.open, np.nan, np.sqrt(np.diag(chosen)))
    (A, B, C, D, _, B_delayed, _), slopes, dt = matrices_with_slopes(predictor, theta)
    modes, gain = spreads_of((A, Dual(B.value + B_delayed.value, B.slope + B_delayed.slope), C, D), chosen, dt)
    model = kind_of(structure).model(estimates, data[0].input_names, data[0].output_names)
    costs = [each.cost for each in sums]
    count = sum(2 * int(each.measured.sum()) for each in errors)
    likelihood = -sum(costs) - sum(
        each.weight * float(np.log(2 * np.pi * each.data.std[each.measured] ** 2).sum()) for each in errors
    )
    trusted = np.where(unbound.open, np.nan, np.diag(unbound.of(kind)))
    loss = 2 * sum(costs) / count
    profiler = ResponseProfiler(
        tuple(names.tolist()),
        np.ones(len(names)),
        (box[0], box[1]),
        1.0,
        loss,
        problem,
        theta,
        np.sqrt(trusted),
        trusted / np.diag(unbound.white),
        count,
    )
    squares = sum(np.einsum("fyu,fzu->yz", e, e.conj()).real for e in left) / count
    status = FitStatus.CONVERGED
    if not np.isfinite(theta).all() or not np.isfinite(sum(costs)):
        status = FitStatus.OVERFLOW
    elif not rest < TOLERANCES.rest:
        status = FitStatus.ITERATION_LIMIT if solution.status == 0 else FitStatus.STALLED
    elif (~held & ~np.isfinite(sigma)).any():
        status = FitStatus.NOT_DETERMINED
    left_out = refused and follows
    std = dict(zip(names.tolist(), sigma.tolist(), strict=True)) | dict.fromkeys(fixed, 0.0)
    return FitResult(
        structure=structure.name,
        recordings=tuple(each.name for each in data),
        parameters=estimates,
        std={name: std.get(name, np.nan) for name in estimates},
        units={q.name: q.unit for q in parameters},
        free=tuple(names.tolist()),
        covariance=chosen,
        covariance_white=spread.white,
        covariance_robust=spread.robust,
        trusted="none" if left_out else kind,
        whiteness=p_values,
        modes_std=modes,
        static_gain_std=gain,
        initial_states=np.zeros((len(data), model.n_states)),
        loss=loss,
        error_covariance=squares,
        fit_percent=np.array([_fit_percent(each, error) for each, error in zip(errors, left, strict=True)]),
        aic=2 * len(theta) - 2 * likelihood,
        fpe=np.nan,
        log_likelihood=likelihood,
        condition=spread.condition,
        status=status,
        optimality=rest,
        iterations=evaluations,
        wall_time_s=0.0,
        start={name: begin.values[name] for name in estimates},
        start_origin={name: begin.origin[name] for name in estimates},
        notes=(
            *(FitNote.ON_BOUND(f"{name} lies on a bound: no standard deviation") for name in names[held]),
            *not_determined(spread.undetermined, names),
            *_notes(refused, follows, p_values),
            *(
                [FitNote.NOT_USED(f"responses do not use, set to 0: {', '.join(predictor.unused)}")]
                if predictor.unused
                else ()
            ),
            *begin.notes,
        ),
        options=options.settled(
            inputs=tuple(inputs),
            outputs=tuple(outputs),
            intersample=("zoh",) * predictor.n_inputs,
            focus="simulation",
            criterion="trace",
            window=None,
            initial_state="zero",
        ),
        disturbances=UNDISTURBED,
        engine="numpy",
        schedule=None,
        model=model,
        sample_time=np.nan,
        model_slopes=ModelSlopes(*slopes),
        profiler=profiler,
    )


def refuse_other_options(options: FitArguments) -> None:
    """Refuse options that have no meaning for frequency responses; raises UsageError with the name of the option."""
    standard = FitArguments()
    for each in fields(FitArguments):
        given, default = getattr(options, each.name), getattr(standard, each.name)
        if each.name not in (*USED, "focus", "intersample") and given != default and (given or default):
            raise UsageError(
                f"{each.name} has no meaning in a fit to frequency responses alone; leave it out", each.name
            )


def _begin(
    structure: Structure, parameters: tuple[Parameter, ...], data: FrequencyData, options: FitArguments
) -> Begin:
    """Return the start values: those stated, others from the steady motion that the responses describe."""
    missing = [q.name for q in parameters if q.start is None]
    from_data = options.start == "data"
    given = {*({} if from_data else options.start or {}), *(options.fixed or {})}
    if not (missing or from_data):
        origin = {q.name: "user" if q.name in given else "structure" for q in parameters}
        return Begin({q.name: float(q.start or 0.0) for q in parameters}, origin, ())
    if has_no_starts(structure):
        return _matched(structure, parameters, data, given, from_data)
    return begin_values(structure, parameters, steady_motion(data), "zoh", given, from_data=from_data)


def _matched(
    structure: Structure, parameters: tuple[Parameter, ...], data: FrequencyData, given: set[str], from_data: bool
) -> Begin:
    """Return start values at which the structure has nearly the responses, from many random starts."""
    stated = {q.name: float(q.start) for q in parameters if q.start is not None and (q.fixed or not from_data)}
    fixed = {q.name: float(q.start or 0.0) for q in parameters if q.fixed}
    predictor = build_predictor(structure, fixed, 1.0, "zoh", "simulation")
    f, size = data.frequency_hz, np.abs(data.response)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.nan_to_num(1 / np.hypot(data.std, _ACCURACY * size), posinf=0.0)
    poles = np.full(predictor.n_states, -2 * np.pi * np.sqrt(f[0] * f[-1]), complex)
    s = np.asarray(2j * np.pi * f, complex)
    target = Target(s, np.nan_to_num(data.response), weight, poles, decays=False)
    values, _ = matched(structure, predictor, parameters, target, 0.5 / float(f[-1]))
    origin = {name: "user" if name in given else "structure" for name in stated}
    return Begin(values | stated, {q.name: origin.get(q.name, "data") for q in parameters}, ())


def steady_motion(data: FrequencyData) -> FitData:
    """Return samples of the steady motion that frequency responses describe: each input has lines of its own.

    Parameters
    ----------
    data : FrequencyData
        The responses.

    Returns
    -------
    FitData
        One record, without noise and without transient.
    """
    f, n_u = data.frequency_hz, len(data.input_names)
    h = 1 / (5 * float(f[-1]))
    n = int(np.clip(2 / (f[0] * h), *_SAMPLES))
    lines = np.exp(1j * (2 * np.pi * h * np.outer(np.arange(n), f) + np.pi * np.arange(len(f)) ** 2 / len(f)))
    of_input = np.arange(len(f))[:, None] % n_u == np.arange(n_u)
    response = np.nan_to_num(data.response)
    outputs = sum((lines[:, of_input[:, j]] @ response[of_input[:, j], :, j]).real for j in range(n_u))
    record = Record(data.name, (lines @ of_input).real, np.ascontiguousarray(outputs))
    return FitData((record,), h, data.input_names, data.output_names, ("",) * len(data.output_names))


def _prior_of(names: npt.NDArray[np.str_], prior: Mapping[str, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Return means and standard deviations of what is known of the parameters, infinite where nothing is."""
    for name, (_, std) in prior.items():
        if name not in names or not std > 0:
            raise UsageError(f"prior of {name}: it is not estimated, or its standard deviation is not positive")
    mean, std = np.array([prior.get(name, (0.0, np.inf)) for name in names], float).T
    return mean, std


@dataclass(frozen=True, eq=False)
class _LeastSquares:
    """Errors of responses, and of what was known of the parameters, both in standard deviations, as a problem."""

    errors: Sequence[ResponseErrors]
    known: tuple[FloatArray, FloatArray]  # means and standard deviations
    box: FloatArray
    max_iterations: int

    def at(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the errors and their slopes."""
        rows, slopes = zip(*(part.rows(theta) for part in self.errors), strict=True)
        mean, std = self.known
        return np.concatenate([*rows, (theta - mean) / std]), np.vstack([*slopes, np.diag(1 / std)])

    def solved(
        self,
        begin: FloatArray,
        report: Callable[[FloatArray, FloatArray, FloatArray], None] | None = None,
        held: int | None = None,
    ) -> Any:
        """Return the solution of scipy, with one parameter held if given; `report` is called with the slopes."""
        from scipy.optimize import least_squares  # half a second, which other fits do not need

        moves = np.arange(len(begin)) != (-1 if held is None else held)
        last: dict[bytes, tuple[FloatArray, FloatArray]] = {}

        def both(moved: FloatArray) -> tuple[FloatArray, FloatArray]:
            if moved.tobytes() not in last:
                theta = begin.copy()
                theta[moves] = moved
                last.clear()
                last[moved.tobytes()] = self.at(theta)
            return last[moved.tobytes()]

        def slopes_at(moved: FloatArray) -> FloatArray:
            if report is not None:
                report(moved, *both(moved))
            return both(moved)[1][:, moves]

        box = self.box[:, moves]
        return least_squares(
            lambda moved: both(moved)[0],
            np.clip(begin[moves], *box),
            slopes_at,
            tuple(box),
            x_scale="jac",
            ftol=1e-14,
            xtol=1e-12,
            gtol=1e-14,
            max_nfev=self.max_iterations,
        )


def _least(problem: _LeastSquares, start: FloatArray, progress: Callable[[Progress], None] | None) -> tuple[Any, int]:
    """Return the best of two solutions, from the start and from a fit with wider errors, and all iterations.

    `progress` is called where the slopes are computed: at the start of each search, and after each step of it.
    """
    passed: list[FloatArray] = []

    def report(theta: FloatArray, rows: FloatArray, slopes: FloatArray) -> None:
        if progress is not None:
            size = np.where(theta != 0, np.abs(theta), 1.0)
            step = np.abs((theta - passed[-1]) / size).max() if passed else np.inf
            onward = np.linalg.lstsq(slopes, rows, rcond=None)[0]
            sigma = float(np.linalg.norm(slopes @ onward))
            progress(Progress(len(passed), 0.5 * float(rows @ rows), 0.0, float(step), sigma))
            passed.append(theta.copy())

    wide = replace(problem, errors=[replace(each, relative=_FAR) for each in problem.errors])
    at_first = wide.solved(start, report)
    solutions = [problem.solved(begin, report) for begin in (start, at_first.x)]
    best = min(solutions, key=lambda solution: float(solution.cost))
    return best, int(at_first.nfev + sum(solution.nfev for solution in solutions))


@dataclass(frozen=True, eq=False)
class ResponseProfiler(Walker):
    """Likelihood around the estimates of a fit to frequency responses."""

    problem: _LeastSquares
    theta: FloatArray
    std: FloatArray  # that the fit trusts; of a parameter on a bound as if none were on one
    factor: FloatArray  # its square over the one that the curvature gives alone
    count: int  # of real and imaginary parts

    @cached_property
    def origin(self) -> ConstrainedFit:
        """The solution of the fit."""
        rows = self.problem.at(self.theta)[0]
        return ConstrainedFit(self.theta, None, 0.5 * float(rows @ rows))

    def losses(self, rises: FloatArray) -> FloatArray:
        """Return the losses: mean squares of the errors."""
        return self.loss + 2 * rises / self.count

    def spread(self, j: int) -> tuple[float, float]:
        """Return the standard deviation of a parameter, and by how much the ratio of its likelihoods is too large."""
        return float(self.std[j]), float(self.factor[j]) if np.isfinite(self.factor[j]) else 1.0

    def constrained(self, start: ConstrainedFit, j: int | None, change: float, _ridge: float = 0.0) -> ConstrainedFit:
        """Return the least squares with one parameter changed from that of `start`, and held."""
        theta = start.unknowns.copy()
        theta[j] += change
        if len(theta) > 1:
            solution = self.problem.solved(theta, held=j)
            theta[np.arange(len(theta)) != j] = solution.x
        rows = self.problem.at(theta)[0]
        return ConstrainedFit(theta, None, 0.5 * float(rows @ rows))


def _spread(
    errors: Sequence[ResponseErrors],
    at_end: Sequence[tuple[ComplexArray, ComplexArray]],
    sums: Sequence[ResponseSums],
    known: tuple[FloatArray, FloatArray],
    held: BoolArray,
) -> tuple[Covariance, float]:
    """Return the covariance of the parameters, and the length of the next step in standard deviations.

    `at_end` and `sums` are those of the errors at the estimates; `known` is how far these are from what was known, and
    its standard deviations. The robust one takes the products of the gradients of all frequencies: it contains what
    outputs have in common.
    """
    information = sum(s.hessian for s in sums) + np.diag(1 / known[1] ** 2)
    gradient = sum(s.gradient for s in sums) + known[0] / known[1] ** 2
    n_p, scale = len(held), np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scale[held] = np.inf
    eigenvalues, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    count = int(held.sum())
    eigenvalues, vectors = eigenvalues[count:], vectors[:, count:]
    undetermined = eigenvalues < UNDETERMINED * eigenvalues[-1]
    root = vectors[:, ~undetermined] / np.sqrt(eigenvalues[~undetermined]) / scale[:, None]
    products = np.diag(1 / known[1] ** 2)
    for each, (error, changes) in zip(errors, at_end, strict=True):
        each_frequency = each.weight * np.einsum("fyu,pfyu->fp", error.conj(), changes).real
        products = products + each_frequency.T @ each_frequency / each.weight
    white = root @ root.T
    spread = Covariance(
        white,
        white @ products @ white,
        np.nan,
        vectors[:, undetermined].T.reshape(-1, n_p),
        float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny)),
        curvature=white,
    )
    return spread, float(np.linalg.norm(root.T @ gradient))


def _tests(errors: Sequence[ResponseErrors], left: Sequence[ComplexArray], n_free: int) -> tuple[FloatArray, bool]:
    """Return for each output the probability of larger errors, and whether errors of neighbours follow each other."""
    n_y = len(errors[0].data.output_names)
    squares, freedom, products, chance = np.zeros(n_y), np.zeros(n_y), 0.0, 0.0
    for each, error in zip(errors, left, strict=True):
        spread = 1 + 2 * float(np.square(each.data.correlation).sum())
        squares += (np.abs(error) ** 2).sum(axis=(0, 2)) / spread
        freedom += 2 * each.measured.sum(axis=(0, 2)) / spread
        lag = len(each.data.correlation) + 1
        products += float((error[lag:] * error[:-lag].conj()).real.sum())
        mean_square = float((np.abs(error) ** 2).sum()) / max(1, 2 * int(each.measured.sum()))
        both = int((each.measured[lag:] & each.measured[:-lag]).sum())
        chance += 2 * both * spread * mean_square**2
    freedom = np.maximum(freedom - n_free / n_y, 1.0)
    return scipy.special.chdtrc(freedom, squares), products > _FOLLOWS * np.sqrt(chance)


def _notes(refused: bool, follows: bool, p_values: FloatArray) -> list[str]:
    if not refused:
        return []
    p = float(p_values.min())
    if follows:
        text = (
            "the structure leaves something out: errors of neighbouring frequencies follow each other, and are larger "
            f"than the standard deviations of the responses say (probability {p:.1g})"
        )
        return [FitNote.LEFT_OUT(text)]
    text = (
        f"errors are larger than the standard deviations of the responses say (probability {p:.1g}): those of the "
        "estimates are the robust ones"
    )
    return [FitNote.NOT_WHITE(text)]


def _fit_percent(errors: ResponseErrors, error: ComplexArray) -> FloatArray:
    """Return ``100 (1 - |e| / |G|)`` for each output, both in standard deviations."""
    data, measured = errors.data, errors.measured
    size = np.where(measured, np.nan_to_num(data.response) / np.where(measured, data.std, 1.0), 0.0)
    return np.asarray(100 * (1 - np.linalg.norm(error, axis=(0, 2)) / np.linalg.norm(size, axis=(0, 2))))
