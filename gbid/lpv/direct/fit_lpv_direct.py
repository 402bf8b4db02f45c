r"""Direct LPV fit: all surfaces from the recordings at once, without a fit of each recording.

The parameters of recording i are :math:`\theta_i = X_i c + L z_i`. The coefficients c of all surfaces are shared;
:math:`z_i \sim N(0, I)` is the deviation of recording i from the surfaces, with :math:`L L^T = S`. One
multiple-shooting problem has c, z_i, disturbance gains and initial states as unknowns and the prediction errors of all
recordings as its cost (Eq. 15). S follows from its solution (see `gbid.lpv.direct.uncertainty`). Problem and S are
solved in turn, which is the method of Lindstrom and Bates (Biometrics 46, 1990) for nonlinear mixed effects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold
from gbid.errors import DataError, UsageError
from gbid.identify.data import Channels, gather_own
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.watch import Progress
from gbid.identify.predictor import Focus
from gbid.lpv.direct.gains import own_gains
from gbid.lpv.direct.setting import Setting, set_up
from gbid.lpv.direct.solve import DirectSolution, How, solve_for
from gbid.lpv.direct.uncertainty import CoefficientUncertainty, uncertainty
from gbid.lpv.model import ACTUATOR_PARAMETERS, LPVModel
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.fit_lpv import of_all_terms, rectangle
from gbid.lpv.surface_fit.lpv_fit import LPVFit, with_coefficients
from gbid.lpv.surface_fit.order import lack_of_fit
from gbid.lpv.surface_fit.outliers import outliers, standardised
from gbid.lpv.surface_fit.regression import in_own_units
from gbid.lpv.surface_fit.terms import distinct_points
from gbid.notes.model_notes import SurfaceNote
from gbid.operating_point import point_label
from gbid.recording import Recording
from gbid.structure import KEY_PARAMETERS, NonlinearStructure, RotorBearing, Structure, as_names, equations_of
from gbid.threads import one_blas_thread

_SHORTEST = 20  # smallest number of samples of a recording
_ROUNDS = 5
_SETTLED = 0.2  # largest change of a settled coefficient, in standard deviations


def fit_lpv_direct(
    recordings: Sequence[Recording],
    start: LPVFit | LPVModel,
    *,
    structure: Structure | Mapping[str, Structure] | None = None,
    focus: Focus = "prediction",
    intersample: Hold | Sequence[Hold] | None = None,
    fixed: Mapping[str, float] | None = None,
    scatter: bool = True,
    max_iterations: int = 100,
    engine: EngineName = "auto",
    name: str = "",
    progress: Callable[[Progress], None] | None = None,
) -> LPVFit:
    """Return surfaces whose coefficients are estimated directly from the recordings (Eqs. 15 and 16 in one problem).

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings, each with its own name and with its operating point in its conditions.
    start : LPVFit or LPVModel
        Start values, such as the result of `gbid.fit_lpv`. Terms that are not zero in it are estimated; its actuators
        are the start values of those of a `Plant`.
    structure : Structure or dict of str to Structure, optional
        By default `RotorBearing` with the Pade order of the model. Other choices are one with exact delays, or a
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
    engine : {"auto", "compiled", "numpy"}
        Engine of the pass over the samples.
    name : str, optional
        Name of the model; by default that of `start`.
    progress : callable, optional
        Function that is called with a `Progress` at each iteration.

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
    structures = _structures_of(recordings, structure, RotorBearing(pade_order=model.pade_order))
    if nonlinear := [one.name for one in structures if isinstance(equations_of(one), NonlinearStructure)]:
        raise UsageError(
            f"structure {nonlinear[0]!r} is nonlinear: surfaces straight from the recordings are for linear "
            "structures; use fit_lpv on the fits"
        )
    setting = set_up(recordings, model, structures, fixed or {})
    channels = [Channels(as_names(one.inputs), as_names(one.outputs)) for one in structures]
    data = gather_own(recordings, channels, minimum=_SHORTEST)
    how = How(focus, intersample, engine, max_iterations, progress)
    known = start.scatter if scatter and isinstance(start, LPVFit) else np.zeros((len(KEY_PARAMETERS),) * 2)
    if negative := _negative_delay(setting, setting.start):
        raise DataError(
            f"the start surfaces give {negative}, and no delay is negative: the single fits are too inaccurate; "
            "start from another model, or use longer recordings"
        )
    with one_blas_thread():
        gains = own_gains(setting, recordings, focus, intersample, engine)
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
        "structure": ", ".join(dict.fromkeys(one.name for one in structures)),
        "focus": focus,
        "intersample": ", ".join(dict.fromkeys(_hold_text(intersample or one.intersample) for one in structures)),
        "weighting": "scatter" if scatter else "none",
        "rounds": str(round_),
        "iterations": str(iterations),
        "engine": solved.engine,
    }
    notes = [*solved.gains.notes, ended] if ended else list(solved.gains.notes)
    if scatter and not ended and solved.solution.status.success and moved.max() >= _SETTLED:
        text = f"after {_ROUNDS} rounds the coefficients still moved by {moved.max():.2g} standard deviations"
        notes.append(SurfaceNote.NOT_SETTLED(text))
    names = tuple(record.name for record in data.records)
    result = _result(start, setting, names, solved, found, scatter=scatter)
    return replace(
        result,
        model=replace(result.model, name=name or model.name),
        options=options,
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


def _hold_text(hold: Hold | Sequence[Hold]) -> str:
    return hold if isinstance(hold, str) else " ".join(hold)


def _negative_delay(setting: Setting, shared: FloatArray) -> str:
    """Return a text with a delay that the surfaces make negative, and its operating point; empty when there is none."""
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
    """Return the fit with coefficients in terms of bar and rpm."""
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
        of_all_terms(in_own_units(covariance[:m, :m], setting.design.back), setting.exponents),
        S,
        estimates,
        outliers(names, residuals, standardised(residuals, estimates.covariance + S)),
        orders=start.orders if isinstance(start, LPVFit) else (),
        lack_of_fit=lack_of_fit(setting.points, found.own[:, :k], setting.exponents),
    )


def _padded(scatter: FloatArray, n: int) -> FloatArray:
    """Return the scatter of the key parameters, padded with zeros for the actuators."""
    found = np.zeros((n, n))
    found[: len(scatter), : len(scatter)] = scatter
    return found
