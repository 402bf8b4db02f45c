"""Result of a fit: estimates, uncertainty, diagnosis, provenance; and its status."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import h5py
import numpy as np
import numpy.typing as npt
import scipy

from gbid.core import hdf5
from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief, Description, brief, estimates
from gbid.core.errors import UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.hdf5 import AS_JSON, NOT_STORED, Stored
from gbid.core.tables import Column, Entry, Row, Table
from gbid.core.units import IN_METRES
from gbid.identify.disturbances import Disturbances
from gbid.identify.fit_tables import fit_document, fit_tables
from gbid.identify.options import RunEngine, SettledOptions
from gbid.identify.uncertainty.coloured import ErrorModel
from gbid.identify.uncertainty.curves import Bode, bode
from gbid.identify.uncertainty.uncertain_model import ModelSlopes, UncertainModel
from gbid.structure import LinearModel, NonlinearModel
from gbid.structure.scheduling import Schedule

StdKind = Literal["white", "robust"]


class FitStatus(StrEnum):
    """Reason why a fit ended, with advice.

    Members are compared with each other; `success` tells whether the fit converged.
    """

    CONVERGED = "converged"
    CONVERGED_BY_PAPER_RULE = "converged: parameters changed by less than 0.0001 (the paper's rule)"
    CONVERGED_AT_ROUNDING = "converged: the errors are at rounding"
    CONVERGED_ACCEPTABLY = "converged to the solver's acceptable tolerance only"
    CONVERGED_GAIN_HELD = "converged, with the disturbance gain held"
    CONVERGED_IN_WINDOWS = (
        "converged, in windows only: the motion is so sensitive that the model, simulated from the first sample, "
        "leaves the data"
    )
    ITERATION_LIMIT = (
        "not converged: iteration limit reached; start nearer, hold or bound a parameter, or allow more iterations"
    )
    GAPS_OPEN = "not converged: no step closes the gaps between windows; try other start values"
    GAPS_CONTRADICT = "not converged: gaps between windows cannot be closed; try other start values"
    STALLED = (
        "not converged: the criterion still falls where the solver stopped; try other start values (fit_multistart), "
        "or fix a parameter that the data hardly determine"
    )
    WORSE_THAN_CONSTANT = (
        "not converged: the errors are larger than about the mean of the outputs; try other start values "
        "(fit_multistart), or estimate offsets (trend='offset')"
    )
    WORSE_THAN_START = (
        "not converged: the start values explain the data better than where the solver ended; try other start values "
        "(fit_multistart)"
    )
    WINDOWS_DISAGREE = (
        "not converged: fits in windows of other lengths end at other minima, and the residuals of the best are "
        "strongly correlated; try other start values (fit_multistart)"
    )
    NOT_DETERMINED = (
        "not determined: a free parameter has no standard deviation; fix or bound the parameters that the notes name"
    )
    GAIN_NOT_DETERMINED = (
        "not determined: a free disturbance gain led to an almost unstable predictor and was fixed, and the recordings "
        "do not show whether disturbances excite a lightly damped mode; record longer, or fix the gain (fixed=...)"
    )
    STEPS_TOO_SMALL = "not converged: steps became too small; a parameter may not be determined"
    NO_STEP = "not converged: the step cannot be computed; a parameter may not be determined"
    DIVERGED = "not converged: the iterates diverge; check bounds and start values"
    PREDICTOR_OVERFLOWS = "not converged: the predictor overflows; start from a stable model"
    OVERFLOW = "not converged: the model or predictor overflows; start from a stable model"
    UNSTABLE_PREDICTOR = (
        "not converged: the disturbance gain makes the predictor unstable, or almost so; hold it (fixed) or use "
        "focus = 'simulation'"
    )
    SHAFT_AS_MODE = "wrong mode: one is the rotation of the shaft; remove run-out and unbalance as the notes say"
    GROWS = (
        "not converged: the model grows over a recording, in which errors='ar' cannot weight its errors; "
        "start from a stable model, or use errors='white'"
    )
    SOLVER_FAILED = "not converged: the solver stopped for another reason"

    @property
    def success(self) -> bool:
        """Whether the fit converged to a valid estimate."""
        return self.name.startswith("CONVERGED")


Verdict = Literal["identifiable", "one-sided", "flat", "not a minimum"]
"""What a profile says of a parameter."""


@dataclass(frozen=True, eq=False)
class Profile(Brief, Pictured):
    """Profile likelihood of a parameter, computed by `FitResult.profile`.

    Attributes
    ----------
    name, unit : str
        Full name of the parameter, and its unit.
    estimate, std : float
        Estimate and standard deviation of the fit; of a parameter on a bound the one that it would have as a free one,
        nan for one that the data do not determine.
    level : float
        Probability of the interval.
    values : (n,) array
        Values of the parameter, ascending, with the estimate among them.
    ratios : (n,) array
        Scaled likelihood ratio of the estimate to each value; `threshold` at the ends of the interval.
    losses : (n,) array
        Loss of the fit with the parameter fixed at each value, and all others estimated. With a prior or an extra cost
        it contains theirs.
    interval : (float, float)
        Values whose ratio is below the threshold. An end is the bound of the parameter where the ratio is below the
        threshold there, and infinite where it stays below.
    verdict : {"identifiable", "one-sided", "flat", "not a minimum"}
        "identifiable": the data limit the parameter on both sides. "one-sided": on one, the other is open or ends at a
        bound. "flat": on none. "not a minimum": a constrained fit is better than the fit itself, which is to be begun
        again (`gbid.fit_multistart`).
    """

    name: str
    unit: str
    estimate: float
    std: float
    level: float
    values: Annotated[FloatArray, Stored("", "values of the parameter", "n")]
    ratios: Annotated[FloatArray, Stored("1", "scaled likelihood ratio", "n")]
    losses: Annotated[FloatArray, Stored("", "loss with the parameter fixed", "n")]
    interval: tuple[float, float]
    verdict: Verdict

    drawn_by = "plot_profile"

    @property
    def threshold(self) -> float:
        """Quantile of the chi-square distribution with one degree of freedom: 3.84 for the level 0.95."""
        return float(scipy.special.chdtri(1, 1 - self.level))


def _of_each(at: str, words: str) -> Stored:
    """Return the storage declaration of a value for each parameter, with names as an attribute."""
    return Stored("as attribute units", words, "n", f"parameters/{at}", "parameters@names")


def _texts_of_each(at: str) -> Stored:
    return Stored(shape="n", at=f"parameters@{at}", keys="parameters@names")


def _of_free(at: str, words: str) -> Stored:
    return Stored("as attribute units", f"{words}, of the free parameters", "free free", f"parameters/{at}")


@dataclass(frozen=True)
class StartsTried:
    """Numbers of tried, converged and best fits from several starts.

    Attributes
    ----------
    starts : int
        Number of starts.
    seed : int
        Seed of the random starts.
    converged : int
        Number of fits that converged.
    agreed : int
        Number of fits that ended at the best loss.
    spread : float
        Largest over smallest converged loss; inf when none converged.
    minima : tuple of float
        Losses of the distinct minima, by rising loss.
    minima_starts : tuple of int
        Number of starts that led to each of these minima.
    """

    starts: int
    seed: int
    converged: int
    agreed: int
    spread: float
    minima: tuple[float, ...] = ()
    minima_starts: tuple[int, ...] = ()


@dataclass(frozen=True)
class Phase:
    """Size of a solved problem, and the solver's iterations.

    Attributes
    ----------
    windows, gaps, unknowns, iterations : int
        Numbers of shooting windows, of continuity constraints (one for each state at a link), of unknowns, and of
        iterations.
    """

    windows: int
    gaps: int
    unknowns: int
    iterations: int


@dataclass(frozen=True, eq=False)
class FitEstimates(Brief):
    """Estimates of a fit, and its model.

    Attributes
    ----------
    structure : str
        Name of the structure.
    parameters : dict of str to float
        All parameters: estimated, fixed and unused. A local parameter has one entry ``name[group]`` for each group of
        recordings; `FitResult.parameters_of` returns those of one recording under their own names.
    units : dict of str to str
        Units of the parameters.
    free : tuple of str
        Estimated parameters, in the order of the covariance.
    local_names : dict of str to dict
        For each recording, the full names of its local parameters by their own names; empty without local parameters.
    initial_states : (n_recordings, n_states) array
        Initial state of each recording.
    model : LinearModel or NonlinearModel
        The structure at the estimates, in continuous time; with local parameters, those of the first recording. It
        simulates with the inter-sample behaviour of the fit.
    sample_time : float
        Time between samples [s]; nan where the times are irregular, and of a fit to frequency responses alone.
    schedule : Schedule or None
        Terms of the surfaces of a scheduled structure; None for constant parameters.
    disturbances : Disturbances
        Trends and hum of the outputs that were estimated along.
    error_models : tuple of ErrorModel
        Autoregression of the errors of each recording; empty for errors="white".
    """

    structure: str
    parameters: Annotated[Mapping[str, float], _of_each("estimate", "estimates in the order of the attribute names")]
    units: Annotated[Mapping[str, str], _texts_of_each("units")]
    free: Annotated[tuple[str, ...], Stored(shape="free", at="parameters@free")]
    local_names: Mapping[str, Mapping[str, str]]
    initial_states: Annotated[FloatArray, Stored("", "initial state of each recording", "recordings states")]
    model: LinearModel | NonlinearModel
    sample_time: Annotated[float, Stored("s", "time between samples")]
    schedule: Schedule | None
    disturbances: Disturbances
    error_models: tuple[ErrorModel, ...]


@dataclass(frozen=True, eq=False)
class FitUncertainty(Brief):
    """Covariance of the estimates of a fit, and derived standard deviations.

    Attributes
    ----------
    std : dict of str to float
        Standard deviations from `covariance`. They are 0 for a fixed parameter, and nan for a parameter on a bound,
        without effect for the focus, or not determined by the data (see `FitDiagnosis.notes`).
    covariance_white, covariance_robust : (n_free, n_free) array
        Covariance for white residuals, and for coloured residuals.
    trusted : {"white", "robust", "none"}
        Covariance that the whiteness test of the residuals selects; the robust one in a fit that is no estimate.
        "none" where residuals follow an input: the structure is incomplete, and no covariance contains that.
    modes_std : (n_modes, 2) array
        Standard deviations of ``model.modes()``: natural frequency [Hz] and damping factor.
    static_gain_std : (n_outputs, n_inputs) array
        Standard deviations of ``model.static_gain()``; nan for a model with a pole at zero.
    condition : float
        Condition number of the scaled information matrix; large when the data hardly separate parameters.
    model_slopes : ModelSlopes or None
        Derivatives of the matrices of the model by the free parameters, for the uncertainty of its curves.
    covariance : (n_free, n_free) array
        Covariance to use: `covariance_white` or `covariance_robust`, as `trusted` says; where it says "none", the
        robust one.
    hold_shift : (n_free,) array or None
        How far the estimates move, in their units, with exact delays and inputs on curves between samples. Where that
        is more than half a standard deviation, the covariances contain it. None where delays are exact and inputs are
        held, and where the data refute such curves.
    integration_shift : (n_free,) array or None
        How far the estimates move, in standard deviations, when the step of the integrator of a nonlinear structure or
        the pieces of a scheduled one are halved; None for any other structure, which is integrated exactly.
    profiles : dict of str to Profile
        Profile likelihoods that the option `profile` asked for, by full name.
    profiler : callable or None
        Function of `FitResult.profile`, which holds the samples of the recordings; None in a result that was loaded or
        pickled.
    """

    std: Annotated[Mapping[str, float], _of_each("std", "standard deviations; 0 fixed, nan none")]
    covariance_white: Annotated[FloatArray, _of_free("covariance_white", "covariance for white residuals")]
    covariance_robust: Annotated[FloatArray, _of_free("covariance_robust", "covariance for any residuals")]
    trusted: StdKind | Literal["none"]
    modes_std: Annotated[FloatArray, Stored("Hz and 1", "standard deviations of frequency and damping", "modes 2")]
    static_gain_std: Annotated[FloatArray, Stored("", "standard deviations of the static gain", "outputs inputs")]
    condition: Annotated[float, Stored("", "condition of the scaled information")]
    model_slopes: ModelSlopes | None
    covariance: Annotated[FloatArray, NOT_STORED] = field(default_factory=lambda: np.zeros(0))
    hold_shift: Annotated[
        FloatArray | None, Stored("SI", "shift of the free parameters with exact delays and inputs on curves", "free")
    ] = None
    integration_shift: Annotated[
        FloatArray | None, Stored("1", "shift of the free parameters with half the step of the integrator", "free")
    ] = None
    profiles: Mapping[str, Profile] = field(default_factory=dict)
    profiler: Annotated[Callable[[str, str, float], Profile] | None, NOT_STORED] = None

    def __post_init__(self) -> None:
        """Select the covariance that a stored result trusts."""
        if not self.covariance.size:
            chosen = self.covariance_white if self.trusted == "white" else self.covariance_robust
            object.__setattr__(self, "covariance", chosen)


@dataclass(frozen=True, eq=False)
class FitDiagnosis(Brief):
    """Quality of a fit: status, loss, residuals, criteria and notes.

    Attributes
    ----------
    status : FitStatus
        Status; its text gives advice when the fit did not converge.
    optimality : float or None
        First-order optimality: length of the Gauss-Newton step that would come next, in standard deviations of the
        estimates. Below 0.1 for a success.
    loss : float
        Mean squared error summed over outputs; for criterion "det" the determinant of `error_covariance`.
    error_covariance : (n_outputs, n_outputs) array
        Mean square of the errors.
    fit_percent : (n_recordings, n_outputs) array
        ``100 (1 - |y - yhat| / |y - mean y|)`` for the predictions of the focus.
    whiteness : (n_outputs,) array
        p-value of the whiteness test (Ljung-Box). Residuals count as coloured below 0.01 divided by the number of
        outputs.
    aic, fpe : float
        Akaike's information criterion and final prediction error. With errors="ar" they count the coefficients of the
        models of the errors.
    log_likelihood : float
        Gaussian log-likelihood of the errors; with errors="ar" for the models of the errors.
    notes : tuple of str
        Notes of the checks: active bounds, parameters that are not determined, and others.
    """

    status: FitStatus
    optimality: Annotated[float | None, Stored("", "next step over standard deviations")]
    loss: Annotated[float, Stored("", "criterion at the estimate")]
    error_covariance: Annotated[FloatArray, Stored("", "mean square of the errors", "outputs outputs")]
    fit_percent: Annotated[FloatArray, Stored("%", "fit, recordings by outputs", "recordings outputs")]
    whiteness: Annotated[FloatArray, Stored("", "probability of less white residuals, per output", "outputs")]
    aic: Annotated[float, Stored("", "Akaike's information criterion")]
    fpe: Annotated[float, Stored("", "final prediction error")]
    log_likelihood: Annotated[float, Stored("", "Gaussian log-likelihood of the errors")]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class FitProvenance(Brief):
    """Origin of a fit: recordings, options, start values and engine.

    Attributes
    ----------
    recordings : tuple of str
        Names of the recordings, or of the frequency responses.
    options : SettledOptions
        Options of the fit, with the choices that it made itself.
    start : dict of str to float
        Start values of the parameters.
    start_origin : dict of str to str
        Origin of each start value: ``"data"``, ``"user"`` or ``"structure"``.
    engine : {"compiled", "numpy"}
        Engine of the pass over the samples.
    iterations : int
        Number of iterations.
    phases : tuple of Phase
        Windows, gaps, unknowns and iterations of each phase of the last solution: in windows, and in one window where
        the first phase crept.
    wall_time_s : float
        Time of the whole fit [s], with start values and covariance.
    multi_start : StartsTried or None
        Counts of the fits from other starts; None for a fit from one start.
    """

    recordings: Annotated[tuple[str, ...], Stored(shape="recordings")]
    options: Annotated[SettledOptions, AS_JSON]
    start: Annotated[Mapping[str, float], _of_each("start", "start values")]
    start_origin: Annotated[Mapping[str, str], _texts_of_each("start_origin")]
    engine: RunEngine
    iterations: int
    phases: tuple[Phase, ...]
    wall_time_s: Annotated[float, Stored("s", "time that the fit took")]
    multi_start: StartsTried | None = None


T = TypeVar("T")


class InGroup(Generic[T]):
    """Descriptor that shows a field of a result's group as an attribute of the result."""

    def __init__(self, read: Callable[[FitResult], T]) -> None:
        self.read = read

    def __get__(self, result: FitResult, kind: type[FitResult]) -> T:
        return self.read(result)


