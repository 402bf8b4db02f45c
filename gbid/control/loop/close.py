"""Closed loop of a plant and a controller."""

from __future__ import annotations

import numpy as np

from gbid.errors import UsageError
from gbid.structure import LinearModel


def close_loop(plant: LinearModel, controller: LinearModel) -> LinearModel:
    """Return the closed loop with the sign of the paper, ``r = K p`` (Eqs. 21 and 22): positive feedback.

    The output of the controller is added to the input of the plant without a change of sign. So negative feedback
    needs a controller that contains the minus sign. For an external input w at the input of the plant,

    .. math:: p = G (w + K p) = (I - G K)^{-1} G w = S_o G w

    Parameters
    ----------
    plant : LinearModel
        G, from r to p.
    controller : LinearModel
        K, from p to r.

    Returns
    -------
    LinearModel
        ``S_o G``, from w to p; states of the plant, then of the controller. Disturbance gains (`K` of either
        model) are left out, because they describe prediction errors of a fit.

    Raises
    ------
    UsageError
        When sizes, channel names or sample times do not fit together, or when the loop is not well posed
        (``I - D_K D_G`` is singular).
    """
    _check_fit(plant, controller)
    n_r = plant.B.shape[1]
    direct = np.eye(n_r) - controller.D @ plant.D
    # the tolerance is relative to the terms that may cancel, not to their sum
    scale = 1.0 + float(np.abs(controller.D) @ np.abs(plant.D) @ np.ones(n_r) @ np.ones(n_r))
    if np.linalg.svd(direct, compute_uv=False)[-1] <= 1e-12 * scale:
        raise UsageError(
            f"loop of {plant.name!r} and {controller.name!r} is not well posed: I - D_K D_G is singular; "
            "give one of them no direct feedthrough, a low-pass for instance"
        )
    # r = M (w + C_K x_K + D_K C_G x_G) with M = (I - D_K D_G)^-1; this is [dr/dx, dr/dw]
    gains = np.linalg.solve(direct, np.hstack([controller.D @ plant.C, controller.C, np.eye(n_r)]))
    n = plant.n_states + controller.n_states
    r_x, r_w = gains[:, :n], gains[:, n:]
    p_x = np.hstack([plant.C, np.zeros((plant.C.shape[0], controller.n_states))]) + plant.D @ r_x
    p_w = plant.D @ r_w
    A = np.vstack([plant.B @ r_x, controller.B @ p_x])
    A[: plant.n_states, : plant.n_states] += plant.A
    A[plant.n_states :, plant.n_states :] += controller.A
    return LinearModel(
        A,
        np.vstack([plant.B @ r_w, controller.B @ p_w]),
        p_x,
        p_w,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=(*plant.state_names, *(f"{controller.name}.{s}" for s in controller.state_names)),
        name=f"{plant.name}, closed by {controller.name}",
    )


def _check_fit(plant: LinearModel, controller: LinearModel) -> None:
    """Refuse models that cannot form a loop."""
    where = f"loop of {plant.name!r} and {controller.name!r}"
    if plant.dt != controller.dt:
        kinds = ["continuous" if m.dt is None else f"sampled at {m.dt:g} s" for m in (plant, controller)]
        raise UsageError(f"{where}: the plant is {kinds[0]}, the controller {kinds[1]}; bring both to one time")
    for what, given, taken in (
        ("plant outputs to the controller", plant.output_names, controller.input_names),
        ("controller outputs to the plant", controller.output_names, plant.input_names),
    ):
        if len(given) != len(taken):
            raise UsageError(f"{where}: {len(given)} {what}, which takes {len(taken)} ({', '.join(taken)})")
        if given != taken and sorted(given) == sorted(taken):
            raise UsageError(f"{where}: {what} come in another order: {', '.join(given)} to {', '.join(taken)}")
