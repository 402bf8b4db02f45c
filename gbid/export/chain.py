"""Control chain of a design, from sensor samples to piezo references: options, tables, anti-windup, checks."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, cast

import numpy as np
import scipy
from annotated_types import Ge, Le
from scipy.sparse.csgraph import connected_components

from gbid import control, lpv
from gbid._version import __version__
from gbid.control.loop.close import too_slow_for
from gbid.core.arrays import FloatArray, Point, point_label
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.notes import ControlNote
from gbid.core.option_types import Exact, Finite, NotNegative, Positive, check_options
from gbid.online.balance import BalanceWhileRunning
from gbid.online.grid import TOLERANCE, GridTable, table_of_points, table_over_domain
from gbid.online.recursive import RecursiveFit
from gbid.prefilter import RunoutMap
from gbid.prefilter.runout_identification import refuse_lost_index
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.structure.scheduling import SCHEDULING

# ---- Names and texts in C source: checked identifiers, safe comments, exact numbers.

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,49}")
_WORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int long main register
restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
"""
_RESERVED = frozenset(_WORDS.split())


def c_name(text: str) -> str:
    """Return a text after a check that it is a valid prefix of C names.

    Parameters
    ----------
    text : str
        The name.

    Raises
    ------
    UsageError
        When it is no identifier, longer than 50 characters, or a word of the language.
    """
    if not _NAME.fullmatch(text) or text in _RESERVED:
        raise UsageError(
            f"name {text!r} is no C identifier; use letters, digits and '_', a letter first, at most 50 characters, "
            "and no word of the language"
        )
    return text


def c_comment(text: str) -> str:
    """Return a free text as one line for a C comment: ASCII without comment marks, trigraphs and backslashes.

    Parameters
    ----------
    text : str
        Any text.
    """
    line = " ".join(str(text).split())
    line = re.sub(r"\*+/|/[*/]+", "|", line).replace("\\", "|").replace("??", "?")
    return "".join(c if " " <= c <= "~" else "?" for c in line).replace("/*", "|").replace("*/", "|")


def c_number(value: float, number: str) -> str:
    """Return a C literal of type double or float that is read back with identical bits.

    Parameters
    ----------
    value : float
        A finite number.
    number : {"double", "float"}
        Type of the literal.
    """
    text = repr(float(value))
    text = text if any(c in text for c in ".e") else f"{text}.0"
    text = f"{text}f" if number == "float" else text
    return f"({text})" if text.startswith("-") else text


# ---- Options of a control chain: limits, ramps, guards and watchdog.

Number = Literal["double", "float"]
Samples = Annotated[int, Exact(), Ge(1), Le(30000)]
_FASTEST_S = 2.0
"""Shortest time in which a schedule follows a variable other than pressure and speed through its range [s]."""
_FIELDS = ("position", "angle", "mode")
"""Fields of the input of a chain that are no scheduling variables."""
PIEZO_CHANNELS = ("p_x", "p_y"), ("r_x", "r_y")
"""Inputs and outputs of the controller of a machine with four piezo stacks."""
STACKS = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))
"""Factors of r_x and r_y in the references of the stacks 1 to 4 (Eq. 1)."""