@dataclass(frozen=True, eq=False)
class FitResult(Brief, Pictured, hdf5.InFile):
    """Result of a fit in four groups of fields; all fields are attributes of the result too, such as ``result.std``.

    Attributes
    ----------
    estimate : FitEstimates
        Parameters, initial states and the model.
    uncertainty : FitUncertainty
        Standard deviations, covariances and profiles.
    diagnosis : FitDiagnosis
        Status, loss, fit and notes.
    provenance : FitProvenance
        Recordings, options, start values and the way of the solver.
    """

    estimate: Annotated[FitEstimates, hdf5.INLINE]
    uncertainty: Annotated[FitUncertainty, hdf5.INLINE]
    diagnosis: Annotated[FitDiagnosis, hdf5.INLINE]
    provenance: Annotated[FitProvenance, hdf5.INLINE]

    structure = InGroup(lambda result: result.estimate.structure)
    parameters = InGroup(lambda result: result.estimate.parameters)
    units = InGroup(lambda result: result.estimate.units)
    free = InGroup(lambda result: result.estimate.free)
    local_names = InGroup(lambda result: result.estimate.local_names)
    initial_states = InGroup(lambda result: result.estimate.initial_states)
    model = InGroup(lambda result: result.estimate.model)
    sample_time = InGroup(lambda result: result.estimate.sample_time)
    schedule = InGroup(lambda result: result.estimate.schedule)
    disturbances = InGroup(lambda result: result.estimate.disturbances)
    error_models = InGroup(lambda result: result.estimate.error_models)
    std = InGroup(lambda result: result.uncertainty.std)
    covariance_white = InGroup(lambda result: result.uncertainty.covariance_white)
    covariance_robust = InGroup(lambda result: result.uncertainty.covariance_robust)
    trusted = InGroup(lambda result: result.uncertainty.trusted)
    modes_std = InGroup(lambda result: result.uncertainty.modes_std)
    static_gain_std = InGroup(lambda result: result.uncertainty.static_gain_std)
    condition = InGroup(lambda result: result.uncertainty.condition)
    model_slopes = InGroup(lambda result: result.uncertainty.model_slopes)
    covariance = InGroup(lambda result: result.uncertainty.covariance)
    hold_shift = InGroup(lambda result: result.uncertainty.hold_shift)
    integration_shift = InGroup(lambda result: result.uncertainty.integration_shift)
    profiles = InGroup(lambda result: result.uncertainty.profiles)
    profiler = InGroup(lambda result: result.uncertainty.profiler)
    status = InGroup(lambda result: result.diagnosis.status)
    optimality = InGroup(lambda result: result.diagnosis.optimality)
    loss = InGroup(lambda result: result.diagnosis.loss)
    error_covariance = InGroup(lambda result: result.diagnosis.error_covariance)
    fit_percent = InGroup(lambda result: result.diagnosis.fit_percent)
    whiteness = InGroup(lambda result: result.diagnosis.whiteness)
    aic = InGroup(lambda result: result.diagnosis.aic)
    fpe = InGroup(lambda result: result.diagnosis.fpe)
    log_likelihood = InGroup(lambda result: result.diagnosis.log_likelihood)
    notes = InGroup(lambda result: result.diagnosis.notes)
    recordings = InGroup(lambda result: result.provenance.recordings)
    options = InGroup(lambda result: result.provenance.options)
    start = InGroup(lambda result: result.provenance.start)
    start_origin = InGroup(lambda result: result.provenance.start_origin)
    engine = InGroup(lambda result: result.provenance.engine)
    iterations = InGroup(lambda result: result.provenance.iterations)
    phases = InGroup(lambda result: result.provenance.phases)
    wall_time_s = InGroup(lambda result: result.provenance.wall_time_s)
    multi_start = InGroup(lambda result: result.provenance.multi_start)

    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("fit", "make the fit anew", 4)

    def __post_init__(self) -> None:
        """Give the model the inter-sample behaviour of the fit; a loop's model is sampled and has it already."""
        model = self.estimate.model
        if model.intersample is None and getattr(model, "dt", None) is None:
            model = replace(model, intersample=self.provenance.options.intersample)
            object.__setattr__(self, "estimate", replace(self.estimate, model=model))

    def changed(self, **values: Any) -> FitResult:
        """Return the result with changed fields of its groups.

        Parameters
        ----------
        **values
            New values by the names of the fields, such as ``notes=()``.
        """
        groups = {}
        for each in fields(self):
            group = getattr(self, each.name)
            own = {name: values.pop(name) for name in vars(group).keys() & values}
            groups[each.name] = replace(group, **own)
        if values:
            raise TypeError(f"a fit result has no field {', '.join(values)}; see dir(result)")
        return FitResult(**groups)

    def noted(self, *notes: str) -> FitResult:
        """Return the result with additional notes.

        Parameters
        ----------
        *notes : str
            The notes, after those that it has.
        """
        return self.changed(notes=(*self.diagnosis.notes, *notes)) if notes else self

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write this fit and its success to the `group`."""
        hdf5.write_fields(group, self)
        hdf5.add_attribute(group, "success", np.array(self.success))

    @staticmethod
    def covariance_in(group: h5py.Group) -> FloatArray:
        """Return the covariance that a fit trusts, from its HDF5 `group`."""
        kind = "white" if hdf5.read_text(group, "trusted") == "white" else "robust"
        return hdf5.read_dataset(group, f"parameters/covariance_{kind}")

    def _brief(self) -> Description:
        modes = zip(self.model.modes(), self.modes_std, strict=True)
        return brief(
            self,
            f"{self.structure}, {self.status}",
            recordings=self.recordings,
            fit_percent=self.fit_percent,
            parameters=estimates(self.parameters, self.std, self.free),
            modes=[f"{f:.2f} +- {df:.2g} Hz, damping {z:.4f} +- {dz:.2g}" for (f, z), (df, dz) in modes],
            errors=self.error_models and [f"autoregression of order {m.order}" for m in self.error_models],
            notes=self.notes,
        )

    def table(self) -> Table:
        """Return a table of parameters: estimate, standard deviation, unit, start value and its origin."""
        columns = [Column(name) for name in ("parameter", "value", "std", "unit", "start", "start from")]
        columns[1:3] = [Column("value", format=5), Column("std", format=2)]
        rows: list[list[Entry]] = [
            [name, value, self.std[name], self.units[name], self.start[name], self.start_origin[name]]
            for name, value in self.parameters.items()
        ]
        return Table("", columns, rows)

    _in_tables = ("parameters",)

    def document(self) -> Row:
        """Return estimates, uncertainty and diagnosis as plain values, for JSON."""
        return fit_document(self)

    def tables(self) -> list[Table]:
        """Return the tables of parameters, modes, static gains, profile likelihoods, and a summary."""
        return fit_tables(fit_document(self))

    def figures(self) -> list[Figure]:
        """Return the frequency response, and the profile likelihoods where the fit has them."""
        verdicts = ", ".join(f"{name} {profile.verdict}" for name, profile in self.profiles.items())
        profiles = [Figure("plot_profile", f"Profile likelihoods: {verdicts}", (self.profiles,))]
        shown = Figure("plot_bode", f"Frequency response of {self.structure} with confidence bands", (self,))
        return [shown, *(profiles if self.profiles else [])]

    def to_frame(self) -> Any:
        """Return a data frame of parameters: value, standard deviation, unit, start value and its origin.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return self.table().to_frame().set_index("parameter")

    @property
    def success(self) -> bool:
        """Whether the fit converged to a valid estimate: finite, settled, determined, better than a constant."""
        return self.status.success

    @property
    def linear_model(self) -> LinearModel:
        """Linear model; for a nonlinear structure linearised at the working point."""
        return self.model.linearise()

    @property
    def uncertain_model(self) -> UncertainModel:
        """Model with the derivatives of its matrices and the covariance of the parameters."""
        model = self.linear_model
        units = dict.fromkeys((*model.input_names, *model.output_names), "m") if self.structure in IN_METRES else {}
        sample_time = None if np.isnan(self.sample_time) else self.sample_time  # see its attribute
        return UncertainModel(model, self.model_slopes, self.covariance, sample_time, units)

    def bode(self, frequency_hz: npt.ArrayLike | None = None) -> Bode:
        """Return the frequency response of the model with standard deviations from `covariance`.

        Parameters
        ----------
        frequency_hz : (n,) array, optional
            Frequencies above zero [Hz], ascending; by default a grid that is dense around the poles.

        Returns
        -------
        Bode
            Complex values, magnitude and phase with standard deviations for each pair of input and output.
            `gbid.report.plot_bode` draws it.

        Raises
        ------
        UsageError
            When a frequency is not above zero, or when an undamped pole lies exactly on it.
        """
        return bode(self.uncertain_model, frequency_hz)

    def profile(self, name: str, level: float = 0.95) -> Profile:
        """Return the profile likelihood of one parameter; `gbid.profile` computes several.

        Parameters
        ----------
        name : str
            Full name of the parameter, one of `free`.
        level : float
            Probability of the interval.

        Returns
        -------
        Profile

        Raises
        ------
        UsageError
            When the parameter was not estimated, the fit did not converge, or the result was loaded from a file and
            has no such profile.
        """
        if name not in self.free:
            raise UsageError(f"{name} is no estimated parameter; choose from {', '.join(self.free)}")
        if not 0 < level < 1:
            raise UsageError(f"level = {level!r}; give a probability between 0 and 1, such as 0.95")
        if name in self.profiles and self.profiles[name].level == level:
            return self.profiles[name]
        if self.error_models:
            raise UsageError("profiles are for errors='white'")
        if not self.may_be_profiled:
            raise UsageError(f"a profile begins at a minimum, and this fit is {self.status}")
        if self.profiler is None:
            raise UsageError(
                "a profile needs the recordings, which a result from a file or another process does not have; give "
                "them: gbid.profile(result, structure=..., recordings=...)"
            )
        return self.profiler(name, self.units[name], level)

    @property
    def may_be_profiled(self) -> bool:
        """Whether the fit ended at a minimum of the criterion, even one with flat directions."""
        return self.success or self.status is FitStatus.NOT_DETERMINED

    @property
    def own_names(self) -> dict[str, str]:
        """Names in the structure of the local parameters, by full name."""
        return {full: short for names in self.local_names.values() for short, full in names.items()}

    def parameters_of(self, recording: str) -> dict[str, float]:
        """Return the parameters of one recording by their names in the structure.

        Parameters
        ----------
        recording : str
            Name of the recording.

        Returns
        -------
        dict of str to float
            Values by name.

        Raises
        ------
        KeyError
            When the recording was not part of the fit.
        """
        if recording not in self.recordings:
            raise KeyError(f"recording {recording!r} was not fitted; choose from {', '.join(self.recordings)}")
        local = self.own_names
        shared = {name: value for name, value in self.parameters.items() if name not in local}
        full_names = self.local_names.get(recording, {})
        return {**shared, **{name: self.parameters[full] for name, full in full_names.items()}}

    def std_with(self, kind: StdKind) -> dict[str, float]:
        """Return standard deviations from a chosen kind of covariance.

        Parameters
        ----------
        kind : {"white", "robust"}
            Covariance to use.

        Returns
        -------
        dict of str to float
            Standard deviations by name.
        """
        chosen = self.covariance_white if kind == "white" else self.covariance_robust
        sigma = dict(zip(self.free, np.sqrt(np.diag(chosen)).tolist(), strict=True))
        return {
            name: sigma[name] if name in sigma and np.isfinite(value) else value for name, value in self.std.items()
        }
