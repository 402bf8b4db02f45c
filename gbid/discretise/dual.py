"""Dual matrices: matrices with their derivatives with respect to parameters (forward differentiation)."""

from __future__ import annotations

from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray


class Dual:
    """Matrix with its derivatives, for forward differentiation of the discretisation.

    A formula written for arrays gives value and derivatives when its arguments are duals. Operands may also be plain
    arrays or numbers; their derivatives are zero. Matrices at several points are one dual, whose arrays have an axis of
    points before those of the matrix.

    Parameters
    ----------
    value : (..., n, m) array
        The matrix.
    slope : (n_parameters, ..., n, m) array
        Derivative with respect to each parameter.
    """

    __slots__ = ("slope", "value")
    __array_ufunc__ = None  # makes numpy call the operators of this class when an array is on the left

    def __init__(self, value: FloatArray, slope: FloatArray) -> None:
        self.value = value
        self.slope = slope

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the matrix."""
        return self.value.shape[-2:]

    def __matmul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value @ other.value, _by_rows(self.slope, other.value) + self.value @ other.slope)
        return Dual(self.value @ other, _by_rows(self.slope, other))

    def __rmatmul__(self, other: FloatArray) -> Dual:
        return Dual(other @ self.value, other @ self.slope)

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.slope + other.slope)
        return Dual(self.value + other, self.slope)

    __radd__ = __add__

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __sub__(self, other: Any) -> Dual:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Dual:
        return self.__neg__().__add__(other)

    def __mul__(self, factor: Any) -> Dual:
        """Return the product with a number, or with a Dual of shape (1, 1) or (1, m) that scales the columns."""
        if isinstance(factor, Dual):
            return Dual(self.value * factor.value, self.slope * factor.value + self.value * factor.slope)
        return Dual(self.value * factor, self.slope * factor)

    __rmul__ = __mul__

    def __truediv__(self, number: float) -> Dual:
        return Dual(self.value / number, self.slope / number)

    def rows(self, index: slice | list[int]) -> Dual:
        """Return selected rows, as an array does with ``[index]``.

        Parameters
        ----------
        index : slice
            Rows of the value.
        """
        return Dual(self.value[..., index, :], self.slope[..., index, :])

    def columns(self, index: Any) -> Dual:
        """Return selected columns, as an array does with ``[:, index]``.

        Parameters
        ----------
        index : int, slice or array of int
            Columns of the value.
        """
        return Dual(self.value[..., index], self.slope[..., index])


def _by_rows(slope: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return ``slope @ matrix``; for a single matrix as one product of all rows, three times as fast."""
    if slope.ndim > 3 or matrix.ndim > 2:
        return slope @ matrix
    n_p, n, m = slope.shape
    return (slope.reshape(n_p * n, m) @ matrix).reshape(n_p, n, matrix.shape[-1])


def constant(value: FloatArray, n_parameters: int) -> Dual:
    """Return a Dual whose derivatives are zero."""
    return Dual(value, np.zeros((n_parameters, *value.shape)))


def side_by_side(parts: list[Dual]) -> Dual:
    """Return Duals joined column by column; a matrix without an axis of points is repeated at all points."""
    points = max((part.value.shape[:-2] for part in parts), key=len)
    parts = [part if part.value.shape[:-2] == points else at_points(part, points) for part in parts]
    return Dual(
        np.concatenate([part.value for part in parts], axis=-1), np.concatenate([part.slope for part in parts], axis=-1)
    )


def at_points(part: Dual, points: tuple[int, ...]) -> Dual:
    """Return a Dual repeated at all points; `points` is the shape of the points."""
    value, slope = part.value, part.slope
    return Dual(
        np.broadcast_to(value, (*points, *value.shape)),
        np.broadcast_to(slope[:, None], (len(slope), *points, *value.shape)),
    )
