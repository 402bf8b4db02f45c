r"""All surfaces from the recordings at once, without fits of single recordings between.

The parameters of recording i are :math:`\theta_i = X_i c + L z_i` with the coefficients c of all surfaces shared, and
:math:`z_i \sim N(0, I)` for what the machine lies off them in that recording, :math:`L L^T = S`. One multiple-shooting
problem has c, z_i, disturbance gains and initial states as unknowns and the prediction errors of all recordings as its
cost (Eq. 15). S follows from its solution (see `gbid.lpv.direct.uncertainty`), and the two are found in turn: the
method of Lindstrom and Bates (Biometrics 46, 1990) for nonlinear mixed effects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold
from gbid.errors import DataError
from gbid.identify.data import gather
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.watch import Progress
from gbid.identify.predictor import Focus
from gbid.lpv.direct.gains import own_gains
from gbid.lpv.direct.setting import Setting, set_up
from gbid.lpv.direct.solve import DirectSolution, How, solve_for
from gbid.lpv.direct.uncertainty import CoefficientUncertainty, uncertainty
from gbid.lpv.model import ACTUATOR_PARAMETERS, LPVModel
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.fit_lpv import in_own_units, rectangle
from gbid.lpv.surface_fit.lpv_fit import LPVFit, with_coefficients
from gbid.lpv.surface_fit.order import lack_of_fit
from gbid.lpv.surface_fit.outliers import outliers, standardised
from gbid.lpv.surface_fit.terms import distinct_points
from gbid.operating_point import point_label
from gbid.recording import Recording
from gbid.structure import KEY_PARAMETERS, RotorBearing, Structure, as_names
from gbid.threads import one_blas_thread

_SHORTEST = 20  # samples of a recording
_ROUNDS = 5
_SETTLED = 0.2  # of a coefficient's standard deviation


def fit_lpv_direct(
    recordings: Sequence[Recording],
    start: LPVFit | LPVModel,
    *,
    structure: Structure | None = None,
    focus: Focus = "prediction",
    intersample: Hold | Sequence[Hold] | None = None,
    fixed: Mapping[str, float] | None = None,
    scatter: bool = True,
    max_iterations: int = 100,
    engine: EngineName = "auto",
    name: str = "",
    progress: Callable[[Progress], None] | None = None,
) -> LPVFit:
    """Estimate all coefficients of the surfaces directly from the recordings (Eqs. 15 and 16 in one problem).

    Parameters
    ----------
    recordings : sequence of Recording
        Each with its operating point among its conditions and a name of its own.
    start : LPVFit or LPVModel
        Where to start, such as the result of `gbid.fit_lpv`; the terms that are not zero in it are estimated, and
        its actuators are the start of a `Plant`'s.
    structure : Structure, optional
        `RotorBearing` of the model's Pade order when not given; or one with exact delays, or a `Plant`, whose
        actuators are then shared by all recordings. Disturbance gains are each recording's own.
    focus : {"prediction", "simulation"}
    intersample : {"zoh", "foh"} or sequence, optional
        The structure's own when not given.
    fixed : dict of str to float, optional
        Actuators or disturbance gains that keep a value.
    scatter : bool
        Whether the machine may lie off the surfaces in each recording, by as much as it is found to. Without, all
        recordings are taken to lie on them: right for a machine that repeats itself, badly biased for one that does
        not, as a resonance that moves between recordings then passes for damping.
    max_iterations : int
    engine : {"auto", "compiled", "numpy"}
    name : str, optional
        Of the model; that of the start when not given.
    progress : callable, optional
        Called with a `Progress` at each iteration.

    Returns
    -------
    LPVFit
        Also when the solver did not converge: `status` and `success` tell. Its `estimates` are what each recording
        alone would have its parameters be, by one Gauss-Newton step from the solution.

    Raises
    ------
    UsageError
        For unknown names or options.
    DataError
        For recordings that cannot carry the fit: no operating point, two of one name, too few operating points; for a
        start whose delays are negative at one of these.
    """
    model = start.model if isinstance(start, LPVFit) else start
    structure = RotorBearing(pade_order=model.pade_order) if structure is None else structure
    hold = structure.intersample if intersample is None else intersample
    setting = set_up(recordings, model, structure, fixed or {})
    data = gather(recordings, as_names(structure.inputs), as_names(structure.outputs), minimum=_SHORTEST)
    how = How(focus, hold, engine, max_iterations, progress)
    known = start.scatter if scatter and isinstance(start, LPVFit) else np.zeros((len(KEY_PARAMETERS),) * 2)
    if negative := _negative_delay(setting, setting.start):
        raise DataError(
            f"the surfaces to start from give {negative}, and no delay is negative: single fits are too poor here; "
            "start from another model, or use longer recordings"
        )
    with one_blas_thread():
        gains = own_gains(setting, recordings, focus, hold, engine)
        shared, S = setting.start, _padded(known, len(setting.names))
        iterations, ended = 0, ""
        for round_ in range(1, _ROUNDS + 1):
            solved = solve_for(setting, data, shared, S, gains, how)
            found = uncertainty(setting.X, solved.values, solved.information)
            iterations += solved.solution.iterations
            if not (scatter and solved.solution.status.success):
                break
            if negative := _negative_delay(setting, found.refined):
                ended = f"stopped after round {round_}, as the next would begin with {negative}"
                break
            moved = np.abs(found.refined - shared) / np.sqrt(np.diag(found.refined_covariance))
            shared, S, gains = found.refined, found.scatter, solved.gains
            if round_ > 1 and moved.max() < _SETTLED:
                break
    options = {
        "method": "direct",
        "structure": structure.name,
        "focus": focus,
        "intersample": hold if isinstance(hold, str) else " ".join(hold),
        "weighting": "scatter" if scatter else "none",
        "rounds": str(round_),
        "iterations": str(iterations),
        "engine": solved.engine,
    }
    notes = [*solved.gains.notes, ended] if ended else list(solved.gains.notes)
    if scatter and not ended and solved.solution.status.success and moved.max() >= _SETTLED:
        notes.append(f"after {_ROUNDS} rounds the coefficients still moved by {moved.max():.2g} standard deviations")
    names = tuple(record.name for record in data.records)
    result = _result(start, setting, names, solved, found, scatter=scatter)
    return replace(
        result,
        model=replace(result.model, name=name or model.name),
        options=options,
        status=solved.solution.status,
        notes=tuple(notes),
    )


def _negative_delay(setting: Setting, shared: FloatArray) -> str:
    """Name the delay that surfaces make negative at a recording's point, with the place; empty when none is."""
    values = setting.X @ shared
    for key in ("tau_x", "tau_y"):
        delay = values[:, setting.names.index(key)]
        if delay.min() < 0:
            pressure, speed = setting.points[int(delay.argmin())]
            return f"{key} = {1e3 * delay.min():.3g} ms at {point_label(pressure, speed)}"
    return ""


