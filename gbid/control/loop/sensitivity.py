"""Sensitivities of a loop (Eq. 22), their frequency responses and peaks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, nan
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief, Description, brief
from gbid.control.loop.close import close_loop
from gbid.control.loop.norm import Peak, largest_singular_values, peak_gain, refine_maxima
from gbid.errors import UsageError
from gbid.extras import Pictured
from gbid.structure import LinearModel, frequency_grid, with_pade

Which = Literal["output", "input", "control", "plant", "complementary"]
STABILITY_PADE_ORDER = 6
"""Order of the Pade delays for the stability test of a loop with exact delays."""


@dataclass(frozen=True, eq=False)
class Sensitivities(Brief, Pictured):
    r"""Sensitivities of a loop ``r = K p`` (Eq. 21) to disturbances.

    d is added to the measured position p, and w to the reference r:

    ================== =========================================== =================================
    name               transfer matrix                             from, to
    ================== =========================================== =================================
    ``output``         :math:`S_o = (I - G K)^{-1}` (Eq. 22)        d to p
    ``input``          :math:`S_i = (I - K G)^{-1}`                 w to r
    ``control``        :math:`K S_o`                               d to r: the effort
    ``plant``          :math:`S_o G`                               w to p
    ``complementary``  :math:`T_o = I - S_o = -G K S_o`            d to p, so that S_o + T_o = I
    ================== =========================================== =================================

    Parameters
    ----------
    plant, controller : LinearModel
        G and K, both continuous or both sampled; the plant may have exact delays.
    """

    plant: LinearModel
    controller: LinearModel

    def __post_init__(self) -> None:
        assert self._loop is not None  # raises an error when the models do not form a loop

    def _brief(self) -> Description:
        return brief(self, "", plant=self.plant.summary, controller=self.controller.summary)

    @property
    def has_delay(self) -> bool:
        """Whether the plant has exact delays; then there are frequency responses, but no state-space model."""
        return self.plant.delay is not None

    def is_stable(self) -> bool:
        """Return whether the loop is stable; exact delays become Pade delays of order `STABILITY_PADE_ORDER`."""
        return bool(self._loop.is_stable())

    def model(self, which: Which) -> LinearModel:
        """Return the state-space model of one of the sensitivities; all of them have the same A.

        Parameters
        ----------
        which : {"output", "input", "control", "plant", "complementary"}
            Name of the sensitivity.

        Returns
        -------
        LinearModel

        Raises
        ------
        UsageError
            When the name is unknown, or when the plant has exact delays (replace them first with `gbid.with_pade`).
        """
        _check_which(which)
        if self.has_delay:
            raise UsageError(
                f"loop of {self.plant.name!r} has exact delays: use response() and peak(), or with_pade(plant, order)"
            )
        return self._part(which)

    def response(self, which: Which, frequency_hz: npt.ArrayLike) -> ComplexArray:
        """Return a frequency response, with exact delays.

        Parameters
        ----------
        which : {"output", "input", "control", "plant", "complementary"}
            Name of the sensitivity.
        frequency_hz : (n_frequencies,) array
            Frequencies [Hz].

        Returns
        -------
        (n_frequencies, n_outputs, n_inputs) array
            Frequency response.

        Raises
        ------
        UsageError
            When the name is unknown, or when frequencies are not finite.
        """
        _check_which(which)
        beside = self._beside_integrators(np.atleast_1d(np.asarray(frequency_hz, float)))
        G, K = self.plant.frequency_response(beside), self.controller.frequency_response(beside)
        return _combine(which, G, K)

    def _beside_integrators(self, frequency_hz: FloatArray) -> FloatArray:
        """Return frequencies, just above zero where plant or controller integrate: the loop has a limit there."""
        at_rest = frequency_hz == 0
        if not at_rest.any() or not any(_integrates(model) for model in (self.plant, self.controller)):
            return frequency_hz
        moving = np.abs(self.poles)
        return np.where(at_rest, 1e-9 * float(moving[moving > 0].min(initial=1e3)) / (2 * np.pi), frequency_hz)

    def peak(self, which: Which = "output", tolerance: float = 1e-8) -> Peak:
        """Return the largest singular value over all frequencies.

        Parameters
        ----------
        which : {"output", "input", "control", "plant", "complementary"}
            Name of the sensitivity.
        tolerance : float
            Relative tolerance, for a loop without exact delays.

        Returns
        -------
        Peak
            Exact (see `gbid.control.peak_gain`) without exact delays. With exact delays it comes from a grid that is
            dense around the modes of the loop and refined around its maxima. Infinite when the loop is not stable.

        Raises
        ------
        UsageError
            When the name is unknown.
        """
        _check_which(which)
        if not self.has_delay:
            return peak_gain(self._part(which), tolerance)
        if not self.is_stable():
            return Peak(inf, nan)
        value, place = refine_maxima(
            lambda f: largest_singular_values(self.response(which, f)), frequency_grid(self._loop), rounds=6
        )
        return Peak(value, place)

    def grid(self, n: int = 400) -> FloatArray:
        """Return frequencies [Hz] adapted to the modes of the loop; see `frequency_grid`.

        Parameters
        ----------
        n : int
            Approximate number of frequencies.
        """
        return frequency_grid(self._loop, n)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the loop [rad/s]; exact delays are replaced by Pade filters."""
        return self._loop.poles()

    @cached_property
    def _loop(self) -> LinearModel:
        plant = with_pade(self.plant, STABILITY_PADE_ORDER) if self.has_delay else self.plant
        return _gang(plant, self.controller)

    def _part(self, which: Which) -> LinearModel:
        """Return one sensitivity from the whole loop, whose inputs are (w, d) and outputs (p, r)."""
        n_r, n_p = self.plant.B.shape[1], self.plant.C.shape[0]
        w, d, p, r = slice(0, n_r), slice(n_r, None), slice(0, n_p), slice(n_p, None)
        rows, columns = {"output": (p, d), "input": (r, w), "control": (r, d), "plant": (p, w)}.get(which, (p, d))
        loop = self._loop
        C, D = loop.C[rows], loop.D[rows, columns]
        if which == "complementary":
            C, D = -C, np.eye(n_p) - D
        return replace(
            loop,
            B=loop.B[:, columns],
            C=C,
            D=D,
            name=f"{which} sensitivity, {loop.name}",
            input_names=tuple(loop.input_names[columns]),
            output_names=tuple(loop.output_names[rows]),
        )


