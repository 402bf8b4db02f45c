"""Surfaces of a gas bearing directly from recordings, by the fit of a scheduled structure (paper, Eqs. 15 to 18)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import DataError, UsageError
from gbid.discretise import Hold
from gbid.identify.fitting import fit
from gbid.identify.options import Focus
from gbid.identify.problem.solve import Progress
from gbid.identify.result import FitResult
from gbid.lpv.estimates import Estimates, covariance_of
from gbid.lpv.fit import LPVFit, fit_lpv
from gbid.lpv.model import ACTUATOR_PARAMETERS, EXPONENTS, SCHEDULING, Domain, LPVModel, regressors
from gbid.lpv.regression import in_terms, in_units_of_terms
from gbid.recording import Recording
from gbid.structure import KEY_PARAMETERS, RotorBearing, Structure
from gbid.structure.kinds import equations_of, kind_of
from gbid.structure.scheduling import Schedule, scheduled, term_name


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
    name: str = "",
    progress: Callable[[Progress], None] | None = None,
) -> LPVFit:
    """Return surfaces from one fit of all recordings, for recordings too short or noisy for separate fits.

    ``fit(scheduled(structure), recordings)`` estimates the coefficients, and with them actuators and disturbance gains
    that all recordings share. A machine that changes from recording to recording needs a second step, because one
    resonance for all recordings of a point takes the width of the shifted peaks for damping. Each recording is then
    fitted alone, from the surfaces and with the shared parameters, and `fit_lpv` draws the surfaces through these
    estimates.

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings, each with its operating point in its conditions.
    start : LPVFit or LPVModel
        Start values, such as the result of `gbid.fit_lpv`. Terms that are not zero in it are estimated; its actuators
        are the start values of those of a `Plant`.
    structure : Structure, optional
        By default `RotorBearing`, with exact delays; a `Plant` for recordings from r.
    focus, intersample
        As for `gbid.fit`.
    fixed : dict of str to float, optional
        Actuators or disturbance gains with fixed values.
    scatter : bool
        Whether the machine changes from recording to recording. With false, all recordings lie on the surfaces.
    max_iterations : int
        Largest number of iterations of each fit.
    name : str, optional
        Name of the model; by default that of `start`.
    progress : callable, optional
        Function that is called with a `Progress` at each iteration of the fit of all recordings.

    Returns
    -------
    LPVFit
        The surfaces, also when the fit of all recordings did not converge; see `status` and `success`.

    Raises
    ------
    UsageError
        When the structure lacks key parameters, or a name is unknown.
    DataError
        When a recording has no operating point, or the operating points do not determine the terms.
    """
    model = start.model if isinstance(start, LPVFit) else start
    model.need_bearing()
    structure = structure or RotorBearing()
    names = [q.name for q in structure.parameters]
    if kind_of(equations_of(structure)).nonlinear:
        raise UsageError(f"structure {structure.name!r} is nonlinear; use fit_lpv on the fits of the recordings")
    if lacking := [key for key in KEY_PARAMETERS if key not in names]:
        raise UsageError(f"structure {structure.name!r} has no {', '.join(lacking)}; surfaces need all key parameters")
    if surface := [key for key in fixed or {} if key in KEY_PARAMETERS]:
        raise UsageError(f"fixed: {surface[0]} is a surface, which is estimated; leave it out")
    points = _points(recordings)
    in_use = [e for j, e in enumerate(EXPONENTS) if any(row[j] for row in model.coefficients.values())]
    lower = {e for each in in_use for e in product(*(range(power + 1) for power in each))}
    terms = tuple(e for e in EXPONENTS if e in lower)  # a fit shifts the origin, which needs all lower powers
    schedule = Schedule(
        SCHEDULING, tuple(points.min(axis=0)), tuple(points.max(axis=0)), KEY_PARAMETERS, terms, len(points)
    )
    first = {key: value for key, value in model.actuators.items() if key in names and key not in (fixed or {})}
    for key in KEY_PARAMETERS:
        row = [model.coefficients[key][EXPONENTS.index(e)] for e in terms]
        first |= dict(zip(schedule.names(key), np.linalg.solve(schedule.to_own_units, row).tolist(), strict=True))
    for key in ("tau_x", "tau_y"):
        delay = regressors(*points.T) @ model.coefficients[key]
        if delay.min() < 0:
            place = point_label(*points[delay.argmin()])
            raise DataError(
                f"the start surfaces give {key} = {1e3 * delay.min():.3g} ms at {place}, and no delay is negative: "
                "the single fits are too inaccurate; start from another model, or use longer recordings"
            )
    how: dict[str, Any] = {"focus": focus, "intersample": intersample, "max_iterations": max_iterations}
    together = replace(scheduled(structure, surfaces=KEY_PARAMETERS), exponents=terms)
    joint = fit(together, recordings, start=first, fixed=fixed, progress=progress, **how)
    known = {key: joint.parameters[key] for key in names if key not in KEY_PARAMETERS}
    actuators = {**model.actuators, **{key: known[key] for key in ACTUATOR_PARAMETERS if key in known}}
    texts: dict[str, Any] = {"name": name or model.name, "title": model.title, "source": model.source}
    surfaces = _surfaces_of(joint, actuators, **texts)
    if not (scatter and joint.success):
        return surfaces
    alone = [
        fit(structure, recording, start=surfaces.model.key_parameters(*point), fixed=known, **how)
        for recording, point in zip(recordings, points.tolist(), strict=True)
    ]
    order, pade_order = [term_name(e) for e in in_use], surfaces.model.pade_order
    through = fit_lpv(alone, points.tolist(), order=order, actuators=actuators, pade_order=pade_order, **texts)
    options = {**surfaces.options, **through.options, "method": "direct"}
    return replace(through, options=options, notes=(*joint.notes, *through.notes))


def _points(recordings: Sequence[Recording]) -> FloatArray:
    """Operating points of the recordings, (n, 2)."""
    for recording in recordings:
        if not set(SCHEDULING) <= set(recording.conditions):
            raise DataError(f"recording {recording.name!r} states no pressure_bar and speed_rpm; surfaces need both")
    return np.array([[float(recording.conditions[key]) for key in SCHEDULING] for recording in recordings])


def lpv_of(
    result: FitResult,
    *,
    actuators: Mapping[str, float] | None = None,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit:
    """Return the fit of a scheduled structure as an LPV fit in bar and rpm, for tuning, figures and reports.

    Parameters
    ----------
    result : FitResult
        Fit of ``gbid.scheduled(...)`` with the fourteen key parameters over pressure_bar and speed_rpm.
    actuators : dict of str to float, optional
        Actuators of the model; by default those of the fit of a `Plant`.
    name, title, source : str
        Texts for the model.

    Returns
    -------
    LPVFit
        Coefficients in bar and rpm with their covariance. There are no estimates of single recordings and no scatter
        between them.

    Raises
    ------
    UsageError
        When the fit is of another structure, or did not converge.
    """
    schedule = result.schedule
    if schedule is None:
        raise UsageError(
            f"the fit of {result.structure!r} has constant parameters; surfaces through several fits: gbid.fit_lpv"
        )
    if schedule.variables != SCHEDULING or schedule.surfaces != KEY_PARAMETERS:
        raise UsageError(
            f"the fit has {', '.join(schedule.surfaces)} over {', '.join(schedule.variables)}; an LPV model of a gas "
            f"bearing has the fourteen key parameters over {', '.join(SCHEDULING)}"
        )
    if not result.success:
        raise UsageError(f"the fit did not converge ({result.status}); its surfaces cannot be used")
    return _surfaces_of(result, actuators, name, title, source)


def _surfaces_of(
    result: FitResult, actuators: Mapping[str, float] | None, name: str, title: str, source: str
) -> LPVFit:
    """Surfaces over pressure and speed from a fit of any status; see `lpv_of`."""
    schedule = result.schedule
    assert schedule is not None
    to_terms = in_terms(schedule.to_own_units, schedule.exponents)
    names = [name for key in KEY_PARAMETERS for name in schedule.names(key)]
    scaled = np.array([result.parameters[name] for name in names]).reshape(len(KEY_PARAMETERS), -1)
    known = set(ACTUATOR_PARAMETERS) <= set(result.parameters)  # not those of PiezoPair(poles="any")
    fitted = {key: result.parameters[key] for key in ACTUATOR_PARAMETERS} if known else {}
    model = LPVModel(
        name,
        dict(zip(KEY_PARAMETERS, map(tuple, (scaled @ to_terms.T).tolist()), strict=True)),
        Domain(*zip(schedule.low, schedule.high, strict=True)),
        actuators=fitted if actuators is None else actuators,
        pade_order=schedule.pade_order,
        title=title,
        source=source,
    )
    k = len(KEY_PARAMETERS)
    return LPVFit(
        model,
        in_units_of_terms(covariance_of(result, names), to_terms),
        np.zeros((k, k)),
        Estimates((), np.zeros((0, 2)), np.zeros((0, k)), np.zeros((0, k, k))),
        options={
            "method": "scheduled",
            "structure": result.structure,
            "focus": result.options.focus,
            "recordings": str(len(result.recordings)),
            "pieces": str(schedule.pieces),
        },
        status=result.status,
        notes=result.notes,
    )