@dataclass(frozen=True)
class ChainOptions:
    """Options of a control chain.

    Parameters
    ----------
    limit_m : float, optional
        Limit of the magnitude of r_x and r_y [m]; by default what the stroke leaves around `offset_m`.
    offset_m : float, optional
        r_0, position of each stack at rest [m]; by default half of the stroke.
    stroke_m : float, optional
        Largest reference of a stack [m]; by default the travel of the machine, see `on`.
    zero_m : tuple of float
        p_0, subtracted from the position after the run-out map [m]; zero for the mean of the map. Of other inputs than
        p_x and p_y in their unit; empty for zeros.
    median : {1, 3}
        Size of the median. 3 removes single wrong samples and delays the position by a sample.
    spike_limit_m : float, "auto" or None
        Largest deviation of a sample from the straight line through the two before it [m]. Up to three such samples
        in a row are replaced by this line, without delay. ``"auto"``: 0.4 of `disc_limit_m`. None for no guard.
    disc_limit_m : float, optional
        Distance of the disc from its zero position at which the watchdog ends the control [m]; by default 0.8 of the
        clearance of the machine, see `on`.
    beyond_samples, bad_samples, stuck_samples : int
        Samples in a row after which the watchdog acts: beyond the limit, not finite, or without any change.
    stuck_speed_rpm : float
        Speed above which the shaft angle must change as well [rpm].
    ramp_s : float
        Time in which the stacks go from zero to r_0 and back [s].
    fade_s : float
        Time in which the control is faded in and out [s]. Meanwhile the states of the controller decay, and they are
        zero while it is off.
    pressure_rate, speed_rate : float
        Fastest change of pressure [bar/s] and speed [rpm/s] that a schedule follows. Another scheduling variable
        takes at least 2 s through its range.
    number : {"double", "float"}
        Type of the numbers in the source.
    on_fault : {"fade", "control"}
        What the watchdog does besides telling the fault: it fades the control out, or leaves it on. A rotor that only
        the control holds up falls when that fades out; faulty samples then leave the last good position in force.
    dither : float
        Amplitude of the binary excitation of `gbid export --learn` at each output, in its unit; 0 for none.
    forgetting_s, memory_s : float
        Forgetting time of these estimates and memory of their predictor [s], see `gbid.RecursiveFit`.
    limits : tuple of float, optional
        Of a machine without the four stacks: limit of the magnitude of each output, in its unit. The outputs then go
        out as they are, with `offsets`, and `limit_m`, `offset_m`, `stroke_m`, `disc_limit_m` and `spike_limit_m` have
        no use.
    offsets : tuple of float
        Of such a machine: each output at rest, such as the bias current; empty for zeros.
    beyond : tuple of float, optional
        Of such a machine: deviation of each input, in its unit, at which the watchdog acts.
    spikes : tuple of float, optional
        Of such a machine: limit of the spike guard of each input, as `spike_limit_m`; None for no guard.
    units : (str, str)
        Units of inputs and outputs, for the comments; metres of the four stacks.

    Raises
    ------
    UsageError
        When a value has no meaning.
    """

    limit_m: Positive | None = None
    offset_m: Positive | None = None
    stroke_m: Positive | None = None
    zero_m: tuple[Finite, ...] = ()
    median: Literal[1, 3] = 1
    spike_limit_m: Positive | Literal["auto"] | None = "auto"
    disc_limit_m: Positive | None = None
    beyond_samples: Samples = 3
    bad_samples: Samples = 5
    stuck_samples: Samples = 50
    stuck_speed_rpm: NotNegative = 300.0
    ramp_s: Positive = 1.0
    fade_s: Positive = 0.5
    pressure_rate: Positive = 2.0
    speed_rate: Positive = 2000.0
    number: Number = "double"
    on_fault: Literal["fade", "control"] = "fade"
    dither: NotNegative = 0.0
    forgetting_s: Positive = 1.0
    memory_s: Positive | None = None
    limits: tuple[Positive, ...] | None = None
    offsets: tuple[Finite, ...] = ()
    beyond: tuple[Positive, ...] | None = None
    spikes: tuple[Positive, ...] | None = None
    units: tuple[str, str] = ("", "")

    def __post_init__(self) -> None:
        check_options(self)
        if self.limits is None and (self.offsets or self.beyond or self.spikes):
            raise UsageError(
                "offsets, beyond and spikes belong to a machine without stacks; give limits, too", "limits"
            )
        if self.limits is None and self.units == ("", ""):
            object.__setattr__(self, "units", ("m", "m"))
        missing = {}
        if self.limits is not None and self.beyond is None:
            missing["beyond"] = "the deviation of each input at which the watchdog acts"
        if "" in self.units:
            missing["units"] = 'those of inputs and outputs, such as ("m", "A")'
        if missing:
            text = f"limits without {' and '.join(missing)}: give {', and '.join(missing.values())}"
            raise UsageError(text, next(iter(missing)))
        if self.stroke_m is not None:
            offset = self.stroke_m / 2 if self.offset_m is None else self.offset_m
            room = min(offset, self.stroke_m - offset)
            limit = room if self.limit_m is None else self.limit_m
            if not 0 < limit <= room + 1e-12:
                raise UsageError(
                    f"limit_m = {limit:g} m around offset_m = {offset:g} m leaves the stroke of {self.stroke_m:g} m; "
                    f"at most {max(room, 0.0):g} m fit",
                    "limit_m",
                )
            object.__setattr__(self, "offset_m", offset)
            object.__setattr__(self, "limit_m", limit)

    def on(self, machine: lpv.MachineData) -> ChainOptions:
        """Return these options with piezo stroke and disc limit of a machine, where the options give none.

        Parameters
        ----------
        machine : MachineData
            Travel of the piezos and clearance, as far as they are known.
        """
        clearance, disc = machine.clearance_m, self.disc_limit_m
        return replace(
            self,
            stroke_m=machine.piezo_travel_m if self.stroke_m is None else self.stroke_m,
            disc_limit_m=float(f"{0.8 * clearance:.12g}") if disc is None and clearance is not None else disc,
        )

    @property
    def spike_guard_m(self) -> float | None:
        """Limit of the spike guard [m], with ``"auto"`` replaced by a number; None without a guard."""
        if self.spike_limit_m != "auto":
            return self.spike_limit_m
        return None if self.disc_limit_m is None else self.disc_limit_m / 2.5

    def samples(self, seconds: float, sample_time: float) -> int:
        """Return a time as a whole number of samples, at least one.

        Parameters
        ----------
        seconds, sample_time : float
            Time and time between samples [s].
        """
        return max(1, round(seconds / sample_time))


