"""Law of a control chain as docs/target.md states it, written from that page alone: no code of gbid, scipy for L."""

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

OFF, OFFSET, CONTROL = range(3)
STACKS = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])  # Eqs. 1 and 2: x by the stacks 2 and 4, y by 1 and 3


def tracking_gain(A, B, C, D):
    """L of the page: the stationary Kalman gain, by scipy's Riccati solver; zero for outputs that nothing moves."""
    rows = np.array([D, C @ B, C @ A @ B])
    size = np.sqrt((rows**2).sum(axis=2)).max(axis=0)
    L, moved = np.zeros((len(A), len(C))), size > 0
    if len(A) and moved.any():
        C, D = C[moved], D[moved]
        R, S = D @ D.T + np.diag(size[moved] ** 2), B @ D.T
        P = scipy.linalg.solve_discrete_are(A.T, C.T, B @ B.T, R, s=S)
        L[:, moved] = (A @ P @ C.T + S) @ np.linalg.inv(C @ P @ C.T + R)
    return L


@dataclass
class Guard:
    """Spike guard of one input: the two accepted values, and how many in a row were replaced."""

    limit: float
    before: list = field(default_factory=list)
    replaced: int = 0

    def __call__(self, value):
        if len(self.before) < 2:
            self.before.append(value)
            return value
        line = 2 * self.before[1] - self.before[0]
        if abs(value - line) <= self.limit:
            self.replaced, self.before = 0, [self.before[1], value]
        elif self.replaced < 3:
            self.replaced += 1
            value, self.before = line, [self.before[1], line]
        else:
            self.replaced, self.before = 0, [value, value]
        return value


class PageLaw:
    """The steps of a sample without run-out maps, for the four stacks or a machine with limits of its own.

    `step` returns commands, references, deviation, fault, and whether the sample was faulty or an output at its limit.
    """

    def __init__(self, matrices, T, keys):
        self.A, self.B, self.C, self.D = (np.asarray(m, float) for m in matrices)
        self.L, n, self.key = tracking_gain(self.A, self.B, self.C, self.D), self.B.shape[1], keys
        self.stacks = keys.limits is None
        self.limits = np.array([keys.limit_m] * 2 if self.stacks else keys.limits)
        self.rest = np.array([keys.offset_m] * 4 if self.stacks else keys.offsets or np.zeros(len(self.C)))
        self.zero = np.array(keys.zero_m or np.zeros(n))
        spikes = [keys.spike_guard_m or np.inf] * n if self.stacks else keys.spikes or [np.inf] * n
        self.guards = [Guard(limit) for limit in spikes]
        self.N, self.F = (max(1, round(each / T)) for each in (keys.ramp_s, keys.fade_s))
        self.x, self.e, self.window = np.zeros(len(self.A)), np.zeros(n), []
        self.n = self.f = self.fault = self.faulty = self.far = 0
        self.last, self.still = None, np.zeros(n, int)

    def _deviation(self, p):
        value = p - self.zero
        if self.key.median == 3:
            self.window = [*self.window, value][-3:]
            if len(self.window) == 1:
                return self.e
            value = np.median([self.window[0], *self.window][-3:], axis=0)
        return np.array([guard(v) for guard, v in zip(self.guards, value, strict=True)])

    def step(self, p, mode):
        p, key = np.asarray(p, float), self.key
        good = bool((np.isfinite(p) & (np.abs(p) < 1e6)).all())
        if good:
            self.e, self.faulty = self._deviation(p), 0
            same = np.zeros(len(p), bool) if self.last is None else p == self.last
            self.still, self.last = np.where(same, np.minimum(self.still + 1, key.stuck_samples), 0), p
            beyond = np.hypot(*self.e) > key.disc_limit_m if self.stacks else (np.abs(self.e) > key.beyond).any()
            self.far = min(self.far + 1, key.beyond_samples) if beyond else 0
        else:
            self.faulty = min(self.faulty + 1, key.bad_samples)
        if mode == CONTROL:
            self.fault |= 1 * (self.faulty == key.bad_samples)
            self.fault |= 2 * bool((self.still == key.stuck_samples).any())
            self.fault |= 4 * (self.far == key.beyond_samples)
        else:
            self.fault = 0
        control = mode == CONTROL and self.n == self.N and (not self.fault or key.on_fault == "control")
        if mode != OFF:
            self.n = min(self.n + 1, self.N)
        elif self.f == 0:
            self.n = max(self.n - 1, 0)
        self.f = min(self.f + 1, self.F) if control else max(self.f - 1, 0)
        phi = self.f / self.F
        w = phi * (self.C @ self.x + self.D @ self.e)
        r = np.clip(w, -self.limits, self.limits)
        mu = 1 - (1 - phi) * min(1, 16 / self.F) if self.f else 0.0
        self.x = mu * (self.A @ self.x + self.B @ self.e + self.L @ (r - w))
        command = self.rest * self.n / self.N + (STACKS @ r if self.stacks else r)
        if self.stacks:
            command = np.clip(command, 0.0, key.stroke_m)
        return command, r, self.e, self.fault, not good, bool((r != w).any())
