r"""Direct LPV fit: all surfaces from the recordings at once, without a fit of each recording.

The parameters of recording i are :math:`\theta_i = X_i c + L z_i`. The coefficients c of all surfaces are shared;
:math:`z_i \sim N(0, I)` is the deviation of recording i from the surfaces, with :math:`L L^T = S`. One
multiple-shooting problem has c, z_i, disturbance gains and initial states as unknowns and the prediction errors of all
recordings as its cost (Eq. 15). S follows from its solution (see `gbid.lpv.direct`). Problem and S are
solved in turn, which is the method of Lindstrom and Bates (Biometrics 46, 1990) for nonlinear mixed effects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, one_blas_thread, point_label
from gbid.core.errors import DataError, UsageError
from gbid.core.notes import SurfaceNote
from gbid.core.option_types import takes_options
from gbid.discretise import Hold
from gbid.identify.data import Channels, FitData, gather_own
from gbid.identify.fitting import fit
from gbid.identify.options import FitArguments, Focus, Scope
from gbid.identify.predictor import build_predictor
from gbid.identify.problem.assemble import OwnStructure, Ties, assemble, build_problem, full_start, unknown_bounds
from gbid.identify.problem.nlp import CLEAR, near_instability
from gbid.identify.problem.solve import Progress, Solution, solve
from gbid.identify.result import FitStatus
from gbid.identify.uncertainty.covariance import Estimate, RecordInformation, profiled, record_information
from gbid.lpv.estimates import Estimates, Orthonormal, orthonormal
from gbid.lpv.fit import LPVFit, with_coefficients
from gbid.lpv.model import ACTUATOR_PARAMETERS, EXPONENTS, LPVModel
from gbid.lpv.regression import (
    covariance_root,
    in_terms,
    in_units_of_terms,
    kron_designs,
    lack_of_fit,
    outliers,
    rms_or_one,
    standardised,
    with_scatter,
)
from gbid.recording import Recording
from gbid.structure import (
    KEY_PARAMETERS,
    Parameter,
    RotorBearing,
    Structure,
    as_names,
    equations_of,
    kind_of,
)
from gbid.structure.scheduling import Exponents

# ---- Setting of a direct LPV fit: parameters shared by the recordings, and those of each recording.


@dataclass(frozen=True, eq=False)
class Setting:
    """Setting of a direct LPV fit.

    Attributes
    ----------
    structures : tuple of OwnStructure
        Structure of each recording, with the behaviour of its inputs between samples.
    options : DirectOptions
        Options of the fit.
    parameters : tuple of Parameter
        Parameters of the structures, with the fixed ones marked.
    held : dict of str to float
        Parameters with fixed values.
    gains : tuple of str
        Disturbance gains to estimate, separately for each recording.
    shared : tuple of Parameter
        Shared unknowns: coefficients of the surfaces in orthogonal terms, then actuators.
    names : tuple of str
        Parameters that follow from the shared unknowns: the key parameters, then actuators.
    X : (n, n_names, n_shared) array
        Matrix from shared unknowns to these parameters, for each recording.
    points : (n, 2) array
        Operating points [bar], [rpm].
    exponents : tuple of (int, int)
        Exponents of the terms in use.
    design : Orthonormal
        Orthogonal terms.
    """

    structures: tuple[OwnStructure, ...]
    options: DirectOptions
    parameters: tuple[Parameter, ...]
    held: Mapping[str, float]
    gains: tuple[str, ...]
    shared: tuple[Parameter, ...]
    names: tuple[str, ...]
    X: FloatArray
    points: FloatArray
    exponents: Exponents
    design: Orthonormal

    @property
    def start(self) -> FloatArray:
        """Return the start values of the shared unknowns, (n_shared,)."""
        return np.array([q.start or 0.0 for q in self.shared])

    def ties(self, scatter: FloatArray) -> Ties:
        """Return the map from unknowns to parameters, with a scatter (n_names, n_names) between recordings.

        The deviation of a recording from the surfaces is ``lift @ deviations``, with `deviations` of variance one.
        """
        lift = covariance_root(scatter, least=_NO_SCATTER)
        deviations = tuple(Parameter(f"off_{i + 1}", 0.0) for i in range(lift.shape[1]))
        return Ties(self.names, self.shared, self.X, deviations, lift)

    @property
    def back(self) -> FloatArray:
        """Matrix from the coefficients of the orthogonal terms to the coefficients in bar and rpm, (6, m)."""
        return in_terms(self.design.back, self.exponents)

    def coefficients(self, shared: FloatArray) -> FloatArray:
        """Return the coefficients of the six terms in bar and rpm, (14, 6), from the shared unknowns."""
        k, m = len(KEY_PARAMETERS), len(self.exponents)
        return np.asarray(shared[: k * m].reshape(k, m) @ self.back.T)


def set_up(
    recordings: Sequence[Recording], model: LPVModel, structures: Sequence[Structure], options: DirectOptions
) -> Setting:
    """Return the setting of a direct LPV fit: shared unknowns, their matrix to parameters, gains."""
    fixed = options.fixed or {}
    for structure in structures:
        missing = [key for key in KEY_PARAMETERS if key not in [q.name for q in structure.parameters]]
        if missing:
            raise UsageError(
                f"structure {structure.name!r} has no {', '.join(missing)}; surfaces need all key parameters"
            )
    parameters = {q.name: q for structure in structures for q in structure.parameters}
    names = list(parameters)
    for key in fixed:
        if key in KEY_PARAMETERS or key not in names:
            what = "is a surface, which is estimated" if key in KEY_PARAMETERS else "is not a parameter"
            used = " or ".join(dict.fromkeys(repr(structure.name) for structure in structures))
            raise UsageError(f"fixed: {key} {what} of structure {used}; leave it out")
    points = _points(recordings)
    coefficients = np.array([model.coefficients[key] for key in KEY_PARAMETERS])
    in_use: BoolArray = np.any(coefficients, axis=0)
    exponents = tuple(exponent for exponent, has_term in zip(EXPONENTS, in_use, strict=True) if has_term)
    design = orthonormal(points, exponents)
    noise = frozenset[str]().union(*(kind_of(each).anatomy().gain_only for each in structures))
    others = [q for q in parameters.values() if q.name not in (*KEY_PARAMETERS, *noise, *fixed)]
    for structure in structures:
        known = [q.name for q in structure.parameters]
        if lacking := [q.name for q in others if q.name not in known]:
            raise UsageError(
                f"structure {structure.name!r} has no {', '.join(lacking)}, which another has; fix them (fixed)"
            )
    unknown = [q.name for q in others if q.name not in model.actuators and q.start is None]
    if unknown:
        raise UsageError(f"no start for {', '.join(unknown)}; give the start model actuators, or fix them (fixed)")
    surfaces = np.linalg.solve(design.back, coefficients[:, in_use].T).T.ravel()
    labels = [f"{key} {i + 1}" for key in KEY_PARAMETERS for i in range(len(exponents))]
    shared = [Parameter("coefficient", v).renamed(label) for label, v in zip(labels, surfaces.tolist(), strict=True)]
    shared += [replace(q, start=model.actuators.get(q.name, q.start)) for q in others]
    k, m = len(KEY_PARAMETERS), len(surfaces)
    X = np.zeros((len(points), k + len(others), m + len(others)))
    X[:, :k, :m] = kron_designs(design.columns, k)
    X[:, k:, m:] = np.eye(len(others))
    return Setting(
        tuple(OwnStructure(each, options.intersample or each.intersample) for each in structures),
        options,
        tuple(
            Parameter(q.name, float(fixed[q.name]), fixed=True, unit=q.unit) if q.name in fixed else q
            for q in parameters.values()
        ),
        dict(fixed),
        tuple(q.name for q in parameters.values() if q.name in noise and q.name not in fixed),
        tuple(shared),
        (*KEY_PARAMETERS, *(q.name for q in others)),
        X,
        points,
        exponents,
        design,
    )


def _points(recordings: Sequence[Recording]) -> FloatArray:
    """Return the operating points of recordings, (n, 2)."""
    rows = []
    for recording in recordings:
        point = [recording.conditions.get(key) for key in ("pressure_bar", "speed_rpm")]
        if None in point:
            raise DataError(f"recording {recording.name!r} states no pressure_bar and speed_rpm; surfaces need both")
        rows.append([float(v) for v in point if v is not None])
    names = [recording.name for recording in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(f"several recordings are named {twice[0]!r}; give each its own name")
    if not rows:
        raise DataError("no recordings to fit; give at least one")
    return np.array(rows)


# ---- Start values of disturbance gains for the direct LPV fit: a small fit for each recording with fixed surfaces.

_ITERATIONS = 40
_NO_SCATTER = 1e-9  # largest scaled eigenvalue of the scatter in a direction without scatter


@dataclass(frozen=True, eq=False)
class Gains:
    """Start values of disturbance gains, and the recordings in which they are fixed.

    Attributes
    ----------
    values : list of dict of str to float
        Values by name, for each recording.
    held : (n,) boolean array
        Whether the gains of each recording are fixed.
    notes : tuple of str
        Notes for the result.
    """

    values: list[dict[str, float]]
    held: BoolArray
    notes: tuple[str, ...] = ()


def start_gains(setting: Setting, recordings: Sequence[Recording]) -> Gains:
    """Return the disturbance gains of each recording, fitted with all other parameters fixed at the start.

    When a record does not determine a gain, the gain makes the predictor almost unstable and blocks all other
    parameters. It is then fixed at zero.
    """
    nothing = dict.fromkeys(setting.gains, 0.0)
    if not setting.gains or setting.options.focus == "simulation":
        return Gains([nothing for _ in recordings], np.zeros(len(recordings), dtype=bool))
    values, held = [], []
    for recording, (structure, hold), X in zip(recordings, setting.structures, setting.X, strict=True):
        names = [q.name for q in structure.parameters]
        if not set(setting.gains).intersection(names):
            values.append(nothing)
            held.append(False)
            continue
        known = {key: value for key, value in setting.held.items() if key in names}
        assert isinstance(structure, Structure)  # fit_lpv_direct refuses others
        predictor = build_predictor(structure, known, recording.sample_time, hold, "prediction")
        surface = dict(zip(setting.names, (X @ setting.start).tolist(), strict=True))
        fixed = {**surface, **known}
        result = fit(structure, recording, intersample=hold, fixed=fixed, window=None, max_iterations=_ITERATIONS)
        estimates = np.array([result.parameters[q.name] for q in predictor.free])
        determined = result.success and not near_instability(predictor, estimates, predictor.at(estimates), CLEAR)
        gains = {name: result.parameters[name] for name in setting.gains if name in names}
        values.append({**nothing, **gains} if determined else nothing)
        held.append(not determined)
    names = [r.name for r, stays in zip(recordings, held, strict=True) if stays]
    note = f"disturbance gain fixed at zero in {len(names)} of {len(held)} recordings, which do not determine it: "
    return Gains(values, np.array(held), (note + ", ".join(names),) if names else ())


# ---- Nonlinear programme of the direct LPV fit, for a given scatter between recordings.


@dataclass(frozen=True, eq=False)
class DirectSolution:
    """Solution of the programme.

    Attributes
    ----------
    surfaces : DirectEstimate
        Shared unknowns, and the parameters that each recording alone would give, with their uncertainty.
    gains : Gains
        Disturbance gains of each recording.
    solution : Solution
        Last iterate of the solver, with its status.
    engine : str
        Engine of the pass over the samples.
    """

    surfaces: DirectEstimate
    gains: Gains
    solution: Solution
    engine: str


def solve_for(setting: Setting, data: FitData, shared: FloatArray, scatter: FloatArray, gains: Gains) -> DirectSolution:
    """Minimum of the prediction errors of all recordings over the shared unknowns and those of each recording.

    A recording in which the free gain makes the predictor almost unstable does not determine this gain. It is fixed
    at zero there, and the problem is solved again. When the problem is not solved for another reason, all gains are
    fixed at their start values, and at zero where these make a predictor unstable. Notes report each.
    """
    ties, options, each = setting.ties(scatter), setting.options, setting.structures
    at_first = dict(zip(setting.names, (setting.X[0] @ shared).tolist(), strict=True))
    parameters = tuple(q if q.fixed else replace(q, start=at_first.get(q.name, 0.0)) for q in setting.parameters)
    begin = {q.name: float(q.start or 0.0) for q in parameters}
    local: dict[str, Scope] = dict.fromkeys(setting.gains if options.focus == "prediction" else (), "recording")
    programme = FitArguments(
        focus=options.focus,
        local=local,
        criterion="trace",
        prior={q.name: (0.0, 1.0) for q in ties.own},
        window=None,  # the start is near the solution: windows within a recording are not needed
        max_iterations=options.max_iterations,
        progress=options.progress,
    )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        assembly = assemble(each, parameters, begin, data, programme, ties=ties)
        full = full_start(assembly, begin, gains.values)
        full |= dict(zip((q.name for q in ties.shared), shared.tolist(), strict=True))
        problem, unknowns = build_problem(assembly, data, programme, full)
        lower, upper = unknown_bounds(problem, assembly)
        position = {q.name: i for i, q in enumerate(assembly.free)}
        places = [{key: position[names[key]] for key in local if key in names} for names in assembly.record_names]
        part_of = np.searchsorted(problem.first_window, assembly.record_window, side="right") - 1

        def unstable(at: FloatArray) -> BoolArray:
            """Return whether the gain of each recording makes its predictor almost unstable."""
            return np.array(list(problem.parts_at_edge(problem.unpack(at)[0])), dtype=bool)[part_of]

        def fix(chosen: BoolArray, value: float | None = None) -> None:
            """Fix the gains of the chosen recordings, at a value or at their start values."""
            at = [
                place for of_record, fixed in zip(places, chosen, strict=True) if fixed for place in of_record.values()
            ]
            unknowns[at] = unknowns[at] if value is None else value
            lower[at] = upper[at] = unknowns[at]

        def run() -> Solution:
            return solve(problem, np.clip(unknowns, lower, upper), lower, upper, programme)

        fix(gains.held)
        edge = unstable(unknowns) & ~gains.held
        held, given_up, at_rest = gains.held | edge, False, False
        fix(edge, 0.0)
        solution = run()
        while local and not (solution.status.success or given_up or held.all()):
            edge = unstable(solution.unknowns) & ~held
            given_up = not edge.any()
            fix(edge, 0.0)
            fix(given_up & ~held)
            held = held | edge | given_up
            solution = run()
        if given_up and solution.status is FitStatus.UNSTABLE_PREDICTOR:  # of the surfaces that moved meanwhile
            at_rest = True
            fix(held, 0.0)
            solution = run()
        theta, starts = problem.unpack(solution.unknowns)
        free = [[q.name for q in problem.parts[part].predictor.free] for part in part_of]
        kept = [np.array([names.index(name) for name in setting.names]) for names in free]
        estimate = Estimate(problem, theta, starts, assembly.record_window)
        information = record_information(estimate, np.diag(problem.output_weights))
    notes = list(gains.notes)
    if near := [r.name for r, now, before in zip(data.records, held, gains.held, strict=True) if now and not before]:
        if given_up:
            where = "zero" if at_rest else "their start values"
            text = f"free disturbance gains did not converge: all are fixed at {where}"
        else:
            text = f"disturbance gain fixed at zero where it made the predictor unstable: {', '.join(near)}"
        notes.append(SurfaceNote.GAIN_HELD(text))
    if given_up and solution.status.success:
        solution = replace(solution, status=FitStatus.CONVERGED_GAIN_HELD)
    ended = [
        {**values, **{key: float(theta[place]) for key, place in of_record.items()}}
        for of_record, values in zip(places, gains.values, strict=True)
    ]
    shared = theta[: len(ties.shared)]
    off = np.array([[theta[position[names[q.name]]] for q in ties.own] for names in assembly.record_names])
    values = setting.X @ shared + off.reshape(len(setting.X), -1) @ ties.lift.T
    alone = [profiled(record, columns) for record, columns in zip(information, kept, strict=True)]
    surfaces = direct_estimate(setting, shared, values, alone)
    return DirectSolution(surfaces, Gains(ended, held, tuple(notes)), solution, assembly.engine)


# ---- Uncertainty of directly estimated surfaces.
#
# At the estimate, record i alone would change its parameters by about one Gauss-Newton step,
# :math:`\delta_i = H_i^{-1} g_i` with its score :math:`g_i` and information :math:`H_i` (its disturbance gain and
# initial
# state eliminated). So :math:`\theta_i + \delta_i` is its own estimate, with covariance
# :math:`C_i = H_i^{-1} J_i H_i^{-1}`, without a separate fit. The scatter S between recordings follows from these as it
# does from fits of single recordings. The coefficients are the mean of these estimates with the weights :math:`H_i`,
# so that their covariance is
#
# .. math::
#     A^{-1} \Bigl[\sum_i X_i^T (J_i + H_i S H_i) X_i\Bigr] A^{-1}, \qquad A = \sum_i X_i^T H_i X_i .

_WEAK = 1e-9  # largest scaled eigenvalue of a record's information in a direction that it does not determine


class DirectEstimate(NamedTuple):
    """Directly estimated surfaces with their uncertainty, in the units of the parameters.

    Attributes
    ----------
    shared : (m,) array
        Coefficients in orthogonal terms, then actuators: with scatter the mean of the estimates of the recordings with
        weights from the scatter and their covariances, otherwise those of the programme.
    covariance : (m, m) array
        Covariance of these coefficients.
    scatter : (k, k) array
        Covariance of the deviations between recordings.
    single : (n, k) array
        Parameters that each recording alone would give.
    single_covariance : (n, k, k) array
        Covariance of these parameters.
    """

    shared: FloatArray
    covariance: FloatArray
    scatter: FloatArray
    single: FloatArray
    single_covariance: FloatArray


def direct_estimate(
    setting: Setting, shared: FloatArray, values: FloatArray, information: list[RecordInformation]
) -> DirectEstimate:
    """Return the scatter, and the coefficients with their covariance.

    Parameters
    ----------
    setting : Setting
        Setting, with the matrix from coefficients to parameters of each record.
    shared : (m,) array
        Coefficients at the solution of the programme.
    values : (n, k) array
        Parameters of each record there.
    information : list of RecordInformation, n
        Information on the k parameters, all other unknowns eliminated.

    Returns
    -------
    DirectEstimate
    """
    scale = rms_or_one(values)
    H = np.array([i.hessian for i in information]) * np.outer(scale, scale)
    g = np.array([i.scores.sum(axis=0) for i in information]) * scale
    J = np.array([_long_run(i.scores) for i in information]) * np.outer(scale, scale)
    inverse = np.array([_inverse(h) for h in H])
    step = np.einsum("ikl,il->ik", inverse, g)
    C = inverse @ _smoothed(H, J) @ inverse
    scaled = setting.X / scale[:, None]
    y = values / scale + step
    mixed = with_scatter(y, scaled, C)
    covariance = mixed.covariance
    if setting.options.scatter:
        shared = mixed.coefficients
    else:
        onto = _inverse(np.einsum("ikm,ikl,iln->mn", scaled, H, scaled, optimize=True))
        middle = J + H @ mixed.scatter @ H
        covariance = onto @ np.einsum("ikm,ikl,iln->mn", scaled, middle, scaled, optimize=True) @ onto
    outer = np.outer(scale, scale)
    return DirectEstimate(shared, covariance, mixed.scatter * outer, y * scale, C * outer)


def _smoothed(H: FloatArray, J: FloatArray) -> FloatArray:
    """Return covariances of scores, smoothed over the records.

    One record alone determines the k x k entries of its J poorly, and weights that depend on its errors bias a mean. In
    coordinates in which its H is one, J is the power of the residuals times a matrix of their colour, which all records
    share.
    """
    size = np.sqrt(np.einsum("ikk->ik", H))
    k = size.shape[1]
    factors = []
    for h, s in zip(H, size, strict=True):
        values, vectors = np.linalg.eigh(h / np.outer(s, s))
        factors.append((vectors * np.sqrt(np.maximum(values, _WEAK * values[-1]))) @ vectors.T * s[:, None])
    L = np.array(factors)  # the symmetric root, scaled: near for records that are alike
    white = np.linalg.solve(L, np.linalg.solve(L, J).transpose(0, 2, 1))
    power = np.einsum("ikk->i", white) / k
    shape = np.mean(white / np.maximum(power, 1e-300)[:, None, None], axis=0)
    return np.asarray(power[:, None, None] * (L @ shape @ L.transpose(0, 2, 1)))


def _long_run(scores: FloatArray) -> FloatArray:
    """Return the covariance of the sum of scores (Newey and West, 1987), from those of the blocks (n_blocks, k)."""
    lag = min(2, len(scores) - 1)  # correlation length of residuals in blocks: a few, because blocks are long
    total = scores.T @ scores
    for shift in range(1, lag + 1):
        product = scores[shift:].T @ scores[:-shift]
        total += (1 - shift / (lag + 1)) * (product + product.T)
    return np.asarray(total)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix; directions with almost no information get almost zero."""
    size = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(size, size))
    values = np.maximum(values, _WEAK * values[-1])
    return np.asarray((vectors / values) @ vectors.T * np.outer(size, size))


