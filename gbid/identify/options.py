"""Options of a fit: arguments of `gbid.fit`, keys of a YAML section, stored with the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Count, Exact, Finite, Number, Positive, check_options, plain
from gbid.discretise import Hold

Focus = Literal["prediction", "simulation"]
Criterion = Literal["trace", "det"]
Scope = Literal["recording", "operating_point"]
LossName = Literal["huber", "student"]
ErrorsName = Literal["white", "ar"]
Stop = Literal["tolerance", "paper"]
RunEngine = Literal["compiled", "numpy"]
HIGHEST_DEGREE = 9
TrendName = Literal["none", "offset", "linear", "random walk"] | Annotated[int, Exact(), Ge(0), Le(HIGHEST_DEGREE)]
OwnState = Literal["estimated", "zero", "structure"] | Sequence[Number | Literal["estimated", "structure"]]
InitialState = Literal["auto"] | OwnState | Mapping[str, OwnState]
STATES = (
    "the word auto, estimated, zero or structure, a list of numbers and of the words estimated and structure, or one "
    "for each recording"
)
TRENDS = f"none, offset, linear, random walk, or a degree from 0 to {HIGHEST_DEGREE}, also for each output"
ExtraCost = Callable[[Any, Any], Any]
"""``extra_cost(p, x0)``, an expression."""
Constraints = Callable[[Any, Any], Sequence[tuple[float, Any, float]]]
"""``constraints(p, x0)``, expressions between their bounds."""


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of a fit that are stored with its result.

    Attributes
    ----------
    inputs, outputs : str or sequence of str, optional
        Signals (``"p"``) or channels (``"p.x"``) of the recordings; by default those of the structure. ``inputs=()`` is
        a free decay: the inputs of the structure are zero throughout. An input that is zero or constant in a recording
        means the same there.
    focus : {"prediction", "simulation"}
        Errors of the prediction with the disturbance gain, or of the simulation without measured outputs.
    intersample : {"zoh", "foh"} or sequence, optional
        Behaviour of the inputs between samples; by default that of the structure.
    criterion : {"auto", "trace", "det"}
        Mean squared error summed over outputs (the paper's), or determinant of the mean square matrix of the errors,
        which weights each output by its errors. "auto" is "det" for several outputs without `output_weights`.
    output_weights : sequence of float, optional
        Weight of the squared error of each output in the trace; default ones.
    start : dict of str to float, or "data", optional
        Start values. Others come from the structure, or from the data where the structure states none. With "data" all
        come from the data, also those that the structure states.
    fixed : dict of str to float, optional
        Parameters with fixed values. A disturbance gain fixed at 0 is left out of the model.
    bounds : dict of str to (lower, upper), optional
        Bounds that replace those of the structure.
    prior : dict of str to (value, std), optional
        Prior knowledge of parameters as normal distributions, in the units of the parameters.
    local : dict of str to {"recording", "operating_point"}, optional
        Parameters with a separate value for each recording or operating point.
    robust : {"huber", "student"}, optional
        Loss for data with outliers; by default squared errors. A sample counts less the larger its errors are compared
        with the others. The loss and `error_covariance` of the result are those of all samples, as without it.
    robust_threshold : float, optional
        Huber: errors in standard deviations up to which a sample counts in full. Student: degrees of freedom. By
        default the standard deviations are 2.6 % larger than with squared errors, when the errors are normal.
    errors : {"white", "ar"}
        Model of the errors of a simulation. "ar": a vector autoregression for each recording, whose order is Akaike's
        choice, from the residuals. It filters errors and sensitivities, and is estimated again until the estimates are
        at rest (generalised least squares). `criterion` is then that of the least squares at which this begins.
    profile : sequence of str or "all"
        Parameters of the structure whose profile likelihoods are computed and stored with the result, see
        `gbid.profile`; "all" takes twelve times the time of the fit for 24 parameters.
    trend : {"none", "offset", "linear", "random walk"}, int or dict
        Trend of the outputs, estimated along for each recording: a polynomial of time of this degree (0 to 9), or an
        offset that is a random walk, whose gain is estimated. A dict has an entry for each output channel with a trend.
    hum : float or sequence of float
        Known frequencies [Hz] of sinusoids in all outputs, whose amplitudes are estimated along for each recording.
    initial_state : {"auto", "estimated", "zero", "structure"}, sequence or dict
        Initial state of each recording: estimated, or ``x0`` of the structure, a function of the parameters. "auto" is
        "structure" when the structure gives `x0`, else "estimated"; in a `ClosedLoop` delays begin at rest. A
        sequence has a number, ``"estimated"`` or ``"structure"`` for each state. A dict gives one of these to each
        recording by name.
    left_out : dict of str to sequence of (start, stop), optional
        Samples of recordings, by name, whose errors do not count (a rub, a dropout). The model is simulated there.
    window : int, None or "auto"
        Number of samples in a shooting window; None is single shooting. "auto" is about 256 (prediction) or 128
        (simulation), and tries other lengths when that fit does not converge. In an unstable model they are shorter, so
        that it grows tenfold at most in one.
    stop : {"tolerance", "paper"}
        "tolerance": steps far below the uncertainty of the estimates, or the tolerance of IPOPT. "paper": relative
        change below 1e-4.
    max_iterations : int
        Largest number of iterations.
    ipopt : dict, optional
        Options of IPOPT by name, such as ``{"print_level": 5}``. They replace those of gbid.
    """

    inputs: str | Sequence[str] | None = None
    outputs: str | Sequence[str] | None = None
    focus: Focus = "prediction"
    intersample: Hold | Sequence[Hold] | None = None
    criterion: Criterion | Literal["auto"] = "auto"
    output_weights: Annotated[Sequence[Positive], Allowed("a positive number for each output")] | None = None
    start: Annotated[Mapping[str, Finite] | Literal["data"], Allowed("values by name, or the word data")] | None = None
    fixed: Mapping[str, Finite] | None = None
    bounds: Mapping[str, tuple[Number, Number]] | None = None
    prior: Mapping[str, tuple[Number, Number]] | None = None
    local: Mapping[str, Scope] | None = None
    robust: LossName | None = None
    robust_threshold: Positive | None = None
    errors: ErrorsName = "white"
    profile: Annotated[Literal["all"] | Sequence[str], Allowed("names of parameters, or the word all")] = ()
    trend: Annotated[TrendName | Mapping[str, TrendName], Allowed(TRENDS)] = "none"
    hum: Annotated[Number | Sequence[Number], Allowed("frequencies [Hz]")] = ()
    initial_state: Annotated[InitialState, Allowed(STATES)] = "auto"
    left_out: Mapping[str, Sequence[tuple[int, int]]] | None = None
    window: Annotated[int, Exact(), Ge(2)] | Literal["auto"] | None = "auto"
    stop: Stop = "tolerance"
    max_iterations: Count = 100
    ipopt: Mapping[str, str | float] | None = None

    def __post_init__(self) -> None:
        check_options(self)
        if self.robust_threshold is not None and self.robust is None:
            raise UsageError("robust_threshold is for robust = 'huber' or 'student'; give one of them, too")
        if self.errors == "ar":
            if self.focus != "simulation":
                raise UsageError("errors = 'ar' is for focus = 'simulation'; in a prediction, free a disturbance gain")
            for name in ("robust", "output_weights"):
                if getattr(self, name) is not None:
                    raise UsageError(f"errors = 'ar' weights the errors itself; leave {name} out")


