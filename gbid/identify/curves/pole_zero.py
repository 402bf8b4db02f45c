"""Poles and zeros of a model with their covariances, propagated from that of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, sqrt
from typing import Any

import numpy as np
from scipy.linalg import eig

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief, Description, brief
from gbid.identify.curves.bode import LEVEL, quantile
from gbid.identify.curves.uncertain_model import ModelLike, ModelSlopes, as_uncertain
from gbid.structure import LinearModel
from gbid.tables.table import Column, Entry, Table

_FAR = 1e6  # smallest size of a zero, relative to the fastest pole, that counts as infinite


@dataclass(frozen=True, eq=False)
class PoleZero(Brief):
    """Poles and zeros of a model in continuous time.

    Attributes
    ----------
    poles : (n_poles,) complex array
        Poles [rad/s], by rising magnitude.
    pole_covariance : (n_poles, 2, 2) array
        Covariance of real and imaginary part; nan for a model without uncertainty.
    zeros : (n_zeros,) complex array
        Transmission zeros [rad/s]. Empty for a model with different numbers of inputs and outputs, and where an input
        acts both with and without a delay.
    zero_covariance : (n_zeros, 2, 2) array
        The same for the zeros.
    name : str
        Name of the model.
    """

    poles: ComplexArray
    pole_covariance: FloatArray
    zeros: ComplexArray
    zero_covariance: FloatArray
    name: str

    def _brief(self) -> Description:
        return brief(self, f"{self.name}, {len(self.poles)} poles, {len(self.zeros)} zeros")

    @property
    def has_ellipses(self) -> bool:
        """Whether there are covariances."""
        return bool(np.isfinite(self.pole_covariance).any())

    def table(self) -> Table:
        """Return the numbers as a table, with a row for each pole and zero; for CSV."""
        rows: list[list[Entry]] = []
        for kind, places, spread in (
            ("pole", self.poles, self.pole_covariance),
            ("zero", self.zeros, self.zero_covariance),
        ):
            for s, cov in zip(places, spread, strict=True):
                std_re, std_im = np.sqrt(np.diag(cov)).tolist()
                size = float(abs(s))
                damping = -float(s.real) / size if size else None
                rows.append([kind, float(s.real), std_re, float(s.imag), std_im, size / (2 * np.pi), damping])
        names = ("real", "real_std", "imaginary", "imaginary_std", "frequency_hz", "damping")
        return Table(f"poles and zeros of {self.name}", [Column("kind"), *(Column(n, format=6) for n in names)], rows)

    def to_frame(self) -> Any:
        """Return the table as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return self.table().to_frame()


def pole_zero(source: ModelLike) -> PoleZero:
    """Return poles and zeros of a model with their covariances.

    Parameters
    ----------
    source : LinearModel, FitResult or UncertainModel
        The model. Those of a discrete model are converted to continuous time.

    Returns
    -------
    PoleZero

    Notes
    -----
    Both are eigenvalues of a pencil ``M - lambda N``: of the poles ``A - lambda I``, of the zeros the system matrix
    ``[A - lambda I, B; C, D]``. With left and right eigenvectors w and v, ``d lambda = w' dM v / (w' N v)``. Where two
    poles almost coincide, the derivatives are very large and an ellipse is not a good picture of the uncertainty.
    """
    uncertain = as_uncertain(source)
    model = uncertain.model
    known = uncertain.known()
    rate = max(float(np.abs(np.linalg.eigvals(model.A)).max(initial=0.0)), 1e-300)
    poles, pole_slopes = _pencil(model.A, np.eye(model.n_states), rate, None if known is None else known[0].A)
    system = _zero_pencil(model, None if known is None else known[0])
    none: tuple[ComplexArray, ComplexArray | None] = (np.zeros(0, complex), None)
    zeros, zero_slopes = none if system is None else _pencil(system[0], system[1], rate, system[2])
    if model.dt is not None:
        with np.errstate(divide="ignore"):
            poles, zeros = (np.asarray(np.log(each) / model.dt, complex) for each in (poles, zeros))
    covariance = None if known is None else known[1]
    return PoleZero(
        poles=poles,
        pole_covariance=_spread(poles, pole_slopes, covariance),
        zeros=zeros,
        zero_covariance=_spread(zeros, zero_slopes, covariance),
        name=model.name,
    )


