"""Time stepping of the rig in Python: the yardstick for the C source of `gbid.rig.stepping`."""

from collections.abc import Callable

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.rig.stepping import DELAY, ROW, ROW_WIDTH, STEP, Chunk, StackArrays, StepArrays, StepState


def run_in_python(arrays: StepArrays, state: StepState, chunk: Chunk) -> FloatArray:
    """Return the motion over a chunk of samples; `state` is changed in place to the end of the chunk.

    Returns
    -------
    (n_samples, ROW_WIDTH) array
        Columns as in `gbid.rig.stepping.ROW`.
    """
    n, over = len(chunk.excitation), arrays.oversampling
    rotor, stacks, controller = arrays.rotor, arrays.stacks, arrays.controller
    kept = len(state.history) - 1
    history = np.vstack([state.history, np.zeros((n * over + 1, 2))])
    output = np.zeros((n, ROW_WIDTH))
    for k in range(n):
        row = output[k]
        r = chunk.excitation[k].copy()
        if controller is not None:
            r = np.clip(r + state.command, -arrays.travel, arrays.travel)
        disc = state.rotor[0:2] + state.rotor[4:6]
        seen = disc + chunk.sensor[k]
        if arrays.resolution > 0:
            seen = np.rint(seen / arrays.resolution) * arrays.resolution
        if controller is not None:
            e = seen - chunk.taken[k]
            state.command[:] = controller.C @ state.controller + controller.D @ e
            state.controller[:] = controller.A @ state.controller + controller.B @ e
        row[ROW.r], row[ROW.u], row[ROW.p], row[ROW.seen] = r, history[kept + k * over], disc, seen
        command = np.zeros(4)
        if stacks is not None:
            command = chunk.base[k] + stacks.share_x * r[0] + stacks.share_y * r[1]
            row[ROW.stacks], row[ROW.commands] = state.stack[2], command
        worst = float(disc @ disc)
        for t in range(k * over, (k + 1) * over):
            if stacks is not None:
                volts, ended = _step_stacks(stacks, state, command, rotor[STEP])
                if t == k * over:
                    row[ROW.volts] = volts
                row[ROW.ended] += ended / over
                y = state.stack[2]
                history[kept + t + 1] = y[1] - y[3], y[0] - y[2]
            else:
                for j, m in enumerate(arrays.linear):
                    a, u = state.linear[j], history[kept + t, j]
                    history[kept + t + 1, j] = m[2] * a + m[3] * u + m[4] * r[j]
                    state.linear[j] = m[0] * a + m[1] * r[j]
            delayed = [_looked_up(history, kept + t + part - rotor[DELAY]) for part in (0.0, 0.5, 1.0)]
            _step_rotor(rotor, arrays.wall, state.rotor, delayed, chunk.forces[2 * t : 2 * t + 3])
            worst = max(worst, float(np.sum((state.rotor[0:2] + state.rotor[4:6]) ** 2)))
        row[ROW.radius] = np.sqrt(worst)
    state.history[:] = history[n * over : n * over + kept + 1]
    return output


def _looked_up(history: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate the history linearly at two places between its rows, one per axis."""
    i = np.floor(at).astype(int)
    w = at - i
    axis = np.arange(2)
    return np.asarray((1 - w) * history[i, axis] + w * history[i + 1, axis])


def _step_stacks(p: StackArrays, state: StepState, command: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Advance the four stacks by one step; return the voltages at its start and which stacks were saturated."""
    crept = state.creep.sum(axis=0)
    volts = np.zeros(4)

    def rates(part: float, x: FloatArray) -> FloatArray:
        q, a, y = x
        plays = np.maximum(a - p.thresholds, np.minimum(a, state.plays)).sum(axis=0)
        e = p.reference_gain * command - y
        v = np.clip(np.where(p.open_loop != 0, command, p.gain * (q + e)), 0.0, p.voltage_limit)
        if part == 0.0:
            volts[:] = v
        goal = np.clip(p.spring * a + p.play * plays + crept, 0.0, p.stroke)
        return np.array([p.lead * e - p.pole * q, p.slow * (v - a), p.fast * (goal - y)])

    x = state.stack
    wanted = p.gain * (x[0] + p.reference_gain * command - x[2])
    beyond = (p.open_loop == 0) & ((wanted < 0) | (wanted > p.voltage_limit))
    ended = beyond | (x[2] > p.stroke * (1 - 1e-6))
    x += _runge_kutta(rates, x, h)
    a = x[1]
    state.plays[:] = np.maximum(a - p.thresholds, np.minimum(a, state.plays))
    fast = p.spring * a + p.play * state.plays.sum(axis=0)
    state.creep[:] += p.relax * (p.creep * fast - state.creep)
    return volts, ended.astype(float)


def _step_rotor(R: FloatArray, wall: bool, x: FloatArray, delayed: list[FloatArray], forces: FloatArray) -> None:
    """Advance the rotor by one step, in place."""
    K, D, B = (R[i : i + 4].reshape(2, 2) for i in (0, 4, 8))
    cubic, clearance, stiffness, damping, omega2, two_zeta_omega, share = R[12:19]

    def rates(part: float, x: FloatArray) -> FloatArray:
        at = round(2 * part)
        q, dq, e, de = x[0:2], x[2:4], x[4:6], x[6:8]
        force = B @ delayed[at] + forces[at]
        p = q + e
        radius = float(np.sqrt(p @ p))
        if wall and radius > clearance:
            outward = p / radius
            push = stiffness * (radius - clearance) + damping * float(outward @ (dq + de))
            force = force - max(push, 0.0) * outward
        bent = (1 + cubic * (q @ q)) * q
        acceleration = K @ bent + D @ dq + force
        return np.concatenate([dq, acceleration, de, share * force - omega2 * e - two_zeta_omega * de])

    x += _runge_kutta(rates, x, R[STEP])


def _runge_kutta(rates: Callable[[float, FloatArray], FloatArray], x: FloatArray, h: float) -> FloatArray:
    """Return the change over one classical Runge-Kutta step; `rates` gets the elapsed part and the state."""
    d1 = rates(0.0, x)
    d2 = rates(0.5, x + h / 2 * d1)
    d3 = rates(0.5, x + h / 2 * d2)
    d4 = rates(1.0, x + h * d3)
    return np.asarray(h / 6 * (d1 + 2 * d2 + 2 * d3 + d4))
