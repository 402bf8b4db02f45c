"""Protocol of a state-space model, for functions that need only its matrices and names."""

from __future__ import annotations

from typing import Protocol

from gbid.arrays import FloatArray


class StateSpace(Protocol):
    """Matrices and names of a `LinearModel`."""

    @property
    def A(self) -> FloatArray:
        """State matrix (n, n)."""
        ...

    @property
    def B(self) -> FloatArray:
        """Input matrix (n, n_inputs)."""
        ...

    @property
    def C(self) -> FloatArray:
        """Output matrix (n_outputs, n)."""
        ...

    @property
    def D(self) -> FloatArray:
        """Feedthrough (n_outputs, n_inputs)."""
        ...

    @property
    def K(self) -> FloatArray | None:
        """Disturbance gain (n, n_outputs)."""
        ...

    @property
    def dt(self) -> float | None:
        """Sample time [s]; None in continuous time."""
        ...

    @property
    def B_delayed(self) -> FloatArray | None:
        """Input matrix of delayed inputs (n, n_inputs)."""
        ...

    @property
    def delay(self) -> FloatArray | None:
        """Exact delays (n_inputs,) [s]."""
        ...

    @property
    def name(self) -> str:
        """Name of the model."""
        ...

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        ...

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        ...

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        ...
