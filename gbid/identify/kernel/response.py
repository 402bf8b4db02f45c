"""Kernel of frequency responses: weighted errors of a linear structure, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from gbid.identify.frequency_data import FrequencyData
from gbid.identify.predictor import Predictor, matrices_with_slopes
from gbid.identify.uncertainty.curves import response_slopes
from gbid.identify.uncertainty.uncertain_model import ModelSlopes
from gbid.structure import LinearModel


class LikelihoodSums(NamedTuple):
    """Negative log-likelihood up to a constant, with gradient and Gauss-Newton Hessian."""

    cost: float
    gradient: FloatArray
    hessian: FloatArray


@dataclass(frozen=True, eq=False)
class ResponseGroup:
    """Frequency response as a part of a problem: without samples and windows, with known standard deviations.

    The cost is ``sum |G(f) - G_measured(f)|^2 / (2 std^2)`` over real and imaginary parts: the likelihood (Pintelon and
    Schoukens, System Identification, 2012, Sec. 9.11). Delays are exact. The errors of neighbours that a spectral
    window correlates count as fewer.

    Attributes
    ----------
    data : FrequencyData
        The responses, with the channels of the structure.
    predictor : Predictor
        The structure with its free parameters.
    index : (n_p,) integer array
        Positions of the predictor's parameters in those of the problem.
    relative : float
        Further standard deviation as a part of each response; with some of it the errors of a start far off say more.
    """

    data: FrequencyData
    predictor: Predictor
    index: IntArray
    relative: float = 0.0

    @property
    def weight(self) -> float:
        """Share of independent responses: errors at neighbouring frequencies are correlated."""
        return 1 / (1 + 2 * sum(self.data.correlation))

    @property
    def measured(self) -> BoolArray:
        """Which responses were measured, (n, n_outputs, n_inputs)."""
        return np.isfinite(self.data.response) & np.isfinite(self.data.std) & (self.data.std > 0)

    @property
    def n_numbers(self) -> int:
        """Number of measured real and imaginary parts."""
        return 2 * int(self.measured.sum())

    def errors(self, theta: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return errors (n, n_outputs, n_inputs) and derivatives (n_p, ...); zero where not measured."""
        (A, B, C, D, _, B_delayed, delays), slopes, dt = matrices_with_slopes(self.predictor, theta[self.index])
        model = LinearModel(A.value, B.value, C.value, D.value, dt=dt)
        if self.predictor.delayed:
            delay = np.zeros(self.predictor.n_inputs)
            delay[list(self.predictor.delayed)] = delays.value[:, 0]
            model = replace(model, B_delayed=B_delayed.value, delay=delay)
        f, size = self.data.frequency_hz, np.abs(self.data.response)
        sigma = np.where(self.measured, np.hypot(self.data.std, self.relative * size), np.inf)
        error = (model.frequency_response(f) - np.nan_to_num(self.data.response)) / sigma
        return error, response_slopes(model, ModelSlopes(*slopes), f) / sigma

    def sums(self, theta: FloatArray) -> LikelihoodSums:
        """Return negative log-likelihood, gradient and Hessian with respect to the predictor's parameters."""
        error, changes = self.errors(theta)
        rows, slopes = (_as_rows(values, axes) for values, axes in ((error, 0), (changes, 1)))
        return LikelihoodSums(
            0.5 * self.weight * float(rows @ rows), self.weight * slopes @ rows, self.weight * slopes @ slopes.T
        )

    def score_products(self, theta: FloatArray) -> FloatArray:
        """Return the sum over frequencies of the outer products of gradients, (n_p, n_p).

        It contains what outputs have in common.
        """
        error, changes = self.errors(theta)
        scores = np.einsum("fyu,pfyu->fp", error.conj(), changes).real
        return np.asarray(self.weight * scores.T @ scores)


def _as_rows(values: ComplexArray, axes: int) -> FloatArray:
    """Return real parts followed by imaginary parts along the last axis; the first axes are kept."""
    flat = values.reshape(*values.shape[:axes], -1)
    return np.concatenate([flat.real, flat.imag], axis=-1)
