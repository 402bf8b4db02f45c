"""Control chain in Python, sample by sample: bit-exact reference (double) for the generated source, and self-test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum, IntFlag
from math import floor, nan
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.export.chain import Chain, SumTerm
from gbid.online.balance import Balancing
from gbid.online.recursive import LearnSample, RecursiveFit
from gbid.prefilter import OnlinePrefilter
from gbid.prefilter.runout import QUARTER, TURN, cos_sin_of_one

LARGEST_ANGLE = 1e10
"""Angles of larger magnitude are faulty [rad]: 184 days of an encoder that counts up at 6 000 rpm."""
WHOLE_TURN = (4 * QUARTER[0], 4 * QUARTER[1])
"""A turn as a sum of two parts, as C subtracts it."""
LARGEST = 1e6
"""Numbers beyond this magnitude are taken for faulty, as those that are not finite."""
LONGEST_SPIKE = 3
"""Most samples in a row that the spike guard replaces."""


class ChainMode(IntEnum):
    """Mode that the operator requests."""

    OFF = 0
    OFFSET = 1
    CONTROL = 2


class ChainFault(IntFlag):
    """Reason why the watchdog faded the control out."""

    NONE = 0
    SIGNAL = 1
    STUCK = 2
    POSITION = 4


@dataclass(frozen=True)
class ChainInput:
    """Input of one sample.

    Attributes
    ----------
    position : tuple of float
        Inputs as measured: p_x, p_y [m].
    angle : float
        Shaft angle phi [rad].
    pressure_bar, speed_rpm : float
        Operating point [bar], [rpm].
    mode : ChainMode
        What the operator asks for.
    further : tuple of float
        Scheduling variables beside pressure and speed, in the order of `Chain.further`.
    """

    position: tuple[float, ...]
    angle: float = 0.0
    pressure_bar: float = 0.0
    speed_rpm: float = 0.0
    mode: ChainMode = ChainMode.CONTROL
    further: tuple[float, ...] = ()

    @property
    def point(self) -> tuple[float, ...]:
        """Scheduling variables in the order of `Chain.scheduling`."""
        return (self.pressure_bar, self.speed_rpm, *self.further)


@dataclass(frozen=True)
class ChainOutput:
    """Output of one sample.

    Attributes
    ----------
    stack : tuple of float
        References of the stacks 1 to 4 [m]; of a machine without stacks the outputs with their offsets.
    reference : tuple of float
        r_x, r_y [m], or the other outputs of the controller.
    deviation : tuple of float
        e, the position without run-out, offset and spikes [m].
    fault : ChainFault
        Why the watchdog has ended the control; it stays until the mode is another than CONTROL.
    held, saturated : bool
        Whether the sample was left out as faulty, and whether a reference is at its limit.
    balance, once_per_turn : tuple of float
        Real and imaginary part of the feed-forward c of each output and of the once-per-turn motion of each input;
        empty without cancellation of unbalance.
    balance_ended : bool
        Whether the watchdog has ended the cancellation of unbalance, until the mode is another than CONTROL.
    estimate, estimate_std : tuple of float
        Recursive estimates and their standard deviations; empty without learning.
    excited : tuple of bool
        Whether the dither determines each of them.
    learn_alarm : bool
        Whether an estimate is at the border of the set for which the loop was checked.
    """

    stack: tuple[float, ...]
    reference: tuple[float, ...]
    deviation: tuple[float, ...]
    fault: ChainFault
    held: bool
    saturated: bool
    balance: tuple[float, ...] = ()
    once_per_turn: tuple[float, ...] = ()
    balance_ended: bool = False
    estimate: tuple[float, ...] = ()
    estimate_std: tuple[float, ...] = ()
    excited: tuple[bool, ...] = ()
    learn_alarm: bool = False


@dataclass
class _State:
    n: int
    n_in: int
    n_point: int
    deviation: list[float] = field(default_factory=list)
    x: list[float] = field(default_factory=list)
    point: list[float] = field(default_factory=list)
    started: bool = False
    last: list[float] | None = None
    accepted: list[list[float]] = field(default_factory=list)
    spikes: list[int] = field(default_factory=list)
    same: list[int] = field(default_factory=list)
    bad: int = 0
    beyond: int = 0
    ramp: int = 0
    fade: int = 0
    fault: ChainFault = ChainFault.NONE

    def __post_init__(self) -> None:
        self.x, self.deviation, self.point = [0.0] * self.n, [0.0] * self.n_in, [0.0] * self.n_point
        self.spikes, self.same = [0] * self.n_in, [0] * (self.n_in + 1)


class PythonChain:
    """Control chain that runs in Python.

    The position passes `gbid.OnlinePrefilter`; the rest is plain sums and products in a fixed order.

    Parameters
    ----------
    chain : Chain
        The chain.
    """

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self.start()

    def start(self) -> None:
        """Reset the chain to rest."""
        chain = self._chain
        first = chain.maps[0] if chain.maps else None
        self._prefilter = OnlinePrefilter(first, offset=np.array(chain.zero), median=chain.options.median)
        self._state = _State(len(chain.states), len(chain.input_names), len(chain.scheduling))
        self._balance = None if chain.balance is None else Balancing(chain.balance, chain.limits, chain.fade_samples)
        self._learning = None if chain.learn is None else Learning(chain.learn)

    def run(self, inputs: Sequence[ChainInput]) -> list[ChainOutput]:
        """Return the outputs of several samples.

        Parameters
        ----------
        inputs : sequence of ChainInput
            The samples.
        """
        return [self.step(each) for each in inputs]

    def step(self, given: ChainInput) -> ChainOutput:
        """Process one input sample, and return the output of the chain.

        Parameters
        ----------
        given : ChainInput
            The sample.
        """
        chain, state = self._chain, self._state
        values = [*given.position, *given.point]
        good = all(-LARGEST < v < LARGEST for v in values) and -LARGEST_ANGLE < given.angle < LARGEST_ANGLE
        if good:
            given = replace(given, angle=within_turn(given.angle))
            self._follow_point(given)
            self._filter(given)
        self._watch(given, good)
        fade = self._levels(given.mode) * (1.0 / chain.fade_samples)
        ramp = state.ramp * (1.0 / chain.ramp_samples)

        row = chain.row(chain.controller, state.point)
        kinds = {"x": state.x, "e": state.deviation, "d": [0.0] * len(chain.limits)}
        wanted = [fade * _sum(terms, row, kinds) for terms in chain.outputs]
        balance = self._balance
        if balance is not None:
            turn, is_on = cos_sin_of_one(given.angle) if good else None, state.fade == chain.fade_samples
            forward = balance.forward(turn, given.speed_rpm, is_on, given.mode == ChainMode.CONTROL)
            wanted = [w + f for w, f in zip(wanted, forward, strict=True)]
        learning = self._learning
        if learning is not None:
            dither = learning.step(state.deviation, given, good, state.fade == chain.fade_samples)
            wanted = [w + d for w, d in zip(wanted, dither, strict=True)]
        r = [min(max(w, -limit), limit) for w, limit in zip(wanted, chain.limits, strict=True)]
        kinds["d"] = [a - b for a, b in zip(r, wanted, strict=True)]
        keep = 1.0 - (1.0 - fade) * chain.forgetting if state.fade > 0 else 0.0
        state.x = [keep * _sum(terms, row, kinds) for terms in chain.states]

        stacks = []
        for factors, (rest, low, high) in zip(chain.allocation, chain.commands, strict=True):
            value = ramp * rest
            for factor, reference in zip(factors, r, strict=True):
                if factor != 0.0:
                    value = value + factor * reference
            stacks.append(min(max(value, low), high))
        saturated = any(d != 0.0 for d in kinds["d"])
        more: dict[str, Any] = {}
        if balance is not None:
            if good:
                balance.adapt(state.deviation, state.point[:2], saturated)
            more = {"balance": _flat(balance.c), "once_per_turn": _flat(balance.once), "balance_ended": balance.ended}
        if learning is not None:
            learning.acted(r, saturated)
            fit = learning.fit
            more |= {"estimate": tuple(fit.values.tolist()), "estimate_std": tuple(fit.std.tolist())}
            more |= {"excited": tuple(fit.excited.tolist()), "learn_alarm": fit.alarm}
        return ChainOutput(tuple(stacks), tuple(r), tuple(state.deviation), state.fault, not good, saturated, **more)

    def references(self, position: FloatArray, angle: float, *point: float) -> FloatArray:
        """Return the outputs of the controller of one sample in mode CONTROL; see `CompiledChain.references`.

        Parameters
        ----------
        position : (n,) array
            Inputs as measured.
        angle : float
            Shaft angle [rad].
        *point : float
            Pressure [bar], speed [rpm] and further scheduling variables of the chain.
        """
        pressure, speed, *further = map(float, point)
        place = tuple(map(float, position)), float(angle), pressure, speed
        return np.array(self.step(ChainInput(*place, further=tuple(further))).reference)

    def _follow_point(self, given: ChainInput) -> None:
        """Move the operating point of the schedules towards the measured point, with limited rate."""
        state, chain = self._state, self._chain
        for i, (value, (low, high), step) in enumerate(
            zip(given.point, chain.point_bounds, chain.point_steps, strict=True)
        ):
            target = min(max(value, low), high)
            if state.started:
                target = state.point[i] + min(max(target - state.point[i], -step), step)
            state.point[i] = target
        state.started = True

    def _filter(self, given: ChainInput) -> None:
        chain, state = self._chain, self._state
        if chain.harmonics is not None and chain.harmonics.is_scheduled:
            row, n = np.array(chain.row(chain.harmonics, state.point)), len(chain.input_names)
            waves = row[n:].reshape(chain.n_orders, 2, n)
            orders = np.arange(1.0, chain.n_orders + 1)
            self._prefilter.change_map(
                replace(chain.maps[0], mean=row[:n], orders=orders, cosine=waves[:, 0], sine=waves[:, 1])
            )
        value = self._prefilter.step(given.position, given.angle)
        if value is not None:
            state.deviation = self._without_spikes([float(v) for v in value])

    def _without_spikes(self, value: list[float]) -> list[float]:
        limits, state = self._chain.spikes, self._state
        if limits is None:
            return value
        if len(state.accepted) < 2:
            state.accepted = [list(value), *state.accepted][:2]
            return value
        newest, before = state.accepted
        kept, earlier = list(value), list(newest)
        for i, limit in enumerate(limits):
            expected = newest[i] + (newest[i] - before[i])
            if abs(value[i] - expected) > limit:
                if state.spikes[i] < LONGEST_SPIKE:
                    kept[i] = expected
                    state.spikes[i] += 1
                else:  # so many in a row are a step: begin anew from it
                    earlier[i] = value[i]
                    state.spikes[i] = 0
            else:
                state.spikes[i] = 0
        state.accepted = [list(kept), earlier]
        return kept

    def _watch(self, given: ChainInput, good: bool) -> None:
        state, options = self._state, self._chain.options
        state.bad = 0 if good else min(state.bad + 1, options.bad_samples)
        if good:
            now, n = [*given.position, given.angle], len(given.position)
            for i in range(n + 1):
                unchanged = state.last is not None and state.last[i] == now[i]
                turning = i < n or (self._chain.needs_angle and given.speed_rpm > options.stuck_speed_rpm)
                state.same[i] = min(state.same[i] + 1, options.stuck_samples) if unchanged and turning else 0
            state.last = now
            far = any(
                sum(state.deviation[i] * state.deviation[i] for i in together) > limit * limit
                for together, limit in self._chain.watched
            )
            state.beyond = min(state.beyond + 1, options.beyond_samples) if far else 0
        if given.mode != ChainMode.CONTROL:
            state.fault = ChainFault.NONE
            return
        if state.bad >= options.bad_samples:
            state.fault |= ChainFault.SIGNAL
        if max(state.same) >= options.stuck_samples:
            state.fault |= ChainFault.STUCK
        if state.beyond >= options.beyond_samples:
            state.fault |= ChainFault.POSITION

    def _levels(self, mode: ChainMode) -> int:
        """Advance the ramp and the fade by one sample; return the level of the fade."""
        state, chain = self._state, self._chain
        stays = chain.options.on_fault == "control" or state.fault == ChainFault.NONE
        wanted = mode == ChainMode.CONTROL and stays
        fade_up = wanted and state.ramp == chain.ramp_samples
        on = mode in (ChainMode.OFFSET, ChainMode.CONTROL)
        if on:
            state.ramp = min(state.ramp + 1, chain.ramp_samples)
        elif state.fade == 0:
            state.ramp = max(state.ramp - 1, 0)
        state.fade = min(state.fade + 1, chain.fade_samples) if fade_up else max(state.fade - 1, 0)
        return state.fade


class Learning:
    """Recursive estimates beside a controller, and their dither, sample by sample.

    Parameters
    ----------
    fit : RecursiveFit
        The recursion.
    """

    def __init__(self, fit: RecursiveFit) -> None:
        self.fit, n = fit.fresh(), len(fit.tables.law.output_names)
        self._shift = [(DITHER_SEED + DITHER_STEP * i) % 2**32 for i in range(n)]
        self._reference, self._dither, self._hold, self._cut = [0.0] * n, [0.0] * n, 0, False

    def step(self, deviation: Sequence[float], given: ChainInput, good: bool, is_on: bool) -> list[float]:
        """Learn from a sample while the control is on, else restart; return the dither of the sample.

        Parameters
        ----------
        deviation : sequence of float
            e of the sample.
        given : ChainInput
            The sample.
        good, is_on : bool
            Whether the sample is none that is faulty, and whether the control is faded in.
        """
        if is_on:
            known = LearnSample(
                tuple(deviation), tuple(self._reference), tuple(self._dither), is_good=good and not self._cut
            )
            self.fit.update(replace(known, angle=given.angle, speed_rpm=given.speed_rpm) if good else known)
        else:
            self.fit.restart()
        amplitude, last = self.fit.dither, self._hold == self.fit.hold_samples - 1
        self._dither = [(amplitude if bits & 1 else -amplitude) if is_on else 0.0 for bits in self._shift]
        if last:
            self._shift = [(bits >> 1) ^ (DITHER_MASK if bits & 1 else 0) for bits in self._shift]
        self._hold = 0 if last else self._hold + 1
        return self._dither

    def acted(self, reference: Sequence[float], saturated: bool) -> None:
        """Keep the references of a sample (n,) and whether one was `saturated`, for the next sample."""
        self._reference, self._cut = list(reference), saturated


DITHER_SEED, DITHER_STEP, DITHER_MASK = 44257, 2654435769, 0xA3000000
"""First state of the shift register of the first output, difference to the next output, and taps."""


def _flat(pairs: Sequence[Sequence[float]]) -> tuple[float, ...]:
    return tuple(value for pair in pairs for value in pair)


def within_turn(angle: float) -> float:
    """Return a shaft angle wrapped to one turn [rad], with the operations of the C source."""
    if 0.0 <= angle < TURN:
        return angle
    whole = float(floor(angle * (1 / TURN)))
    return (angle - whole * WHOLE_TURN[0]) - whole * WHOLE_TURN[1]


def _sum(terms: Sequence[SumTerm], row: Sequence[float], kinds: dict[str, list[float]]) -> float:
    """Return a sum of products, added one by one in the order of the C source."""
    if not terms:
        return 0.0
    total = row[terms[0].entry] * kinds[terms[0].kind][terms[0].index]
    for term in terms[1:]:
        total = total + row[term.entry] * kinds[term.kind][term.index]
    return total


# ---- Rows of the self-test of a generated chain: inputs, and the outputs of the chain in Python.

FLOAT_TOLERANCE = 1e-3
"""Tolerance of the outputs in float, as a share of the limit of the references."""
_TURN_IN = 40
"""Repetitions after which the angle of a row begins again."""


@dataclass(frozen=True)
class SelfTestRow:
    """Row of the self-test: an input that is repeated, and the output after the last repetition.

    Attributes
    ----------
    given : tuple of float
        Inputs [m], phi, its change per repetition [rad], pressure [bar], speed [rpm], further scheduling variables,
        dither of the inputs [m].
    marks : tuple of int
        Mode, repetitions, whether p_x is not a number, fault, status.
    expected : tuple of float
        Commands, outputs, deviations [m].
    """

    given: tuple[float, ...]
    marks: tuple[int, ...]
    expected: tuple[float, ...]


@dataclass(frozen=True)
class _Drive:
    position: tuple[float, ...]
    dither: float
    mode: ChainMode = ChainMode.CONTROL
    repeat: int = 1
    faulty: bool = False
    turns: int = 0


def selftest_rows(chain: Chain) -> tuple[SelfTestRow, ...]:
    """Return the rows of the self-test.

    The rows start the chain, fade the control in, move the disc at random while pressure and speed change and the angle
    counts many turns, show it a spike, a number that is none, a saturating position, a disc beyond the limit, a stuck
    sensor and the end of the control.

    Parameters
    ----------
    chain : Chain
        The chain.

    Returns
    -------
    tuple of SelfTestRow
    """
    random = np.random.default_rng(1)
    twin, rows = PythonChain(chain), []
    single = chain.options.number == "float"
    bounds = chain.point_bounds
    for drive in _drives(chain, random):
        point = [float(random.uniform(*bound)) for bound in bounds]
        angle = float(random.uniform(-1.0, 4.0)) + drive.turns * TURN
        values = (*drive.position, angle, 0.05, *point, drive.dither)
        given = tuple(float(np.float32(v)) if single else v for v in values)
        output = _repeated(twin, given, drive)
        status = int(output.held) + 2 * int(output.saturated) + 4 * int(output.balance_ended)
        status += 8 * int(output.learn_alarm)
        rows.append(
            SelfTestRow(
                given,
                (int(drive.mode), drive.repeat, int(drive.faulty), int(output.fault), status),
                (*output.stack, *output.reference, *output.deviation),
            )
        )
    return tuple(rows)


def _drives(chain: Chain, random: np.random.Generator) -> list[_Drive]:
    options, n = chain.options, len(chain.input_names)
    mean = np.zeros(n) if not chain.maps else np.mean([each.mean for each in chain.maps], axis=0)
    zero, reach = mean + np.array(chain.zero), np.zeros(n)
    for together, limit in chain.watched:
        reach[list(together)] = limit
    still, dither = np.zeros(n), 5e-4 * float(reach.min())

    def at(place: FloatArray, **further: Any) -> _Drive:
        return _Drive(tuple(map(float, zero + place)), **{"dither": dither, **further})

    def around(angle: float, size: float) -> FloatArray:
        return np.asarray(size * reach * np.cos(angle - np.pi / 2 * (np.arange(n) % 2)))

    moves = 0.25 * reach * np.cumsum(random.normal(size=(40, n)) * 0.15, axis=0)
    moving = [at(move, turns=(0, 0, 10, -3, 500_000)[k // 5 % 5]) for k, move in enumerate(moves)]
    first = reach * (np.arange(n) == 0)
    return [
        at(still, mode=ChainMode.OFFSET, repeat=chain.ramp_samples + 5),
        at(still, repeat=chain.fade_samples + 5),
        *moving[:20],
        at(first),
        *moving[20:25],
        at(still, faulty=True, repeat=max(options.bad_samples - 1, 1)),
        *moving[25:],
        *(at(around(0.4 * k, 0.6)) for k in range(12)),
        *(at(1.8 * first) for _ in range(options.beyond_samples + 4)),
        at(still, mode=ChainMode.OFFSET, repeat=20),
        at(still, repeat=30),
        at(0.05 * reach, dither=0.0, repeat=options.stuck_samples + 3),
        at(still, mode=ChainMode.OFFSET, repeat=20),
        at(still, faulty=True, repeat=options.bad_samples + 1),
        at(still, mode=ChainMode.OFF, repeat=600),
    ]


def _repeated(twin: PythonChain, given: tuple[float, ...], drive: _Drive) -> ChainOutput:
    """Return the output after the repetitions of a row, with the operations of the C self-test."""
    n = len(drive.position)
    inputs, (angle, turn, pressure, speed, *further, dither) = given[:n], given[n:]
    for k in range(drive.repeat):
        shift = dither if k % 2 else -dither
        output = twin.step(
            ChainInput(
                tuple(nan if drive.faulty and i == 0 else value + shift for i, value in enumerate(inputs)),
                angle + float(k % _TURN_IN) * turn,
                pressure,
                speed,
                drive.mode,
                tuple(further),
            )
        )
    return output
