"""Search for an effect that a linear structure omits, where residuals follow an input: one step for each candidate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.discretise import Hold
from gbid.discretise.exact import check_holds
from gbid.identify.data import FitData
from gbid.identify.pose import FitTask, Optimum
from gbid.identify.problem.assemble import bounded
from gbid.identify.problem.solve import gauss_newton_step
from gbid.structure import LinearModel, LinearStructure, Structure
from gbid.structure.kinds import kind_of
from gbid.structure.linear import symbolic_matrices

_DELAYS = (-1.0, -0.5, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)  # [samples]
_LAGS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)  # time constants [samples]
_MOST_PAIRS = 9  # of an input and an output, for which a feed-through is tried
_PART = 0.1  # of the size of a signal: change for the slope of the loss
_STEPS = 1, 6  # of Gauss and Newton for the parameters: of all alternatives, then of the best ones
_SEVERAL = 6  # best ones
_BY_CHANCE = 10.0  # difference of log-likelihoods that no alternative of so many reaches by chance

Alternative = tuple[str, Callable[[float], FitTask], float]


def omitted_effect(optimum: Optimum) -> str:
    """Return the candidate effect that lowers the loss most, and by how much; empty if none does beyond chance.

    Alternatives are the other hold, a delay, lags of first and second order, a feed-through, an offset and a cubic
    force. The parameters follow by steps of Gauss and Newton: the loss is that of a fit with the alternative, nearly.
    """
    task = optimum.problem.task
    shooting = optimum.shooting if optimum.reweighted is None else optimum.reweighted.problem
    linear = kind_of(task.structure).linear
    if linear is None or task.data.is_irregular or shooting.extra is not None or task.responses:
        return ""
    every = list(_alternatives(task, linear))
    here, losses = _loss(optimum, task, _STEPS[-1]), np.zeros(0)
    for steps, count in zip(_STEPS, (_SEVERAL, 1), strict=True):
        losses = np.array([_least(optimum, here, each, steps) for each in every])
        every = [every[i] for i in np.argsort(losses)[:count]]  # nan comes last
    loss = float(np.nanmin(losses)) if np.isfinite(losses).any() else here
    if not 0.5 * np.log(here / loss) * shooting.likelihood_size > _BY_CHANCE:
        return ""
    return f"of the effects that may be missing, {every[0][0]} lowers the loss most, by {100 * (1 - loss / here):.3g} %"


def _least(optimum: Optimum, here: float, alternative: Alternative, steps: int) -> float:
    """Return the loss with a candidate effect; for an unknown size the minimum of a parabola through `here`."""
    _, changed, size = alternative
    loss = _loss(optimum, changed(size), steps)
    if not size:
        return loss
    back = _loss(optimum, changed(-size), steps)
    bend, slope = (loss + back) / 2 - here, (loss - back) / 2
    return here - slope**2 / (4 * bend) if bend > 0 else np.nan


def _loss(optimum: Optimum, task: FitTask, steps: int) -> float:
    """Return the loss of a task, in relation to the outputs' power, after steps from another task's optimum."""
    posed = optimum.problem
    given = optimum.shooting if optimum.reweighted is None else optimum.reweighted.problem
    _, _, assembly = task.assembled(posed.start, posed.parameters, posed.window)
    parts = (
        replace(part, blocks=replace(part.blocks, used=old.blocks.used))
        for part, old in zip(assembly.parts, given.parts, strict=True)
    )
    shooting = bounded(replace(given, parts=tuple(parts), links=assembly.links), assembly, task.states)
    x = np.clip(optimum.solution.unknowns, *shooting.box)
    try:
        for _ in range(steps):
            x = np.clip(x + gauss_newton_step(shooting, shooting.at(x), x), *shooting.box)
        return float(np.exp(2 * shooting.cost_alone(*shooting.unpack(x))))
    except (RuntimeError, ValueError):
        return np.nan
    finally:
        shooting.release()


def _alternatives(task: FitTask, structure: Structure) -> Iterator[Alternative]:
    """Yield the candidate effects: text, task as a function of size, and a trial size (zero if known)."""
    data, h = task.data, task.data.sample_time
    holds = check_holds(task.hold, len(data.input_names))
    other: tuple[Hold, ...] = tuple("foh" if hold == "zoh" else "zoh" for hold in holds)
    shown = other[0] if len(set(other)) == 1 else list(other)
    yield f"the other hold of the inputs (intersample={shown!r})", lambda _: replace(task, hold=other), 0.0
    for samples in _DELAYS:
        what = f"a delay of the inputs by {samples:g} samples ({samples * h:.3g} s)"
        yield what, partial(_delayed, task, structure, samples), 0.0
    for samples in _LAGS:
        T = samples * h
        what = f"a lag with a time constant of {T:.3g} s, as of an amplifier or a sensor,"
        yield what, partial(_filtered, task, samples, 1), 0.0
        what = f"a low-pass filter of second order at {1 / (2 * np.pi * T):.3g} Hz, such as an anti-aliasing filter,"
        yield what, partial(_filtered, task, samples, 2), 0.0
    of_u, of_y = (_sizes(data, side) for side in ("inputs", "outputs"))
    for i, output in enumerate(data.output_names):
        yield f"an offset of {output!r} (trend='offset')", partial(_less, task, i, None), _PART * of_y[i]
        for j, name in enumerate(data.input_names):
            if of_u[j] > 0 and of_y.size * of_u.size <= _MOST_PAIRS:
                what = f"a feed-through from {name!r} to {output!r}"
                yield what, partial(_less, task, i, j), _PART * of_y[i] / of_u[j]
    if of_u.size == of_y.size and (of_u > 0).all():
        ratio = of_u / of_y**3
        yield "a force with the cube of the outputs", lambda s: _with_cubes(task, s * ratio), _PART


def _sizes(data: FitData, side: str) -> FloatArray:
    return np.asarray(np.concatenate([getattr(record, side) for record in data.records]).std(axis=0))


def _with_inputs(task: FitTask, changed: Callable[[FloatArray, Hold], FloatArray]) -> FitTask:
    """Return a task with modified inputs; the change acts on samples and hold."""
    holds = check_holds(task.hold, len(task.data.input_names))
    records = (
        replace(r, inputs=np.stack([changed(u, hold) for u, hold in zip(r.inputs.T, holds, strict=True)], axis=1))
        for r in task.data.records
    )
    return replace(task, data=replace(task.data, records=tuple(records)))


def _less(task: FitTask, output: int, source: int | None, gain: float) -> FitTask:
    """Return a task with one output reduced by a gain times an input, or by a constant."""
    records = []
    for record in task.data.records:
        outputs = record.outputs.copy()
        outputs[:, output] -= gain if source is None else gain * record.inputs[:, source]
        records.append(replace(record, outputs=outputs))
    return replace(task, data=replace(task.data, records=tuple(records)))


def _with_cubes(task: FitTask, gains: FloatArray) -> FitTask:
    records = (replace(r, inputs=np.ascontiguousarray(r.inputs + gains * r.outputs**3)) for r in task.data.records)
    return replace(task, data=replace(task.data, records=tuple(records)))


def _delayed(task: FitTask, full: Structure, samples: float, _: float) -> FitTask:
    """Return a task with inputs delayed by a number of samples; a fractional advance is interpolated."""
    p, m = symbolic_matrices(full)
    if samples < 0 or m.feedback is not None:
        k = np.arange(max(record.n_samples for record in task.data.records))
        return _with_inputs(task, lambda u, _: np.interp(k[: len(u)] - samples, k[: len(u)], u))
    delay_s = samples * task.data.sample_time
    later = m.delay + delay_s if m.has_delay else ca.SX(ca.DM.ones(m.B.shape[1]) * delay_s)
    part = {"A": m.A, "B": 0 * m.B, "B_delayed": m.B + m.B_delayed, "delay": later, "C": m.C, "D": m.D, "K": m.K}
    part |= {"x0": m.x0} if m.x0.numel() else {}
    at = ca.Function("delayed", [p], list(part.values()))

    def matrices(q: Any) -> Mapping[str, Any]:
        values = at.call([ca.vertcat(*(q[each.name] for each in full.parameters))])
        return dict(zip(part, values, strict=True))

    return replace(task, structure=LinearStructure(full.name, full.parameters, matrices, full.inputs, full.outputs))


def _filtered(task: FitTask, samples: float, order: int, _: float) -> FitTask:
    """Return a task with inputs through a Butterworth filter with a time constant in samples.

    They are on straight lines with the means of each sample, which matter to a model that is slow against it.
    """
    h = task.data.sample_time
    rate = 1 / (samples * h)
    A = -rate * np.eye(1) if order == 1 else np.array([[0.0, 1.0], [-(rate**2), -np.sqrt(2) * rate]])
    A = np.block([[A, np.zeros((order, 1))], [np.eye(1, order), np.zeros((1, 1))]])  # the last state is the integral
    B, C = np.eye(order + 1, 1, 1 - order) * rate**order, np.eye(order + 1)[[0, order]]
    model = LinearModel(A, B, C, np.zeros((2, 1)))

    def after(u: FloatArray, hold: Hold) -> FloatArray:
        values, integral = model.simulate((u - u[0])[:, None], h, intersample=hold).T
        above = np.diff(integral) / h - (values[:-1] + values[1:]) / 2  # the mean, over that of the line
        return np.asarray(values + (np.append(above, 0.0) + np.append(0.0, above)) / 2 + u[0])

    return replace(_with_inputs(task, after), hold="foh")
