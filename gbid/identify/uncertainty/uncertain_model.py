"""Linear model with the covariance of its parameters, for figures with confidence bands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Protocol, runtime_checkable

import numpy as np

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.hdf5 import Stored
from gbid.structure import LinearModel


def _by_free(letter: str, shape: str) -> Stored:
    return Stored("", f"derivatives of {letter} by the free parameters", f"free {shape}")


@dataclass(frozen=True, eq=False)
class ModelSlopes(Brief):
    """Derivatives of a continuous-time model's matrices with respect to the free parameters of a fit.

    Attributes
    ----------
    A : (n_free, n, n) array
        Derivatives of the state matrix.
    B, B_delayed : (n_free, n, n_inputs) array
        Derivatives of the input matrices of prompt and delayed inputs.
    C : (n_free, n_outputs, n) array
        Derivatives of the output matrix.
    D : (n_free, n_outputs, n_inputs) array
        Derivatives of the feedthrough.
    delay : (n_free, n_inputs) array
        Derivatives of the input delays [s].
    K : (n_free, n, n_outputs) array or None
        Derivatives of the disturbance gain; None for a nonlinear structure and in a file of an earlier version.
    """

    A: Annotated[FloatArray, _by_free("A", "states states")]
    B: Annotated[FloatArray, _by_free("B", "states inputs")]
    C: Annotated[FloatArray, _by_free("C", "outputs states")]
    D: Annotated[FloatArray, _by_free("D", "outputs inputs")]
    B_delayed: Annotated[FloatArray, _by_free("B_delayed", "states inputs")]
    delay: Annotated[FloatArray, _by_free("the delays", "inputs")]
    K: Annotated[FloatArray | None, _by_free("K", "states outputs")] = None


@dataclass(frozen=True, eq=False)
class UncertainModel(Brief):
    """Linear model whose matrices depend on parameters with a covariance.

    Attributes
    ----------
    model : LinearModel
        The model at the estimates.
    slopes : ModelSlopes or None
        Derivatives of its matrices; None for a model without uncertainty.
    covariance : (n_free, n_free) array or None
        Covariance of the parameters.
    sample_time : float or None
        Time between the samples of the data of a fit [s]. Curves end at half their rate.
    units : dict of str to str
        Units of the channels by name, as far as they are known.
    """

    model: LinearModel
    slopes: ModelSlopes | None = None
    covariance: FloatArray | None = None
    sample_time: float | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    def known(self) -> tuple[ModelSlopes, FloatArray | None]:
        """Return derivatives and covariance; empty derivatives and None if either is missing or not finite."""
        if self.slopes is not None and self.covariance is not None and np.isfinite(self.covariance).all():
            return self.slopes, self.covariance
        n, (n_y, n_u) = self.model.n_states, self.model.D.shape
        shapes = (n, n), (n, n_u), (n_y, n), (n_y, n_u), (n, n_u), (n_u,)
        return ModelSlopes(*(np.zeros((0, *shape)) for shape in shapes)), None


@runtime_checkable
class HasUncertainModel(Protocol):
    """Protocol of a result with an uncertain model, such as `FitResult`."""

    @property
    def uncertain_model(self) -> UncertainModel:
        """Model at the estimates, with derivatives and covariance."""
        ...


ModelLike = LinearModel | UncertainModel | HasUncertainModel
"""Anything of which curves can be drawn: a `LinearModel`, a `FitResult`, or an `UncertainModel`."""


def as_uncertain(source: ModelLike) -> UncertainModel:
    """Return a source's model with its uncertainty; a plain model has no uncertainty.

    Parameters
    ----------
    source : LinearModel, FitResult or UncertainModel
        The source.

    Returns
    -------
    UncertainModel

    Raises
    ------
    UsageError
        For anything else.
    """
    if isinstance(source, UncertainModel):
        return source
    if isinstance(source, LinearModel):
        return UncertainModel(source)
    if isinstance(source, HasUncertainModel):
        return source.uncertain_model
    raise UsageError(f"{type(source).__name__} has no linear model; give a LinearModel or a FitResult")


def std_of(slopes: FloatArray, covariance: FloatArray | None) -> FloatArray:
    """Return standard deviations from derivatives (n_free, ...) and the parameter covariance; nan if unknown."""
    if covariance is None:
        return np.full(slopes.shape[1:], np.nan)
    flat = slopes.reshape(len(slopes), -1)
    variance = np.einsum("pi,pq,qi->i", flat, covariance, flat, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(slopes.shape[1:]))


def plane_covariance(slopes: ComplexArray, covariance: FloatArray | None) -> FloatArray:
    """Return covariances of real and imaginary part, (..., 2, 2), from complex derivatives (n_free, ...).

    `covariance` is that of the parameters.
    """
    shape = (*slopes.shape[1:], 2, 2)
    if covariance is None:
        return np.full(shape, np.nan)
    parts = np.stack([slopes.real, slopes.imag], axis=-1).reshape(len(slopes), -1, 2)
    return np.asarray(np.einsum("pia,pq,qib->iab", parts, covariance, parts, optimize=True).reshape(shape))