FADE_FORGETS = 16.0
"""Time of a fade over the time constant with which the states of the controller decay near its lower end."""


Kind = Literal["x", "e", "d"]


@dataclass(frozen=True)
class SumTerm:
    """Product in a sum of the controller: table entry times a state x, an input e or a saturation residual d.

    Attributes
    ----------
    entry : int
        Place of the factor in the row of the controller.
    kind : {"x", "e", "d"}
        What it is multiplied by: state, deviation of the disc, or what saturation took from an output.
    index : int
        Which one.
    """

    entry: int
    kind: Kind
    index: int


@dataclass(frozen=True, eq=False)
class Chain(Brief):
    """Control chain with its numbers, as `chain_of` returns it.

    Attributes
    ----------
    name : str
        Name and prefix of all names in the source.
    title : str
        Controller and plant in words.
    sample_time : float
        T_s [s].
    controller : GridTable
        Rows with the entries of the sampled controller that are not zero.
    outputs, states : tuple of tuple of SumTerm
        Sums that make each output from the row, and each next state.
    maps : tuple of RunoutMap
        Run-out maps; empty for none, one, or several of one set of harmonics.
    harmonics : GridTable or None
        Rows with the mean and the harmonics of the maps: mean of x and y, then cosine of x and y, sine of x and y for
        the orders 1, 2, ...; None when there is no map of harmonics.
    options : ChainOptions
        Limits, ramps, guards and watchdog.
    input_names, output_names : tuple of str
        Names of the n inputs and of the m outputs of the controller.
    notes : tuple of str
        Remarks for the reader of the source.
    balance : BalanceWhileRunning or None
        Cancellation of unbalance after the controller.
    learn : RecursiveFit or None
        Recursive estimates beside the controller, and its dither.
    """

    name: str
    title: str
    sample_time: float
    controller: GridTable
    outputs: tuple[tuple[SumTerm, ...], ...]
    states: tuple[tuple[SumTerm, ...], ...]
    maps: tuple[RunoutMap, ...]
    harmonics: GridTable | None
    options: ChainOptions
    input_names: tuple[str, ...] = PIEZO_CHANNELS[0]
    output_names: tuple[str, ...] = PIEZO_CHANNELS[1]
    notes: tuple[str, ...] = ()
    balance: BalanceWhileRunning | None = None
    learn: RecursiveFit | None = None

    @property
    def n_orders(self) -> int:
        """Number of harmonics up to the highest order, missing orders included."""
        n = len(self.input_names)
        return 0 if self.harmonics is None else (self.harmonics.rows.shape[1] - n) // (2 * n)

    @property
    def zero(self) -> tuple[float, ...]:
        """Zero point of each input (n,), which the chain subtracts."""
        return self.options.zero_m or (0.0,) * len(self.input_names)

    @property
    def limits(self) -> tuple[float, ...]:
        """Largest allowed magnitude of each output (m,)."""
        return self.options.limits or (cast(float, self.options.limit_m),) * len(self.output_names)

    @property
    def spikes(self) -> tuple[float, ...] | None:
        """Limit of the spike guard for each input (n,); None without a guard."""
        if self.options.limits is not None:
            return self.options.spikes
        limit = self.options.spike_guard_m
        return None if limit is None else (limit,) * len(self.input_names)

    @property
    def watched(self) -> tuple[tuple[tuple[int, ...], float], ...]:
        """Groups of inputs whose radius the watchdog checks, with limits: the disc position, or each input alone."""
        if self.options.beyond is None:
            return ((tuple(range(len(self.input_names))), cast(float, self.options.disc_limit_m)),)
        return tuple(((i,), limit) for i, limit in enumerate(self.options.beyond))

    @property
    def commands(self) -> tuple[tuple[float, float, float], ...]:
        """Value at rest, lower and upper limit of each command: of the stacks, or of the outputs."""
        if self.options.limits is None:
            stack = self.options.offset_m, 0.0, self.options.stroke_m
            return (cast(tuple[float, float, float], stack),) * len(STACKS)
        rest = self.options.offsets or (0.0,) * len(self.limits)
        return tuple(  # in OFF a command is zero, also where its value at rest is larger than its limit
            (at, min(0.0, at - limit), max(0.0, at + limit)) for at, limit in zip(rest, self.limits, strict=True)
        )

    @property
    def command(self) -> str:
        """Name of the commands in the C source."""
        return "stack" if self.options.limits is None else "command"

    @property
    def bins(self) -> RunoutMap | None:
        """Run-out map as a table over the shaft angle, if it has this form."""
        return next((each for each in self.maps if each.method == "bins"), None)

    @property
    def needs_angle(self) -> bool:
        """Whether the chain uses the shaft angle."""
        return self.balance is not None or any(each.needs_angle for each in self.maps)

    @property
    def schedules(self) -> dict[str, GridTable]:
        """Tables over scheduling variables with more than one row, by their names in the C source."""
        tables = {
            "controller": self.controller,
            "map": self.harmonics,
            "balance": None if self.balance is None else self.balance.table,
        }
        return {name: table for name, table in tables.items() if table is not None and table.is_scheduled}

    @property
    def is_scheduled(self) -> bool:
        """Whether the chain uses scheduling variables."""
        return bool(self.schedules)

    @property
    def further(self) -> tuple[str, ...]:
        """Scheduling variables beside pressure and speed, which every chain takes."""
        return tuple(dict.fromkeys(name for t in self.schedules.values() for name in t.axes if name not in SCHEDULING))

    @property
    def scheduling(self) -> tuple[str, ...]:
        """Names of all variables that the chain takes."""
        return (*SCHEDULING, *self.further)

    def row(self, table: GridTable, point: Sequence[float]) -> list[float]:
        """Return the row of a table at an operating point.

        Parameters
        ----------
        table : GridTable
            Table of the chain.
        point : sequence of float
            Values of the variables of `scheduling`.
        """
        return table.row(*(point[self.scheduling.index(name)] for name in table.axes))

    @property
    def allocation(self) -> tuple[tuple[float, ...], ...]:
        """Matrix from the outputs to the commands."""
        return STACKS if self.options.limits is None else tuple(map(tuple, np.eye(len(self.limits)).tolist()))

    @property
    def ramp_samples(self) -> int:
        """Length of the start-up ramp in samples."""
        return self.options.samples(self.options.ramp_s, self.sample_time)

    @property
    def fade_samples(self) -> int:
        """Length of the fade of the control in samples."""
        return self.options.samples(self.options.fade_s, self.sample_time)

    @property
    def forgetting(self) -> float:
        """Share of its states that the controller discards per sample while the fade is near zero."""
        return min(1.0, FADE_FORGETS / self.fade_samples)

    @property
    def point_bounds(self) -> tuple[tuple[float, float], ...]:
        """Range of each variable of `scheduling` that the schedules cover."""
        axes = [[t.axes[name] for t in self.schedules.values() if name in t.axes] for name in self.scheduling]
        return tuple((min(q[0] for q in each), max(q[-1] for q in each)) if each else (0.0, 0.0) for each in axes)

    @property
    def point_steps(self) -> tuple[float, ...]:
        """Largest change of each variable of `scheduling` per sample that the schedules follow."""
        rates = [self.options.pressure_rate, self.options.speed_rate]
        rates += [(high - low) / _FASTEST_S for low, high in self.point_bounds[2:]]
        return tuple(rate * self.sample_time for rate in rates)

    @cached_property
    def content_key(self) -> str:
        """Digest of all numbers of the chain, 64 hexadecimal digits."""
        tables = [t for t in (self.controller, self.harmonics) if t is not None]
        if self.balance is not None:
            tables.append(self.balance.table)
        document = {
            "gbid": __version__,
            "name": self.name,
            "sample_time": self.sample_time,
            "tables": [[*t.axes.values(), t.rows.tolist()] for t in tables],
            "sums": [[asdict(term) for term in terms] for terms in (*self.outputs, *self.states)],
            "bins": [] if self.bins is None else [self.bins.angles.tolist(), self.bins.table.tolist()],
            "means": [each.mean.tolist() for each in self.maps],
            "options": asdict(self.options),
            "channels": [self.input_names, self.output_names, *self.further],
        }
        if self.balance is not None:
            document["balance"] = [self.balance.speeds_rpm, self.balance.time_constant_s, self.balance.share]
        if self.learn is not None:
            numbers = [self.learn.start, self.learn.prior_std, self.learn.bounds, *self.learn.tables[:-2]]
            settings = [self.learn.forgetting_s, self.learn.dither, self.learn.hold_samples]
            document["learn"] = [self.learn.names, settings, [array.tolist() for array in numbers]]
        return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


