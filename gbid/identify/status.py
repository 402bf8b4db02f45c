"""Status of a fit: the reason why the solver stopped."""

from __future__ import annotations

from enum import StrEnum


class FitStatus(StrEnum):
    """Reason why a solver stopped, with advice.

    Members are compared with each other; `success` tells whether the fit converged.
    """

    CONVERGED = "converged"
    CONVERGED_BY_PAPER_RULE = "converged: parameters changed by less than 0.0001 (the paper's rule)"
    CONVERGED_AT_ROUNDING = "converged: the errors are at rounding"
    CONVERGED_ACCEPTABLY = "converged to the solver's acceptable tolerance only"
    CONVERGED_GAIN_HELD = "converged, with the disturbance gain held"
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
    NOT_DETERMINED = "not determined: a free parameter has no standard deviation; fix or bound what the notes name"
    STEPS_TOO_SMALL = "not converged: steps became too small; a parameter may not be determined"
    NO_STEP = "not converged: the step cannot be computed; a parameter may not be determined"
    DIVERGED = "not converged: the iterates diverge; check bounds and start values"
    PREDICTOR_OVERFLOWS = "not converged: the predictor overflows; start from a stable model"
    OVERFLOW = "not converged: the model or predictor overflows; start from a stable model"
    UNSTABLE_PREDICTOR = (
        "not converged: the disturbance gain makes the predictor unstable, or almost so; hold it (fixed) or use "
        "focus = 'simulation'"
    )
    SOLVER_FAILED = "not converged: the solver stopped for a reason of its own"

    @property
    def success(self) -> bool:
        """Whether the fit converged to an estimate."""
        return self in _SUCCESSES


_SUCCESSES = frozenset(
    {
        FitStatus.CONVERGED,
        FitStatus.CONVERGED_BY_PAPER_RULE,
        FitStatus.CONVERGED_AT_ROUNDING,
        FitStatus.CONVERGED_ACCEPTABLY,
        FitStatus.CONVERGED_GAIN_HELD,
    }
)