_SHORTEST = 20  # smallest number of samples of a recording
_ROUNDS = 5
_SETTLED = 0.2  # largest change of a settled coefficient, in standard deviations


@dataclass(frozen=True, kw_only=True)
class DirectOptions:
    """Options of a direct LPV fit.

    Attributes
    ----------
    structure : Structure or dict of str to Structure, optional
        By default `RotorBearing`, with exact delays. Other choices are one with Pade filters, or a
        `Plant`, whose actuators are then shared by all recordings. Each recording has its own disturbance gains.
        A dict gives recordings structures of their own, by name; the others have the default. So recordings in open
        and in closed loop determine the same surfaces. The structures explain the same outputs, from inputs of their
        own. Parameters that not all of them have are disturbance gains, or fixed.
    focus : {"prediction", "simulation"}
        Focus of the errors.
    intersample : {"zoh", "foh"} or sequence, optional
        Behaviour of the inputs between samples; by default that of each structure.
    fixed : dict of str to float, optional
        Actuators or disturbance gains with fixed values.
    scatter : bool
        Whether the parameters of a recording may deviate from the surfaces; the size of the deviation is estimated.
        With false, all recordings lie on the surfaces. That is right for a machine that repeats exactly. For others it
        is strongly biased, because a resonance that moves between recordings then looks like damping.
    max_iterations : int
        Largest number of iterations of each solution.
    name : str, optional
        Name of the model; by default that of `start`.
    progress : callable, optional
        Function that is called with a `Progress` at each iteration.
    """

    structure: Structure | Mapping[str, Structure] | None = None
    focus: Focus = "prediction"
    intersample: Hold | Sequence[Hold] | None = None
    fixed: Mapping[str, float] | None = None
    scatter: bool = True
    max_iterations: int = 100
    name: str = ""
    progress: Callable[[Progress], None] | None = None


