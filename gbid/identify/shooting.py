"""The multiple-shooting problem of a prediction-error fit, as numbers.

Unknowns are the free parameters and the state at the start of each window; the cost is the prediction error
of Eq. 15 (or the log-determinant of its covariance); constraints say that each window ends where the next
begins. All is scaled to the order of one; one pass over the samples serves cost, gradient, constraints,
Jacobian and Gauss-Newton Hessian of an iterate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.identify.blocks import Blocks
from gbid.identify.predictor import Predictor
from gbid.identify.sweep import residuals, sweep

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Criterion = Literal["trace", "det"]
_ROUNDING = 1e-13  # of the outputs' power


class Iterate(NamedTuple):
    """What a solver asks for at one point, in scaled units.

    Attributes
    ----------
    cost : float
    gradient : (n_unknowns,) array
    gaps : (n_gaps * n,) array
    jacobian : (n_nonzeros,) array
        Entries of the Jacobian of the gaps in column order, where `Shooting.jacobian_pattern` has them.
    hessian : (n_nonzeros,) array
        Entries of the upper triangle in column order, where `Shooting.hessian_pattern` has them.
    """

    cost: float
    gradient: FloatArray
    gaps: FloatArray
    jacobian: FloatArray
    hessian: FloatArray


class Pattern(NamedTuple):
    """Nonzeros of a sparse matrix in column order."""

    shape: tuple[int, int]
    rows: IntArray
    columns: IntArray


@dataclass(frozen=True, eq=False)
class Shooting:
    """A fit as a nonlinear programme.

    Attributes
    ----------
    predictor : Predictor
    blocks : Blocks
    criterion : {"trace", "det"}
    output_scale : float
        Total standard deviation of the outputs.
    theta_scale : (n_p,) array
    state_scale : (n,) array
    """

    predictor: Predictor
    blocks: Blocks
    criterion: Criterion
    output_scale: float
    theta_scale: FloatArray
    state_scale: FloatArray
    _last: dict[bytes, Iterate] = field(default_factory=dict)

    @property
    def n_theta(self) -> int:
        """Number of free parameters."""
        return len(self.theta_scale)

    @property
    def n_unknowns(self) -> int:
        """Free parameters and window starts."""
        return self.n_theta + self.blocks.n_windows * self.predictor.n_states

    @property
    def n_gaps(self) -> int:
        """Number of scalar gap constraints."""
        return len(self.blocks.linked) * self.predictor.n_states

    def pack(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Scale parameters (n_p,) and window starts (n_windows, n) into one vector of unknowns."""
        return np.concatenate([theta / self.theta_scale, (starts / self.state_scale).ravel()])

    def unpack(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return parameters (n_p,) and window starts (n_windows, n) in physical units."""
        theta = unknowns[: self.n_theta] * self.theta_scale
        starts = unknowns[self.n_theta :].reshape(self.blocks.n_windows, -1) * self.state_scale
        return theta, starts

    def weight(self, error_products: FloatArray) -> FloatArray:
        """Weight of the squared errors in gradient and Hessian of the cost, from ``sum e e'``."""
        n_y = len(error_products)
        if self.criterion == "trace":
            return np.eye(n_y) / (float(np.trace(error_products)) + self._floor)
        return np.asarray(np.linalg.inv(error_products + self._floor * np.eye(n_y)))

    def cost(self, error_products: FloatArray) -> float:
        """Half the logarithm of the trace or determinant of ``sum e e'``, in units of the outputs' power.

        The logarithm moves no optimum, and makes the solver's tolerance one relative to the errors that are left.
        """
        n_y = len(error_products)
        if self.criterion == "trace":
            return 0.5 * float(np.log((np.trace(error_products) + self._floor) / self._power))
        return 0.5 * float(np.linalg.slogdet((error_products + self._floor * np.eye(n_y)) / self._power)[1])

    @property
    def exact_cost(self) -> float:
        """Cost at or below which all errors are rounding, as for data that a model made without noise."""
        n_y = self.predictor.n_outputs
        return self.cost(np.eye(n_y) * self._floor / (n_y if self.criterion == "trace" else 1))

    @property
    def _power(self) -> float:
        return self.blocks.n_samples * self.output_scale**2

    @property
    def _floor(self) -> float:
        """Errors below rounding are no errors: keeps the logarithm finite for data without noise."""
        return _ROUNDING * self._power

    def at(self, unknowns: FloatArray) -> Iterate:
        """Evaluate at a point, or hand back the last evaluation when the point is the same."""
        key = unknowns.tobytes()
        if key not in self._last:
            iterate = self._evaluate(unknowns)
            self._last.clear()
            self._last[key] = iterate
        return self._last[key]

    def jacobian_pattern(self) -> Pattern:
        """Where the Jacobian of the gaps has entries: all of theta; each start in its own and the previous gap."""
        n, n_t, linked = self.predictor.n_states, self.n_theta, self.blocks.linked
        rows = [np.tile(np.arange(self.n_gaps), n_t)]
        columns = [np.repeat(np.arange(n_t), self.n_gaps)]
        gap_of = {int(window): i for i, window in enumerate(linked)}
        for window in range(self.blocks.n_windows):
            before, own = gap_of.get(window - 1), gap_of.get(window)
            for j in range(n):
                here = ([] if before is None else [before * n + j]) + (
                    [] if own is None else list(range(own * n, own * n + n))
                )
                rows.append(np.array(here, dtype=np.int64))
                columns.append(np.full(len(here), n_t + window * n + j))
        return Pattern((self.n_gaps, self.n_unknowns), np.concatenate(rows), np.concatenate(columns))

    def hessian_pattern(self) -> Pattern:
        """Where the upper triangle of the Hessian has entries: an arrow."""
        n, n_t = self.predictor.n_states, self.n_theta
        theta_rows = [np.arange(j + 1) for j in range(n_t)]
        rows, columns = list(theta_rows), [np.full(j + 1, j) for j in range(n_t)]
        for window in range(self.blocks.n_windows):
            first = n_t + window * n
            for j in range(n):
                rows.append(np.concatenate([np.arange(n_t), first + np.arange(j + 1)]))
                columns.append(np.full(n_t + j + 1, first + j))
        return Pattern((self.n_unknowns, self.n_unknowns), np.concatenate(rows), np.concatenate(columns))

    def _evaluate(self, unknowns: FloatArray) -> Iterate:
        with np.errstate(over="ignore", invalid="ignore"):  # a wild trial point gives inf: the solver steps back
            theta, starts = self.unpack(unknowns)
            values = self.predictor.at(theta)
            if self.criterion == "trace":  # the weight is a number: it can follow the pass
                unit = np.eye(self.predictor.n_outputs)
                s = sweep(values, self.blocks, starts, unit / self._power)
                factor = self._power / (float(np.trace(s.error_products)) + self._floor)
            else:
                error = residuals(values, self.blocks, starts)
                products = np.einsum("kyw,kzw->yz", error, error, optimize=True)
                if not np.isfinite(products).all():
                    return self._invalid()
                s, factor = sweep(values, self.blocks, starts, self.weight(products)), 1.0
            linked, n = self.blocks.linked, self.predictor.n_states
            gaps = (s.end[linked] - starts[linked + 1]) / self.state_scale
            t, x = self.theta_scale, self.state_scale
            hessian = s.hessian * (factor * np.outer(t, t))
            mixed = s.hessian_mixed * (factor * t[:, None] * x)
            start = s.hessian_start * (factor * np.outer(x, x))
            end_theta = s.end_theta[linked] / x[:, None] * t
            end_start = s.end_start[linked] / x[:, None] * x
            return Iterate(
                self.cost(s.error_products),
                np.concatenate([s.gradient * (factor * t), (s.gradient_start * (factor * x)).ravel()]),
                gaps.ravel(),
                np.concatenate([end_theta.reshape(-1, self.n_theta).T.ravel(), self._start_entries(end_start)]),
                np.concatenate([hessian.T[np.tril_indices(self.n_theta)], _arrow_entries(mixed, start, n)]),
            )

    def _start_entries(self, end_start: FloatArray) -> FloatArray:
        """Entries of the Jacobian with respect to the starts, in the pattern's order."""
        n = self.predictor.n_states
        gap_of = {int(window): i for i, window in enumerate(self.blocks.linked)}
        minus_one = np.full((n, 1), -1.0)
        parts = []
        for window in range(self.blocks.n_windows):
            before, own = gap_of.get(window - 1), gap_of.get(window)
            columns = [] if before is None else [minus_one]
            if own is not None:
                columns.append(end_start[own].T)
            if columns:
                parts.append(np.hstack(columns).ravel())
        return np.concatenate(parts) if parts else np.zeros(0)

    def _invalid(self) -> Iterate:
        n_jac, n_hess = len(self.jacobian_pattern().rows), len(self.hessian_pattern().rows)
        nan = np.nan
        return Iterate(
            nan,
            np.full(self.n_unknowns, nan),
            np.full(self.n_gaps, nan),
            np.full(n_jac, nan),
            np.full(n_hess, nan),
        )


def _arrow_entries(mixed: FloatArray, start: FloatArray, n: int) -> FloatArray:
    """Columns of the window starts: the parameters' rows, then the upper triangle of the window's own block."""
    by_column = np.concatenate([mixed.transpose(0, 2, 1), start.transpose(0, 2, 1)], axis=2)  # (W, n, n_p + n)
    n_p = mixed.shape[1]
    keep = np.concatenate([np.ones((n, n_p), bool), np.tri(n, dtype=bool)], axis=1)
    return np.asarray(by_column[:, keep].ravel())