def sensitivities(plant: LinearModel, controller: LinearModel) -> Sensitivities:
    """Return the sensitivities of a loop ``r = K p`` (Eqs. 21, 22).

    Parameters
    ----------
    plant : LinearModel
        G, from r to p; may have exact delays.
    controller : LinearModel
        K, from p to r.

    Returns
    -------
    Sensitivities
        Models, frequency responses and peaks of S_o, S_i, K S_o, S_o G and I - S_o.

    Raises
    ------
    UsageError
        When the two do not form a loop (as for `gbid.close_loop`).

    Examples
    --------
    >>> import gbid
    >>> from gbid.control import p_controller
    >>> loop = gbid.sensitivities(gbid.load_model("theisen2016").plant_at(6, 0), p_controller(1.125, 0.99))
    >>> round(loop.peak("output").value, 3)
    2.283
    """
    return Sensitivities(plant, controller)


def _combine(which: Which, G: ComplexArray, K: ComplexArray) -> ComplexArray:
    n_p, n_r = G.shape[-2:]
    if which == "input":
        return np.asarray(np.linalg.inv(np.eye(n_r) - K @ G))
    S = np.linalg.inv(np.eye(n_p) - G @ K)
    if which == "control":
        return np.asarray(K @ S)
    if which == "plant":
        return np.asarray(S @ G)
    return np.asarray(np.eye(n_p) - S if which == "complementary" else S)


def _gang(plant: LinearModel, controller: LinearModel) -> LinearModel:
    """Return the closed loop from (w, d), added to r and to p, to (p, r).

    The disturbance d enters through a part of the plant without dynamics, so that `close_loop` can be used. The
    extended plant has the inputs (r, d) and the outputs (p, r). The extended controller uses p and has no output to
    d.
    """
    n_r, n_p = plant.B.shape[1], plant.C.shape[0]
    close_loop(plant, controller)  # names, sample times and well-posedness of the loop itself
    wide = replace(
        plant,
        B=np.hstack([plant.B, np.zeros((plant.n_states, n_p))]),
        C=np.vstack([plant.C, np.zeros((n_r, plant.n_states))]),
        D=np.block([[plant.D, np.eye(n_p)], [np.eye(n_r), np.zeros((n_r, n_p))]]),
        K=None,
        input_names=(*plant.input_names, *(f"d_{name}" for name in plant.output_names)),
        output_names=(*plant.output_names, *plant.input_names),
    )
    feedback = replace(
        controller,
        B=np.hstack([controller.B, np.zeros((controller.n_states, n_r))]),
        C=np.vstack([controller.C, np.zeros((n_p, controller.n_states))]),
        D=np.block([[controller.D, np.zeros((n_r, n_r))], [np.zeros((n_p, n_p + n_r))]]),
        K=None,
        input_names=wide.output_names,
        output_names=wide.input_names,
    )
    return replace(close_loop(wide, feedback), name=f"{plant.name}, closed by {controller.name}")


def _check_which(which: str) -> None:
    if which not in get_args(Which):
        raise UsageError(f"sensitivity {which!r}; choose {', '.join(map(repr, get_args(Which)))}")


def _integrates(model: LinearModel) -> bool:
    at_rest = 0.0 if model.dt is None else 1.0
    return bool(
        (
            np.abs(np.linalg.eigvals(model.A) - at_rest) <= 1e-12 * max(1.0, float(np.abs(model.A).max(initial=0.0)))
        ).any()
    )
