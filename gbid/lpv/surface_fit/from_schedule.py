"""Surfaces of a gas bearing from the fit of a scheduled structure (paper, Eqs. 16 to 18)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.result import FitResult
from gbid.lpv.basis import EXPONENTS, SCHEDULING, TERMS
from gbid.lpv.domain import Domain
from gbid.lpv.model import ACTUATOR_PARAMETERS, LPVModel
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.lpv_fit import LPVFit
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduling.schedule import Schedule


def lpv_of(
    result: FitResult,
    *,
    actuators: Mapping[str, float] | None = None,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit:
    """Return the surfaces that the fit of a scheduled structure found, for tuning, figures and reports.

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
    schedule = result.options.schedule
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
    coefficients, covariance = _in_bar_and_rpm(result, schedule)
    found = {key: result.parameters[key] for key in ACTUATOR_PARAMETERS if key in result.parameters}
    model = LPVModel(
        name,
        {key: tuple(row) for key, row in zip(KEY_PARAMETERS, coefficients.tolist(), strict=True)},
        Domain(*((low, high) for low, high in zip(schedule.low, schedule.high, strict=True))),
        actuators=found if actuators is None else actuators,
        pade_order=schedule.pade_order,
        title=title,
        source=source,
    )
    k = len(KEY_PARAMETERS)
    return LPVFit(
        model,
        covariance,
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


def _in_bar_and_rpm(result: FitResult, schedule: Schedule) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of the six terms, (14, 6), and their covariance, (84, 84)."""
    k, m = len(KEY_PARAMETERS), len(TERMS)
    places = [EXPONENTS.index((e[0], e[1])) for e in schedule.exponents]
    onto = np.zeros((m, len(schedule.exponents)))
    onto[places] = schedule.to_own_units
    names = [schedule.names(key) for key in KEY_PARAMETERS]
    scaled = np.array([[result.parameters[name] for name in row] for row in names])
    free = {name: i for i, name in enumerate(result.free)}
    among = np.array([free.get(name, -1) for row in names for name in row])
    covariance = np.where((among[:, None] >= 0) & (among >= 0), result.covariance[np.ix_(among, among)], 0.0)
    every = np.kron(np.eye(k), onto)
    return scaled @ onto.T, every @ covariance @ every.T