# ---- Anti-windup gain of a sampled controller of any structure.

_NEARLY_ONE = 1.0 - 1e-9
"""Factor of A in the Riccati equation, so that an integrator that no output shows does not prevent its solution."""


def anti_windup_gain(controller: LinearModel) -> FloatArray:
    r"""Return the anti-windup gain L, by which the states follow a saturated output.

    .. math:: x_{k+1} = A x_k + B e_k + L (\mathrm{sat}(w_k) - w_k), \quad w_k = C x_k + D e_k

    During saturation the states obey ``A - L C``. L is the stationary Kalman gain of the controller whose input e is
    white noise and whose output i has noise of the size of its immediate response, the largest norm of row i of D, CB
    and CAB (of the next ``C A^k B`` where these are zero). For a PI controller this is back-calculation with a tracking
    time of 1.4 times the integral time. For a controller with invertible D it is close to the conditioning technique,
    ``L = B D^-1``. A fast filter gets a small gain, because it forgets by itself. Axes that share no state and no
    channel are solved one by one, so that the gain of an axis does not depend on another.

    Parameters
    ----------
    controller : LinearModel
        Sampled controller.

    Returns
    -------
    (n_states, n_outputs) array
        L; its column is zero for an output that no input reaches.

    Notes
    -----
    Hanus, R., Kinnaert, M., Henrotte, J.-L. (1987), Conditioning technique, a general anti-windup and bumpless transfer
    method, Automatica 23, 729-739.
    """
    A, B, C, D = (np.array(getattr(controller, letter), float) for letter in "ABCD")
    n, n_y = len(A), len(C)
    result, columns = np.zeros((n, n_y)), np.insert(np.hstack([A, B]), [n] * n_y, 0.0, axis=1)
    links = np.vstack([columns, np.insert(np.hstack([C, D]), [n] * n_y, 0.0, axis=1)])
    links = np.vstack([links, np.zeros((links.shape[1] - len(links), links.shape[1]))])
    count, axis = connected_components(links != 0, directed=False)
    for k in range(count):
        x, y, e = (np.flatnonzero(part == k) for part in np.split(axis, [n, n + n_y]))
        result[np.ix_(x, y)] = _axis_gain(A[np.ix_(x, x)], B[np.ix_(x, e)], C[np.ix_(y, x)], D[np.ix_(y, e)])
    return result


