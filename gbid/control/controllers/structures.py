"""Controllers of fixed structure, built-in or user-defined, and their models for given gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from math import isfinite
from typing import Any

from gbid.control.controllers.built_in import PStructure, built_in_structures
from gbid.control.controllers.parts import INPUTS, NOT_OPTIONS, OUTPUTS, PerAxis
from gbid.core.errors import UsageError
from gbid.structure import LinearModel
from gbid.structure.linear import Structure, model_function

# ---- Proportional controller as a linear model, from the disc position p to the piezo reference r.


def p_controller(kappa_x: float, kappa_y: float, lowpass_hz: float = 1000.0, order: int = 1) -> LinearModel:
    r"""Return a decentralised proportional controller with low-pass (paper, Eq. 21).

    .. math:: K_{pl}(s) = \mathrm{diag}(\kappa_x, \kappa_y) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    Parameters
    ----------
    kappa_x, kappa_y : float
        Gains [m/m]. Positive gains are positive feedback (see `gbid.control.close_loop`), as in the paper.
    lowpass_hz : float
        Corner frequency of the low-pass [Hz]; ``p_lp = 2 pi lowpass_hz`` in rad/s.
    order : int
        Order n of the low-pass; 0 for none.

    Returns
    -------
    LinearModel
        Continuous; inputs p_x, p_y, outputs r_x, r_y [m]; n states per axis.

    Raises
    ------
    UsageError
        When gains are not finite, the corner frequency is not positive, or the order is negative.
    """
    structure = PStructure(lowpass_hz, order)
    model = controller_model(structure, {"kappa_x": kappa_x, "kappa_y": kappa_y})
    states = tuple(f"lowpass{i + 1}_{axis}" for axis in structure.axes for i in range(order))
    return replace(model, state_names=states, name="p_controller")


def controller_structure(kind: str | Structure, **options: Any) -> Structure:
    """Return the structure of a controller from the disc position p to the piezo reference r.

    Parameters
    ----------
    kind : str or Structure
        A built-in structure with one filter per axis, ``"P"``, ``"PD"``, ``"PI"``, ``"PID"``, ``"biquad"``,
        ``"filter"`` (any order), ``"lead-lag"``, ``"notch"``, ``"PPF"``, ``"observer"``, ``"resonant"``; one with
        cross-coupling, ``"full P"``, ``"full PD"``, ``"full biquad"``; or your own: a `gbid.LinearStructure` with its
        gains as parameters, two inputs and two outputs.
    **options
        Options of a built-in structure: ``lowpass_hz``, ``order``, ``tune_corner``, ``axes`` and bounds. The table of
        structures is in the documentation (control).

    Returns
    -------
    Structure
        It has `parameters` (the gains, with start values and bounds) and symbolic `matrices`.

    Raises
    ------
    UsageError
        When a kind or option is unknown, when options are given with your own structure, or when bounds do not fit.

    Notes
    -----
    The loop is closed as ``r = K p`` (Eq. 21): positive gains are positive feedback.
    """
    built_in = built_in_structures()
    choices = ", ".join(map(repr, built_in))
    if not isinstance(kind, str):
        if not isinstance(kind, Structure):
            raise UsageError(f"controller = {kind!r}; choose {choices} or give a structure")
        if options:
            raise UsageError(f"controller {kind.name!r}: options {', '.join(options)} belong to built-in structures")
        return kind
    if kind not in built_in:
        raise UsageError(f"controller = {kind!r}; choose {choices} or give a structure")
    known = [name for name in built_in[kind].__dataclass_fields__ if name not in NOT_OPTIONS]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise UsageError(f"controller {kind!r}: unknown option {', '.join(unknown)}; there are {', '.join(known)}")
    return built_in[kind](**options)


@lru_cache(maxsize=16)
def _of_built_in(structure: PerAxis) -> Callable[..., LinearModel]:
    """Return the models of a structure for gains; they are kept, because maps ask for many."""
    return model_function(structure)


def controller_model(structure: Structure, gains: Mapping[str, float]) -> LinearModel:
    """Return the model of a controller structure for given gains.

    Parameters
    ----------
    structure : Structure
        Structure of the controller.
    gains : dict of str to float
        A value for every parameter.

    Returns
    -------
    LinearModel
        Continuous; inputs p_x, p_y, outputs r_x, r_y [m], or those of other axes.

    Raises
    ------
    UsageError
        When a gain is missing, unknown or not finite, or when the structure does not have two inputs and two outputs.
    """
    names = [parameter.name for parameter in structure.parameters]
    unknown = [name for name in gains if name not in names]
    if unknown:
        raise UsageError(f"controller {structure.name!r}: no gain {', '.join(unknown)}; there are {', '.join(names)}")
    for name in names:
        if name in gains and not isfinite(gains[name]):
            raise UsageError(f"controller {structure.name!r}: {name} = {gains[name]}; give a finite number")
    model_of = _of_built_in(structure) if isinstance(structure, PerAxis) else model_function(structure)
    return model_of(gains, *channels_of(structure))


def channels_of(structure: Structure) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of inputs and outputs of a controller: those of its axes, or of x and y for your own."""
    return (structure.inputs, structure.outputs) if isinstance(structure, PerAxis) else (INPUTS, OUTPUTS)