@takes_options(DirectOptions)
def fit_lpv_direct(recordings: Sequence[Recording], start: LPVFit | LPVModel, options: DirectOptions) -> LPVFit:
    """Return surfaces whose coefficients are estimated directly from the recordings (Eqs. 15 and 16 in one problem).

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings, each with its own name and with its operating point in its conditions.
    start : LPVFit or LPVModel
        Start values, such as the result of `gbid.fit_lpv`. Terms that are not zero in it are estimated; its actuators
        are the start values of those of a `Plant`.
    **options

    Returns
    -------
    LPVFit
        The surfaces, also when the solver did not converge; see `status` and `success`. Its `estimates` are the
        parameters that each recording alone would give, by one Gauss-Newton step from the solution.

    Raises
    ------
    UsageError
        When a name or option is unknown.
    DataError
        When the recordings are not sufficient: an operating point is missing, two have the same name, or there are too
        few operating points; or when a delay of the start is negative at an operating point.
    """
    model = start.model if isinstance(start, LPVFit) else start
    structures = _structures_of(recordings, options.structure, RotorBearing())
    if nonlinear := [each.name for each in structures if kind_of(equations_of(each)).nonlinear]:
        raise UsageError(
            f"structure {nonlinear[0]!r} is nonlinear: surfaces straight from the recordings are for linear "
            "structures; use fit_lpv on the fits"
        )
    setting = set_up(recordings, model, structures, options)
    channels = [Channels(as_names(each.inputs), as_names(each.outputs)) for each in structures]
    data = gather_own(recordings, channels, minimum=_SHORTEST)
    known = start.scatter if options.scatter and isinstance(start, LPVFit) else np.zeros((len(KEY_PARAMETERS),) * 2)
    if negative := _negative_delay(setting, setting.start):
        raise DataError(
            f"the start surfaces give {negative}, and no delay is negative: the single fits are too inaccurate; "
            "start from another model, or use longer recordings"
        )
    with one_blas_thread():
        gains = start_gains(setting, recordings)
        shared, S = setting.start, np.pad(known, (0, len(setting.names) - len(known)))
        iterations, ended = 0, ""
        for round_ in range(1, _ROUNDS + 1):
            solved = solve_for(setting, data, shared, S, gains)
            surfaces = solved.surfaces
            iterations += solved.solution.iterations
            if not (options.scatter and solved.solution.status.success):
                break
            if negative := _negative_delay(setting, surfaces.shared):
                ended = f"stopped after round {round_}, as the next would begin with {negative}"
                break
            change = np.abs(surfaces.shared - shared) / np.sqrt(np.diag(surfaces.covariance))
            shared, S, gains = surfaces.shared, surfaces.scatter, solved.gains
            if round_ > 1 and change.max() < _SETTLED:
                break
    notes = [*solved.gains.notes, ended] if ended else list(solved.gains.notes)
    if options.scatter and not ended and solved.solution.status.success and change.max() >= _SETTLED:
        text = f"after {_ROUNDS} rounds the coefficients still moved by {change.max():.2g} standard deviations"
        notes.append(SurfaceNote.NOT_SETTLED(text))
    k, m = len(KEY_PARAMETERS), len(KEY_PARAMETERS) * len(setting.exponents)
    shared, S = surfaces.shared, surfaces.scatter[:k, :k]
    fitted = dict(zip(setting.names[k:], shared[m:].tolist(), strict=True))
    actuators = {**model.actuators, **fitted, **setting.held}
    names = tuple(record.name for record in data.records)
    estimates = Estimates(names, setting.points, surfaces.single[:, :k], surfaces.single_covariance[:, :k, :k])
    residuals = estimates.values - (setting.X @ shared)[:, :k]
    return LPVFit(
        with_coefficients(
            model,
            KEY_PARAMETERS,
            setting.coefficients(shared),
            name=options.name or model.name,
            domain=estimates.domain,
            operating_points=estimates.operating_points,
            actuators={key: actuators[key] for key in ACTUATOR_PARAMETERS if key in actuators},
        ),
        in_units_of_terms(surfaces.covariance[:m, :m], setting.back),
        S,
        estimates,
        outliers(names, residuals, standardised(residuals, estimates.covariance + S)),
        orders=start.orders if isinstance(start, LPVFit) else (),
        lack_of_fit=lack_of_fit(setting.points, estimates.values, setting.exponents),
        options={
            "method": "direct",
            "structure": ", ".join(dict.fromkeys(each.name for each in structures)),
            "focus": options.focus,
            "intersample": ", ".join(dict.fromkeys(" ".join(as_names(hold)) for _, hold in setting.structures)),
            "weighting": "scatter" if options.scatter else "none",
            "rounds": str(round_),
            "iterations": str(iterations),
            "engine": solved.engine,
        },
        status=solved.solution.status,
        notes=tuple(notes),
    )


def _structures_of(
    recordings: Sequence[Recording], given: Structure | Mapping[str, Structure] | None, usual: Structure
) -> list[Structure]:
    """Return the structure of each recording."""
    if not isinstance(given, Mapping):
        return [given or usual] * len(recordings)
    names = [recording.name for recording in recordings]
    if strangers := [name for name in given if name not in names]:
        raise UsageError(f"structure: no recording {strangers[0]!r}; there are {', '.join(names)}")
    return [given.get(name, usual) for name in names]


def _negative_delay(setting: Setting, shared: FloatArray) -> str:
    """Negative delay of the surfaces with its operating point, as a text; empty when all delays are positive."""
    values = setting.X @ shared
    for key in ("tau_x", "tau_y"):
        delay = values[:, setting.names.index(key)]
        if delay.min() < 0:
            pressure, speed = setting.points[int(delay.argmin())]
            return f"{key} = {1e3 * delay.min():.3g} ms at {point_label(pressure, speed)}"
    return ""