def _axis_gain(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> FloatArray:
    """Return the anti-windup gain for the coupled channels of one axis."""
    result, column = np.zeros((len(A), len(C))), B
    size = np.linalg.norm(D, axis=1)
    for k in range(len(A)):
        response = np.linalg.norm(C @ column, axis=1)
        size, column = np.where((k < 2) | (size == 0), np.maximum(size, response), size), A @ column
    driven = size > 0
    if not (driven.any() and len(A)):
        return result
    C, D, A = C[driven], D[driven], _NEARLY_ONE * A
    S, R = B @ D.T, D @ D.T + np.diag(size[driven] ** 2)
    P = scipy.linalg.solve_discrete_are(A.T, C.T, B @ B.T, R, s=S)
    result[:, driven] = np.linalg.solve((C @ P @ C.T + R).T, (A @ P @ C.T + S).T).T
    return result


# ---- Control chain from a controller design and run-out maps, with checks that it can run.

_ON_THE_CIRCLE = 1.0 + 1e-9
"""Largest magnitude of a pole of a controller that does not run away; an integrator has one of 1."""


def chain_of(
    design: control.ControllerDesign | control.GainResult,
    *,
    name: str | None = None,
    runout_maps: Sequence[RunoutMap] = (),
    still: Sequence[Recording] = (),
    options: ChainOptions | None = None,
    balance: BalanceWhileRunning | None = None,
    learn: RecursiveFit | None = None,
) -> Chain:
    """Return the control chain of a design.

    Parameters
    ----------
    design : ControllerDesign or GainResult
        The controller; any fixed structure, scheduled or not. A result of `gbid.tune` must be that of a sampled loop,
        whose sample time the chain has. The controller of the four stacks has p_x and p_y in, r_x and r_y out; others
        need `limits` and `beyond` among the options.
    name : str, optional
        Prefix of all names in C; by default that of the design.
    runout_maps : sequence of RunoutMap
        Maps of run-out and unbalance: none, one, or maps of harmonics at the points of a full grid of pressure and
        speed, between which they are interpolated. Maps of a shaft at rest count only when there is no other.
    still : sequence of Recording
        Recordings with the encoder of the target. A map whose zero of the angle is another one is refused.
    options : ChainOptions, optional
        Limits, ramps, guards and watchdog. `stroke_m` and `disc_limit_m` of the four stacks are required, unless the
        provenance of the design has piezo_travel_m and clearance_m, or its plant is a model that comes with gbid.
    balance : BalanceWhileRunning, optional
        Cancellation of unbalance for this design. The run-out maps must then be those of slow roll: at most a quarter
        of the lowest speed at which unbalance is cancelled.
    learn : RecursiveFit, optional
        Recursive estimates for this design, which must have constant gains, and their dither.

    Returns
    -------
    Chain

    Raises
    ------
    UsageError
        When the controller is unstable by itself or faster than its sample rate, when the name is no C identifier,
        when limits are missing, when options or maps do not fit its channels, or when a run-out map contains the
        response to the unbalance that is to be cancelled.
    DataError
        When the zero of the angle of a recording is not that of the map.
    """
    if isinstance(design, control.GainResult):
        design = design.design()
    name = c_name(name or design.name)
    options = options or ChainOptions()
    models, table = _controller_table(design)
    for point, model in models:
        _check(design, model, point)
    pattern, model = np.any(table.rows != 0, axis=0), models[0][1]
    inputs, references = model.input_names, model.output_names
    options = options.on(_machine_of(design))
    _check_channels(design.name, inputs, references, options)
    outputs, states = _sums(pattern, model.n_states, len(inputs), len(references))
    entries = replace(table, rows=table.rows[:, pattern])
    maps = _used_maps(runout_maps, len(inputs))
    for recording in still:
        for each in maps:
            if each.needs_angle:
                refuse_lost_index(each, recording)
    notes: tuple[str, ...] = ()
    if table.error > TOLERANCE:
        text = f"schedule: interpolation is off by up to {100 * table.error:.2g} % of an entry between nodes"
        notes = (ControlNote.INTERPOLATED(text),)
    if balance is not None:
        notes = (*notes, *_check_balance(balance, design, maps))
    if learn is not None:
        _check_learn(learn, model, table.is_scheduled, options)
    plant = f", designed for {design.plant}" if design.plant else ""
    return Chain(
        name,
        f"{design.name}: {model.name or 'controller'}{plant}",
        design.rate,
        entries,
        outputs,
        states,
        maps,
        _harmonics_table(maps, design.variables),
        options,
        inputs,
        references,
        notes,
        balance,
        learn,
    )


SLOW_ROLL = 0.25
"""Largest speed of a run-out map over the lowest speed at which unbalance is cancelled."""


def _check_balance(
    balance: BalanceWhileRunning, design: control.ControllerDesign, maps: tuple[RunoutMap, ...]
) -> tuple[str, ...]:
    """Refuse a cancellation for another controller, or of what a map takes out; return notes."""
    if (balance.design.gains, balance.design.rate) != (design.gains, design.rate):
        raise UsageError(
            f"balance is of controller {balance.design.name!r} with other gains or another sample time than "
            f"{design.name!r}; give BalanceWhileRunning the design of the chain",
            "balance",
        )
    lowest = SLOW_ROLL * cast(tuple[float, float], balance.speeds_rpm)[0]
    for each in maps:
        if each.conditions.get("speed_rpm", 0.0) > lowest:
            raise UsageError(
                f"run-out map of {', '.join(each.sources)} was recorded at {each.conditions['speed_rpm']:g} rpm: it "
                "contains the response to the unbalance that is to be cancelled; record it at slow roll, at most "
                f"{lowest:g} rpm",
                "balance",
            )
    if balance.has_uncertainty:
        return ()
    return (ControlNote.BALANCE_UNPROVED("balance: the model states no uncertainty; its phase error is not bounded"),)


def _check_learn(learn: RecursiveFit, model: LinearModel, is_scheduled: bool, options: ChainOptions) -> None:
    """Refuse recursive estimates for another controller, or with a delayed position."""
    law = learn.tables.law
    alike = (law.A.shape, law.dt) == (model.A.shape, model.dt)
    if is_scheduled or not alike or any((getattr(law, a) != getattr(model, a)).any() for a in "ABCD"):
        raise UsageError(
            "learn is of another controller, or the controller is scheduled; give RecursiveFit the design of the "
            "chain, at one operating point (--at BAR RPM)",
            "learn",
        )
    if options.median != 1:
        raise UsageError("learn: the median delays the position by a sample; use the spike guard (median: 1)", "median")


def _controller_table(
    design: control.ControllerDesign,
) -> tuple[list[tuple[Point | None, LinearModel]], GridTable]:
    """Return the sampled controllers at the grid nodes, the operating points of the nodes, and the table of entries."""
    models: dict[Point | None, LinearModel] = {}

    def row_at(*point: float) -> FloatArray:
        model = design.sampled_at(*point)
        models[point or None] = model
        return _row(model)

    if isinstance(design.structure, control.Scheduled):
        table = table_over_domain(row_at, design.structure.domain)
    elif design.structure is None and None not in design.models:
        points = [point for point in design.models if point is not None]
        table = table_of_points(
            {point: row_at(*point) for point in points}, f"controller {design.name!r}", design.variables
        )
    else:
        table = GridTable(dict.fromkeys(SCHEDULING, ()), row_at()[None])
    _check_fields(design.name, table.axes)
    return list(models.items()), table


def _check_fields(name: str, variables: Iterable[str]) -> None:
    """Refuse scheduling variables that cannot be fields of the input in C."""
    for variable in variables:
        if variable in _FIELDS or c_name(variable) != variable:
            raise UsageError(f"controller {name!r}: the input of the chain has {variable} already; rename the variable")


def _machine_of(design: control.ControllerDesign) -> lpv.MachineData:
    """Return the machine data in the file of a design, completed from the gbid model that the design names."""
    given = {
        name: design.provenance[name] for name in lpv.MachineData.__dataclass_fields__ if name in design.provenance
    }
    machine = lpv.MachineData(**given)  # type: ignore[arg-type]
    if design.plant.isidentifier():
        with suppress(UsageError):
            return machine.filled(lpv.load_model(design.plant).machine)
    return machine


def _check_channels(name: str, inputs: tuple[str, ...], outputs: tuple[str, ...], options: ChainOptions) -> None:
    """Refuse missing limits, and options for a different number of channels."""
    n, m = len(inputs), len(outputs)
    if options.limits is None and (n, m) != (2, 2):
        raise UsageError(
            f"controller {name!r} has {n} inputs ({', '.join(inputs)}) and {m} outputs ({', '.join(outputs)}), the "
            "four stacks 2 and 2; give limits of the outputs, beyond of the inputs, and units, in ChainOptions or the "
            "section target",
            "limits",
        )
    missing = [key for key in ("stroke_m", "disc_limit_m") if options.limits is None and getattr(options, key) is None]
    if missing:
        raise UsageError(
            f"controller {name!r}: the travel of the stacks and the clearance of this machine are not known; give "
            f"{' and '.join(missing)}, in an experiment machine: piezo_travel_m and clearance_m, or with "
            "save_controller plant='theisen2016' or provenance={'piezo_travel_m': ..., 'clearance_m': ...}",
            missing[0],
        )
    for key, count in (("zero_m", n), ("beyond", n), ("spikes", n), ("limits", m), ("offsets", m)):
        given = getattr(options, key)
        if given and len(given) != count:
            raise UsageError(f"{key} has {len(given)} numbers for {count} channels of controller {name!r}", key)


def _row(model: LinearModel) -> FloatArray:
    runs_away = _largest_pole(model) > _ON_THE_CIRCLE  # refused by _check
    L = np.zeros((model.n_states, len(model.D))) if runs_away else anti_windup_gain(model)
    return np.concatenate([np.hstack([model.C, model.D]).ravel(), np.hstack([model.A, model.B, L]).ravel()])


def _largest_pole(sampled: LinearModel) -> float:
    return float(np.abs(np.linalg.eigvals(sampled.A)).max(initial=0.0)) if sampled.n_states else 0.0


def _check(design: control.ControllerDesign, sampled: LinearModel, point: Point | None) -> None:
    """Refuse an unstable controller, and a controller with poles beyond half the sampling frequency."""
    where = "" if point is None else f" at {point_label(*point, variables=design.variables)}"
    worst = _largest_pole(sampled)
    if worst > _ON_THE_CIRCLE:
        raise UsageError(
            f"controller {design.name!r}{where} is unstable by itself (a pole of magnitude {worst:.6g} in the z "
            "plane); a chain that fades in would run away: tune it with bounds that keep the controller stable"
        )
    if slow := too_slow_for(design.at() if point is None else design.at(*point), design.rate):
        raise UsageError(f"controller {design.name!r}{where}: {slow}")


def _sums(
    pattern: FloatArray, n: int, n_in: int, n_out: int
) -> tuple[tuple[tuple[SumTerm, ...], ...], tuple[tuple[SumTerm, ...], ...]]:
    """Return the sums for next states and outputs over the nonzero entries, states first."""
    place = np.cumsum(pattern) - 1
    at = 0
    sums: list[tuple[SumTerm, ...]] = []
    outputs: list[tuple[Kind, int]] = [("x", n), ("e", n_in)]
    states: list[tuple[Kind, int]] = [*outputs, ("d", n_out)]
    for kinds in [outputs] * n_out + [states] * n:
        terms = []
        for kind, size in kinds:
            for index in range(size):
                if pattern[at]:
                    terms.append(SumTerm(int(place[at]), kind, index))
                at += 1
        sums.append(tuple(terms))
    return tuple(sums[:n_out]), tuple(sums[n_out:])


def _used_maps(maps: Sequence[RunoutMap], n_in: int) -> tuple[RunoutMap, ...]:
    """Return the run-out maps that the chain uses, after checks."""
    for each in maps:
        if len(each.channels) != n_in:
            raise UsageError(
                f"run-out map of {', '.join(each.sources)} has {len(each.channels)} channels, the controller {n_in}; "
                "it is of other sensors"
            )
        numbers = (each.mean, each.cosine, each.sine, each.table)
        if not all(np.isfinite(part).all() for part in numbers):
            raise UsageError(
                f"run-out map of {', '.join(each.sources)} holds values that are not finite; make it again"
            )
    turning = tuple(each for each in maps if each.needs_angle)
    used = turning or tuple(maps)
    if len(used) > 1 and any(each.method == "bins" for each in used):
        raise UsageError(
            "several run-out maps are tables over the angle, which are not interpolated over pressure and speed; "
            "choose one operating point (--at BAR RPM), or prefilter: method: harmonics"
        )
    return used


def _harmonics_table(maps: tuple[RunoutMap, ...], scheduling: tuple[str, ...]) -> GridTable | None:
    """Return mean and harmonics of the maps as rows; None without maps or for a table over the angle."""
    if not maps or maps[0].method == "bins":
        return None
    n_orders = max((int(each.orders.max(initial=0)) for each in maps), default=0)
    names = [*SCHEDULING, *(q for q in scheduling if q not in SCHEDULING and all(q in m.conditions for m in maps))]
    rows = {}
    for each in maps:
        waves = np.zeros((n_orders, 2, len(each.mean)))
        for order, a, b in zip(each.orders, each.cosine, each.sine, strict=True):
            waves[int(order) - 1] = a, b
        point = tuple(each.conditions.get(name, 0.0) for name in names)
        if point in rows:
            where = point_label(*point, variables=names)
            raise UsageError(f"there are two run-out maps at {where}; give the maps of one encoder only")
        rows[point] = np.concatenate([each.mean, waves.ravel()])
    return table_of_points(rows, "run-out maps", names)