def ellipse(covariance: FloatArray, level: float = LEVEL, n: int = 60) -> FloatArray:
    """Return points on the edge of the confidence region of two normal variables about zero.

    Parameters
    ----------
    covariance : (2, 2) array
        Their covariance; singular for a segment of a line.
    level : float
        Probability of the region.
    n : int
        Number of points.

    Returns
    -------
    (n, 2) array
        Points of the closed edge.
    """
    own, axes = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, n)
    single = own[0] <= 1e-9 * own[1]  # one variable only, as for a real pole
    radius = quantile(level) if single else sqrt(-2 * log(1 - level))
    return np.asarray(radius * np.column_stack([np.cos(angle), np.sin(angle)]) * np.sqrt(np.maximum(own, 0)) @ axes.T)


def _pencil(
    M: FloatArray, N: FloatArray, rate: float, dM: FloatArray | None
) -> tuple[ComplexArray, ComplexArray | None]:
    """Return the finite eigenvalues by rising magnitude, and their derivatives (n_free, n)."""
    found: tuple[ComplexArray, ComplexArray, ComplexArray] = eig(M / rate, N, left=True, right=True)
    values, left, right = found
    keep = np.flatnonzero(np.isfinite(values) & (np.abs(values) < _FAR))
    keep = keep[np.lexsort((values[keep].imag, np.abs(values[keep])))]
    values, left, right = values[keep] * rate, left[:, keep].conj(), right[:, keep]
    if dM is None:
        return values, None
    size = np.einsum("ni,nm,mi->i", left, N, right)
    with np.errstate(divide="ignore", invalid="ignore"):
        return values, np.einsum("ni,pnm,mi->pi", left, dM, right, optimize=True) / size


def _zero_pencil(
    model: LinearModel, slopes: ModelSlopes | None
) -> tuple[FloatArray, FloatArray, FloatArray | None] | None:
    """Return the pencil M, N of the zeros and the derivatives of M; None where there are no zeros to be had."""
    n_y, n_u = model.D.shape
    prompt = model.B.any(axis=0) | model.D.any(axis=0)
    late = np.zeros(n_u, bool) if model.B_delayed is None else model.B_delayed.any(axis=0)
    if n_y != n_u or not n_u or (prompt & late).any():
        return None
    B = model.B if model.B_delayed is None else model.B + model.B_delayed
    M = np.block([[model.A, B], [model.C, model.D]])
    # Columns and rows of about one size: the zeros do not depend on the units of inputs and outputs.
    size = max(float(np.abs(model.A).max(initial=0.0)), 1e-300)
    columns, rows = np.ones(len(M)), np.ones(len(M))
    columns[model.n_states :] = size / _sizes(np.vstack([B, model.D]), 0)
    rows[model.n_states :] = size / _sizes(np.hstack([model.C, model.D]), 1)
    scale = np.outer(rows, columns)
    N = np.diag([1.0] * model.n_states + [0.0] * n_u)
    if slopes is None:
        return M * scale, N, None
    upper = np.concatenate([slopes.A, slopes.B + slopes.B_delayed], axis=2)
    return M * scale, N, np.concatenate([upper, np.concatenate([slopes.C, slopes.D], axis=2)], axis=1) * scale


def _sizes(matrix: FloatArray, axis: int) -> FloatArray:
    size = np.linalg.norm(matrix, axis=axis)
    return np.asarray(np.where(size > 0, size, 1.0))


def _spread(places: ComplexArray, slopes: ComplexArray | None, covariance: FloatArray | None) -> FloatArray:
    if slopes is None or covariance is None:
        return np.full((len(places), 2, 2), np.nan)
    parts = np.stack([slopes.real, slopes.imag], axis=-1)
    return np.asarray(np.einsum("pia,pq,qib->iab", parts, covariance, parts, optimize=True))
