"""Controller as numbers for given gains: its matrices and their derivatives, continuous or sampled."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from scipy.linalg import expm, expm_frechet

from gbid.arrays import FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.loop.sampling import Method
from gbid.control.tuning.search.direct_call import DirectCall
from gbid.control.tuning.search.loop_family import controller_matrices
from gbid.structure.linear import Structure

Matrices = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class ControllerLaw:
    """Matrices of a controller structure at operating points, and their derivatives by the gains.

    Parameters
    ----------
    structure : Structure or Scheduled
        The controller.
    points : (m, 2) array
        Pressure [bar] and speed [rpm] of each loop, for a scheduled controller.
    shape : (n_outputs, n_inputs)
        Number of outputs and of inputs of the controller.
    sample_time : float, optional
        T_s of a sampled controller [s]; None for a continuous one.
    method : {"tustin", "zoh"}
        Method of discretisation.
    """

    structure: Structure | Scheduled
    points: FloatArray
    shape: tuple[int, int]
    sample_time: float | None = None
    method: Method = "tustin"
    _calls: dict[str, DirectCall] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        gains = tuple(self.structure.parameters)
        g, s = ca.SX.sym("gains", len(gains)), ca.SX.sym("point", 2)
        K = controller_matrices(self.structure, gains, g, s, self.shape)
        values = [ca.densify(ca.SX(K[letter])) for letter in "ABCD"]
        slopes = [ca.densify(ca.jacobian(ca.vec(M), g)) for M in values]
        where = self.points.T if isinstance(self.structure, Scheduled) else np.zeros((2, 1))
        m, q = where.shape[1], ca.MX.sym("gains", len(gains))
        for name, outputs in (("values", values), ("slopes", slopes)):
            one = ca.Function(name, [g, s], outputs)
            many = ca.Function(f"{name}_at_points", [q], list(one.map(m)(ca.repmat(q, 1, m), ca.DM(where))))
            self._calls[name] = DirectCall(many, m, self._calls.get("values"))

    def matrices(self, gains: FloatArray) -> Matrices:
        """Return A, B, C, D, each (m, ., .), or (1, ., .) for a controller that is the same in all loops."""
        A, B, C, D = self._calls["values"](gains)
        return (A, B, C, D) if self.sample_time is None else self._sampled(A, B, C, D)

    def derivatives(self, gains: FloatArray) -> tuple[Matrices, Matrices]:
        """Return A, B, C, D and their derivatives, each (m, d, ., .)."""
        values, slopes = self._calls["values"](gains), self._calls["slopes"](gains)
        A, B, C, D = values
        dA, dB, dC, dD = slopes
        if self.sample_time is None:
            return (A, B, C, D), (dA, dB, dC, dD)
        if self.method == "zoh":
            return self._sampled(A, B, C, D), (*self._held_slopes(A, B, dA, dB), dC, dD)
        # Tustin: with M = (I - h A / 2)^-1 the matrices are 2 M - I, h M B, C M, D + h C M B / 2
        h = self.sample_time
        M = np.linalg.inv(np.eye(A.shape[-1]) - h / 2 * A)
        dM = h / 2 * M[:, None] @ dA @ M[:, None]
        MB, CM = M @ B, C @ M
        dMB = dM @ B[:, None] + M[:, None] @ dB
        dCM = dC @ M[:, None] + C[:, None] @ dM
        dDs = dD + h / 2 * (dC @ MB[:, None] + C[:, None] @ dMB)
        return (2 * M - np.eye(A.shape[-1]), h * MB, CM, D + h / 2 * C @ MB), (2 * dM, h * dMB, dCM, dDs)

    def _sampled(self, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> Matrices:
        h = self.sample_time
        assert h is not None
        n = A.shape[-1]
        if self.method == "zoh":
            whole = expm(h * self._with_inputs(A, B))
            return whole[..., :n, :n], whole[..., :n, n:], C, D
        M = np.linalg.inv(np.eye(n) - h / 2 * A)
        return 2 * M - np.eye(n), h * M @ B, C @ M, D + h / 2 * C @ M @ B

    @staticmethod
    def _with_inputs(A: FloatArray, B: FloatArray) -> FloatArray:
        n = A.shape[-1]
        whole = np.zeros((*A.shape[:-2], n + B.shape[-1], n + B.shape[-1]))
        whole[..., :n, :n], whole[..., :n, n:] = A, B
        return whole

    def _held_slopes(
        self, A: FloatArray, B: FloatArray, dA: FloatArray, dB: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        n, h = A.shape[-1], float(self.sample_time or 0.0)
        base, slopes = h * self._with_inputs(A, B), h * self._with_inputs(dA, dB)
        pairs = zip(base, slopes, strict=True)
        found = np.array([[expm_frechet(a, s, compute_expm=False) for s in of] for a, of in pairs])
        return found[..., :n, :n], found[..., :n, n:]
