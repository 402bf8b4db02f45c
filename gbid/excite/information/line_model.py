"""Responses and sensitivities of the predictions at spectral lines: the information of a periodic excitation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief
from gbid.excite.known_model import KnownModel
from gbid.identify.predictor import Predictor, PredictorValues, build_predictor

_NOISE_LINES = 2048  # of the integral over the frequencies of the noise's own information


class Lines(NamedTuple):
    """Model at spectral lines.

    Attributes
    ----------
    frequency_hz : (n_lines,) array
        Frequencies [Hz].
    response : (n_lines, n_outputs, n_inputs) array
        Frequency response from the sampled inputs to the sampled outputs, with their hold.
    sensitivity : (n_lines, n_free, n_outputs, n_inputs) array
        Derivatives of the predictions by the free parameters, by the input; for errors that are white with unit
        covariance.
    """

    frequency_hz: FloatArray
    response: ComplexArray
    sensitivity: ComplexArray

    def information(self, spectrum: ComplexArray, n_samples: int) -> FloatArray:
        """Return the information of a periodic excitation with these lines, (n_free, n_free).

        Parameters
        ----------
        spectrum : (n_lines, n_inputs) array
            Amplitude of each line: the input is ``Re sum U exp(j omega t)``.
        n_samples : int
            Length of the recording.
        """
        moved = np.einsum("fpyu,fu->pfy", self.sensitivity, spectrum).reshape(self.sensitivity.shape[1], -1)
        return np.asarray(n_samples / 2 * (moved @ moved.conj().T).real)


@dataclass(frozen=True, eq=False)
class LineModel(Brief):
    """Predictor of a known model, from which lines are computed.

    Attributes
    ----------
    known : KnownModel
        The model.
    predictor : Predictor
        Its predictor.
    """

    known: KnownModel
    predictor: Predictor

    @classmethod
    def of(cls, known: KnownModel, sample_time: float) -> LineModel:
        """Return the line model of a known model, sampled every `sample_time` [s]."""
        held = {name: float(known.parameters[name]) for name in known.fixed}
        return cls(known, build_predictor(known.structure, held, sample_time, known.intersample, known.focus))

    @property
    def sample_time(self) -> float:
        """Time between samples [s]."""
        return self.predictor.sample_time

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(q.name for q in self.predictor.free)

    @cached_property
    def theta(self) -> FloatArray:
        """Values of the free parameters, (n_free,)."""
        return np.array([float(self.known.parameters[name]) for name in self.free])

    @cached_property
    def _values(self) -> PredictorValues:
        return self.predictor.at(self.theta)

    @cached_property
    def _whiten(self) -> FloatArray:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.known.noise)), float)

    def at(self, frequency_hz: FloatArray) -> Lines:
        """Return responses and sensitivities at frequencies [Hz] below half the sampling frequency."""
        v, z = self._values, self._turns(frequency_hz)
        by_u, by_y = self._regressors(v, z)
        response = _response(v, z, by_u, by_y)
        slopes = _slopes(v, z, by_u if by_y is None else by_u + by_y @ response)
        return Lines(frequency_hz, response, np.einsum("ij,fpju->fpiu", self._whiten, slopes))

    def response(self, frequency_hz: FloatArray, parameters: dict[str, float] | None = None) -> ComplexArray:
        """Return the response alone, also for other parameters than those of the model."""
        known = {**self.known.parameters, **(parameters or {})}
        v = self.predictor.at(np.array([float(known[name]) for name in self.free])) if parameters else self._values
        z = self._turns(frequency_hz)
        return _response(v, z, *self._regressors(v, z))

    def noise_information(self, n_samples: int) -> FloatArray:
        """Return the information on the parameters that the errors themselves carry through the disturbance gain."""
        n_p = len(self.free)
        if not self.predictor.feeds_back:
            return np.zeros((n_p, n_p))
        v = self._values
        z = np.exp(1j * np.pi * (np.arange(_NOISE_LINES) + 0.5) / _NOISE_LINES)
        _, by_y = self._regressors(v, z)
        assert by_y is not None
        # Errors e in, y = yhat + e out.
        through = _transfer(v, z, by_y)
        y = np.linalg.inv(np.eye(through.shape[1]) - through)
        slopes = np.einsum("ij,fpjk,kl->fpil", self._whiten, _slopes(v, z, by_y @ y), np.linalg.inv(self._whiten))
        flat = slopes.transpose(1, 0, 2, 3).reshape(n_p, -1)
        return np.asarray(n_samples / _NOISE_LINES * (flat @ flat.conj().T).real)

    def _turns(self, frequency_hz: FloatArray) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * frequency_hz * self.sample_time))

    def _regressors(self, v: PredictorValues, z: ComplexArray) -> tuple[ComplexArray, ComplexArray | None]:
        """Return the regressors by the inputs and by the outputs at lines, (n_lines, n_z, n), from their impulses."""
        n_u, n_y = self.predictor.n_inputs, self.predictor.n_outputs
        middle = max((abs(s) for s in v.shift), default=0) + 4
        impulse, none = np.zeros((2 * middle + 1, 1)), np.zeros((2 * middle + 1, max(n_u, n_y)))
        impulse[middle] = 1.0
        turned = z[:, None] ** -(np.arange(2 * middle + 1) - middle)

        def seen(to_input: bool, count: int) -> ComplexArray:
            columns = []
            for i in range(count):
                moved = none.copy()
                moved[:, i] = impulse[:, 0]
                u, y = (moved, none) if to_input else (none, moved)
                columns.append(turned @ self.predictor.regressors(u[:, :n_u], y[:, :n_y], v.shift))
            return np.stack(columns, axis=-1)

        return seen(True, n_u), seen(False, n_y) if self.predictor.feeds_back else None


def _transfer(v: PredictorValues, z: ComplexArray, regressors: ComplexArray) -> ComplexArray:
    """Return the transfer function from a source of regressors to the predictions, (n_lines, n_y, n)."""
    return np.asarray(v.C @ _states(v, z, v.G @ regressors) + v.H @ regressors)


def _states(v: PredictorValues, z: ComplexArray, forcing: ComplexArray) -> ComplexArray:
    eye = np.eye(len(v.F))
    return np.asarray(np.linalg.solve(z[:, None, None] * eye - v.F, forcing))


def _response(v: PredictorValues, z: ComplexArray, by_u: ComplexArray, by_y: ComplexArray | None) -> ComplexArray:
    """Return the response of the outputs: the predictions without errors are the outputs."""
    direct = _transfer(v, z, by_u)
    if by_y is None:
        return direct
    through = _transfer(v, z, by_y)
    return np.asarray(np.linalg.solve(np.eye(through.shape[1]) - through, direct))


def _slopes(v: PredictorValues, z: ComplexArray, regressors: ComplexArray) -> ComplexArray:
    """Return the derivatives of the predictions by the parameters, at fixed data, (n_lines, n_p, n_y, n)."""
    x = _states(v, z, v.G @ regressors)[:, None]
    source = regressors[:, None]
    back = np.linalg.solve((z[:, None, None] * np.eye(len(v.F)) - v.F).transpose(0, 2, 1), v.C.T).transpose(0, 2, 1)
    return np.asarray(back[:, None] @ (v.dF @ x + v.dG @ source) + v.dC @ x + v.dH @ source)