def _result(
    start: LPVFit | LPVModel,
    setting: Setting,
    names: tuple[str, ...],
    solved: DirectSolution,
    found: CoefficientUncertainty,
    *,
    scatter: bool,
) -> LPVFit:
    """Refer what was found back to bar and rpm."""
    model = start.model if isinstance(start, LPVFit) else start
    k, m = len(KEY_PARAMETERS), len(KEY_PARAMETERS) * len(setting.exponents)
    shared, covariance = (found.refined, found.refined_covariance) if scatter else (solved.shared, found.covariance)
    others = dict(zip(setting.names[k:], shared[m:].tolist(), strict=True))
    known = {**model.actuators, **others, **setting.held}
    actuators = {key: known[key] for key in ACTUATOR_PARAMETERS if key in known}
    estimates = Estimates(names, setting.points, found.own[:, :k], found.own_covariance[:, :k, :k])
    residuals = estimates.values - (setting.X @ shared)[:, :k]
    S = found.scatter[:k, :k]
    return LPVFit(
        replace(
            with_coefficients(model, setting.coefficients(shared)),
            domain=rectangle(setting.points),
            operating_points=tuple((float(p), float(w)) for p, w in distinct_points(setting.points)),
            actuators=actuators,
        ),
        in_own_units(covariance[:m, :m], setting.design.back, setting.exponents),
        S,
        estimates,
        outliers(names, residuals, standardised(residuals, estimates.covariance + S)),
        orders=start.orders if isinstance(start, LPVFit) else (),
        lack_of_fit=lack_of_fit(setting.points, found.own[:, :k], setting.exponents),
    )


def _padded(scatter: FloatArray, n: int) -> FloatArray:
    """Scatter of the key parameters among all parameters: actuators do not scatter at the start."""
    found = np.zeros((n, n))
    found[: len(scatter), : len(scatter)] = scatter
    return found
