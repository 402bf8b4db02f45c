"""Identified stiffness and damping of a bearing as a bearing element of ROSS."""

from __future__ import annotations

from math import isfinite, pi
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.errors import UsageError
from gbid.identify import FitResult
from gbid.interchange.ross.ross_package import ross_package
from gbid.lpv import LPVModel

_N_SPEEDS = 25


def bearing_element(
    what: LPVModel | FitResult,
    node: int,
    *,
    mass_kg: float,
    pressure_bar: float | None = None,
    speed_rpm: npt.ArrayLike | None = None,
    tag: str | None = None,
) -> Any:
    r"""Return the identified bearing as a bearing element of ROSS, over speed where the model has surfaces.

    Parameters
    ----------
    what : LPVModel or FitResult
        Surfaces over pressure and speed, or a fit of `gbid.RotorBearing` at one operating point.
    node : int
        Node of the rotor.
    mass_kg : float
        Modal mass by which the coefficients of the model are multiplied [kg]; the model is per unit mass.
    pressure_bar : float, optional
        Injection pressure [bar]; required for surfaces.
    speed_rpm : (n,) array, optional
        Speeds of the element [rpm]; by default 25 speeds over the domain of the surfaces.
    tag : str, optional
        Tag of the element.

    Returns
    -------
    ross.BearingElement
        With stiffness [N/m] and damping [N s/m], and `frequency` the speeds [rad/s].

    Raises
    ------
    UsageError
        When ROSS is not installed, when the mass is not positive, when a point lies outside the domain, or when the
        fit has no bearing.

    Notes
    -----
    gbid writes :math:`\ddot p = K p + D \dot p` per unit mass; ROSS writes the force of a bearing on the rotor as
    :math:`-k\,q - c\,\dot q`. So :math:`k = -m K` and :math:`c = -m D`, entry by entry with the same axes: x and y of
    the recordings are x and y of ROSS, and a positive speed turns from x to y. K holds everything that pulls the disc
    back, the elasticity of the shaft included. In a rotor with a flexible shaft the coefficients therefore describe
    the bearing alone only where it is much softer than the shaft.
    """
    if not (isfinite(mass_kg) and mass_kg > 0):
        raise UsageError(f"bearing element: mass_kg = {mass_kg}; give the modal mass, a positive number of kilograms")
    ross = ross_package("a bearing element of ROSS")
    if isinstance(what, LPVModel):
        if pressure_bar is None:
            raise UsageError(f"bearing element of model {what.name!r}: give pressure_bar")
        speeds = np.linspace(*what.domain.speed_rpm, _N_SPEEDS) if speed_rpm is None else np.atleast_1d(speed_rpm)
        values = what.key_parameters(float(pressure_bar), np.asarray(speeds, float))
        given = {key: np.broadcast_to(value, np.shape(speeds)) for key, value in values.items()}
        frequency = {"frequency": 2.0 * pi / 60.0 * np.asarray(speeds, float)} if np.size(speeds) > 1 else {}
    else:
        missing = [key for key in ("k_xx", "d_xx") if key not in what.parameters]
        if missing:
            raise UsageError(
                f"bearing element of fit {what.structure!r}: it has no {missing[0]}; give a fit of RotorBearing"
            )
        if speed_rpm is not None or pressure_bar is not None:
            raise UsageError(
                f"bearing element of fit {what.structure!r}: a fit holds at one operating point; leave it out"
            )
        given, frequency = {key: np.array([value]) for key, value in what.parameters.items()}, {}
    coefficients = {
        f"{ours}{pair}": (-mass_kg * given[f"{theirs}_{pair}"]).tolist()
        for ours, theirs in (("k", "k"), ("c", "d"))
        for pair in ("xx", "xy", "yx", "yy")
    }
    if not frequency:
        coefficients = {key: values[0] for key, values in coefficients.items()}
    return ross.BearingElement(n=node, tag=tag, **coefficients, **frequency)