@dataclass(frozen=True, kw_only=True)
class FitArguments(FitOptions):
    """Options of a call of `gbid.fit`: the stored `FitOptions`, and functions, which are not stored.

    Attributes
    ----------
    extra_cost : callable, optional
        ``extra_cost(p, x0)`` returns a CasADi expression that is added to the negative log-likelihood. `p` has the
        parameters by name, ``x0["run 1"]`` is the initial state of a recording. ``((p.k - 3) / 0.1) ** 2 / 2`` is the
        prior ``(3, 0.1)`` of k.
    constraints : callable, optional
        ``constraints(p, x0)`` returns a list of ``(lower, expression, upper)``. Equal bounds are an equation.
    progress : callable, optional
        Function that is called with a `Progress` at each iteration. What it raises ends the fit, and is raised again.
        ``progress=True`` in a call of `gbid.fit` shows them on one line of standard error.
    """

    extra_cost: ExtraCost | None = None
    constraints: Constraints | None = None
    progress: Callable[[Any], None] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.errors == "ar" and (self.extra_cost or self.constraints):
            raise UsageError("extra_cost and constraints are for errors = 'white'; give priors and bounds")

    def settled(self, **choices: Any) -> SettledOptions:
        """Return the options without functions, with the choices that the fit made."""
        values = {field.name: getattr(self, field.name) for field in fields(FitOptions)} | choices
        return SettledOptions(**{name: plain(value) for name, value in values.items()})


@dataclass(frozen=True, kw_only=True)
class SettledOptions(FitOptions):
    """Options of a fit with the choices that the fit made; stored with its result.

    Attributes
    ----------
    inputs, outputs : tuple of str
        Signals or channels.
    intersample : tuple of {"zoh", "foh"}
        Behaviour between samples of each input channel.
    criterion : {"trace", "det"}
        Criterion.
    window : int or None
        Number of samples in a shooting window; None for one window per recording.
    """

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    intersample: tuple[Hold, ...] = ()
    criterion: Criterion = "trace"
    window: int | None = None
