"""Covariance of the estimates, for white and coloured residuals; standard deviations of modes and static gain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray, IntArray, one_of_each_pair, oscillatory_modes, poles_of_samples
from gbid.discretise.dual import Dual
from gbid.identify.kernel.blocks import Blocks, cut
from gbid.identify.kernel.sample import NonlinearPredictor
from gbid.identify.kernel.sums import Lagrangian, Sweep, Traced, by_segments, tied
from gbid.identify.predictor import Predictor, PredictorValues, matrices_with_slopes
from gbid.identify.problem.hessian import PartHessian, in_one_window, omitted_part, passed_on
from gbid.identify.problem.integration import linearised
from gbid.identify.problem.nlp import RecordGroup, Shooting
from gbid.identify.uncertainty.coloured import (
    ErrorModel,
    OnDemand,
    RecordSensitivities,
    Transform,
    Whitening,
    score_covariance,
    transformed,
    whitened,
)
from gbid.identify.uncertainty.uncertain_model import ModelSlopes, std_of
from gbid.recording.recording import without_gaps

_GROWTH = 1e3  # of a model over a record, up to which one pass over the record is accurate


@dataclass(frozen=True, eq=False)
class Estimate:
    """Point of a fit at which information and covariance are evaluated.

    Attributes
    ----------
    problem : Shooting
        Problem of the fit.
    theta : (n_p,) array
        Free parameters.
    starts : (n_windows, n) array
        Initial states of the windows.
    record_window : (n_records,) integer array
        First window of each record.
    known_starts : (n_records, n) boolean array, optional
        Initial states that were given instead of estimated; by default none.
    filters : tuple of Whitening
        Filters of errors and sensitivities, for each record; empty where its errors count as they are.
    """

    problem: Shooting
    theta: FloatArray
    starts: FloatArray
    record_window: IntArray
    known_starts: BoolArray | None = None
    filters: tuple[Whitening, ...] = ()

    @property
    def n_all(self) -> int:
        """Number of parameters plus initial states of all records."""
        return self.problem.n_theta + len(self.record_window) * self.problem.n_states

    @property
    def given(self) -> BoolArray:
        """Initial states that were given, not estimated, (n_records, n)."""
        none = np.zeros((len(self.record_window), self.problem.n_states), bool)
        return none if self.known_starts is None else self.known_starts

    @cached_property
    def segments(self) -> dict[int, tuple[int, int]]:
        """Part and position of each segment, by the index of its first window over all parts."""
        firsts = zip(self.problem.parts, self.problem.first_window[:-1].tolist(), strict=True)
        return {
            first + window: (k, i)
            for k, (part, first) in enumerate(firsts)
            for i, window in enumerate(part.blocks.segment_first.tolist())
        }

    def parts(self) -> Iterator[tuple[Any, RecordGroup, FloatArray]]:
        """Return for each part its predictor at the estimates, the part, and the starts of its windows."""
        return self.problem.each(self.problem.values(self.theta), self.starts)


def grows(at: Estimate) -> bool:
    """Return whether the model grows so much over a record that sensitivities need separate windows."""
    longest = max(segment.outputs.shape[0] for part in at.problem.parts for segment in part.blocks.segments)
    problem, on_the_way = at.problem, 0.0
    if isinstance(problem.parts[0].predictor, NonlinearPredictor):  # its growth may decay again
        on_the_way, _ = passed_on(problem, at.theta, at.starts)
    rate = problem.rate(at.theta, at.starts)
    return bool(np.log(max(rate, np.finfo(float).tiny)) * longest > np.log(_GROWTH)) or on_the_way > _GROWTH


_BLOCK = 64  # samples of a block of the pass
_CLOSED = 1e-6  # largest gap of the windows, in units of the states' size, with which a pass is one over whole records

Chains = dict[int, tuple[FloatArray, int]]
"""Sensitivity of the state at the start of a segment by all unknowns, (n, n_all), and its record, by first window."""


class Information(NamedTuple):
    """Hessian of ``sum e' W e / 2`` with respect to parameters and initial states of all records.

    Attributes
    ----------
    hessian : (n_all, n_all) array
        Gauss-Newton Hessian.
    shaped : (n_all, n_all) array
        Gauss-Newton Hessian with another weight.
    observed : (n_all, n_all) array or None
        Exact Hessian in the columns of the parameters.
    sensitivities : sequence of RecordSensitivities
        Sensitivities of the predictions of each record, which are made when they are asked for.
    """

    hessian: FloatArray
    shaped: FloatArray
    observed: FloatArray | None
    sensitivities: Sequence[RecordSensitivities]


def information_over_records(
    at: Estimate, weight: FloatArray, *, shaped: FloatArray | None = None, observed: bool = False, block: int = _BLOCK
) -> Information:
    """Return the information of all records, from a pass over whole segments.

    Parameters
    ----------
    at : Estimate
        The estimates.
    weight : (n_y, n_y) array
        Weight W of the errors.
    shaped : (n_y, n_y) array, optional
        Another weight, for a second Gauss-Newton Hessian.
    observed : bool
        Whether the exact Hessian is computed.
    block : int
        Largest number of samples of a block, for which gradients are summed.

    Returns
    -------
    Information
        Derivatives by parameters and initial states.
    """
    problem, weights = at.problem, [weight] if shaped is None else [weight, shaped]
    cuts, passes = [], []
    for v, part, starts in at.parts():
        if observed or part.blocks.length < block:  # sensitivities are made of short blocks
            cuts.append(cut(part.blocks.segments, part.predictor, None, longest_block=block))
            part.blocks.release()
        else:
            cuts.append(part.blocks.by_whole_segments())
        passes.append(part.kernel.trace(v, cuts[-1], starts[part.blocks.segment_first], weights))
    sums = [[tied(each.sums, part.tie) for each in made] for part, made in zip(problem.parts, passes, strict=True)]
    by_weight = list(zip(*sums, strict=True))
    chains = _chains(at, by_weight[0])
    if observed:
        for blocks in cuts:
            blocks.release()
        omitted = _omitted(at, by_weight[0], weight)
        problem.release()
        more = [_symmetric(each, part.tie) for part, each in zip(problem.parts, omitted, strict=True)]
        exact = (
            replace(s, hessian=s.hessian + each.theta, hessian_mixed=s.hessian_mixed + each.mixed)
            for s, each in zip(by_weight[0], more, strict=True)
        )
        by_weight.append(tuple(exact))
    totals = [_total(at, each, chains) for each in by_weight]
    sensitivities = _sensitivities(at, cuts, [made[0] for made in passes], chains)
    return Information(totals[0], totals[len(weights) - 1], totals[-1] if observed else None, sensitivities)


def information_of_last_pass(at: Estimate, *, shaped: FloatArray | None = None) -> Information | None:
    """Return the Gauss-Newton information of all records from the fit's last pass over windows.

    It has no sensitivities. None where windows have gaps.

    Parameters
    ----------
    at : Estimate
        The estimates.
    shaped : (n_y, n_y) array, optional
        Another weight, for a second Gauss-Newton Hessian, which needs a pass of its own.
    """
    problem, iterate = at.problem, at.problem.at_physical(at.theta, at.starts)
    if not np.abs(iterate.gaps).max(initial=0.0) < _CLOSED:
        return None
    passes = [iterate.sweeps]
    if shaped is not None:
        passes.append(tuple(problem.sweeps(problem.values(at.theta), at.starts, shaped)))
    by_part = zip(problem.parts, zip(*passes, strict=True), strict=True)
    sums = list(zip(*(by_segments(part.blocks, each) for part, each in by_part), strict=True))
    chains = _chains(at, sums[0])
    totals = [_total(at, each, chains) for each in sums]
    totals[0] *= iterate.factor
    return Information(totals[0], totals[-1], None, ())


def _chains(at: Estimate, sums: Sequence[Sweep]) -> Chains:
    """Propagate sensitivities from segment to segment of a record, across left-out stretches."""
    problem, n = at.problem, at.problem.n_states
    chains: Chains = {}
    for record, window in enumerate(at.record_window):
        T = np.zeros((n, at.n_all))
        T[:, problem.n_theta + record * n : problem.n_theta + (record + 1) * n] = np.eye(n)
        chains[int(window)] = T, record
    firsts = sorted(at.segments)
    for a, b in problem.links.tolist():
        if b in at.segments:  # a segment is entered only at its first window
            window = firsts[np.searchsorted(firsts, a, side="right") - 1]
            (k, i), (T, record) = at.segments[window], chains[window]
            following = sums[k].end_start[i] @ T
            following[:, problem.parts[k].index] += sums[k].end_theta[i]
            chains[b] = following, record
    return chains


def _sensitivities(
    at: Estimate, cuts: Sequence[Blocks], passes: Sequence[Traced], chains: Chains
) -> OnDemand[RecordSensitivities]:
    """Return the prediction sensitivities of the records."""
    passed = [_Passed(*each) for each in zip(at.parts(), cuts, passes, strict=True)]

    def of_segment(window: int) -> _SegmentSensitivities:
        k, i = at.segments[window]
        return passed[k].window(i, chains[window][0])._replace(feedback=passed[k].feedback)

    records: list[list[int]] = [[] for _ in at.record_window]
    for window in sorted(at.segments):
        records[chains[window][1]].append(window)
    return OnDemand(lambda i: _joined([of_segment(window) for window in records[i]]), len(records))


class _Passed:
    """Part of a problem after a pass over its windows; sensitivities are computed for each window on request."""

    def __init__(self, part: tuple[Any, RecordGroup, FloatArray], blocks: Blocks, traced: Traced) -> None:
        self._v, self._part, _ = part
        self._blocks, self._linked = blocks, traced.linked
        self._prediction = self._part.kernel.passed(self._v, blocks, traced.begin)

    @cached_property
    def feedback(self) -> PredictorValues | None:
        """Predictor with feedback of measured outputs, and its derivatives with respect to the unknowns."""
        if not self._part.predictor.feeds_back:
            return None
        v, tie = self._part.kernel.feedback(self._v, self._blocks, self._prediction), self._part.tie
        if tie is None:
            return v
        dF, dG, dC, dH = (np.tensordot(tie.T, slope, 1) for slope in (v.dF, v.dG, v.dC, v.dH))
        return v._replace(dF=dF, dG=dG, dC=dC, dH=dH)

    def window(self, i: int, start: FloatArray) -> _SegmentSensitivities:
        """Return the sensitivities of a window; `start` (n, n_all) are the sensitivities of its first state."""
        part, blocks = self._part, self._blocks
        some = slice(int(blocks.window_first[i]), int(blocks.window_first[i] + blocks.window_size[i]))
        n_samples, n_y, tie = int(blocks.size[some].sum()), blocks.y.shape[2], part.tie
        psi = part.kernel.sensitivities(self._v, blocks, self._prediction, self._linked, some)
        psi = psi.reshape(n_y, psi.shape[0] // n_y, -1)[:, :, :n_samples]
        if tie is not None:
            by_theta = np.einsum("op,yot->ypt", tie, psi[:, : len(tie)], optimize=True)
            psi = np.concatenate([by_theta, psi[:, len(tie) :]], axis=1)
        errors, used = (
            blocks.side_by_side(values, some).transpose(2, 0, 1).reshape(-1, values.shape[2])[:n_samples]
            for values in (self._prediction.errors, blocks.used[:, :, None])
        )
        counted = used[:, 0] > 0
        segment, first = blocks.window_samples[i]
        if segment.missing is not None:  # their sensitivities are zero; the colour is that of the errors around
            missing = segment.missing[first : first + n_samples]
            errors = without_gaps(np.where(missing & (errors == 0), np.nan, errors))[0]
            counted = counted | missing.all(axis=1)
        return _SegmentSensitivities(psi, errors, counted, part.index, start)


class _SegmentSensitivities(NamedTuple):
    """Sensitivities of a segment to its part's unknowns and its first state.

    Attributes
    ----------
    psi : (n_y, n_p + n, n_samples) array
        Derivatives of the predictions.
    errors, counted : (n_samples, n_y) and (n_samples,) array
        As of `RecordSensitivities`.
    places : (n_p,) integer array
        Positions of the part's unknowns.
    start : (n, n_all) array
        Derivatives of the state at the start by all unknowns.
    feedback : PredictorValues or None
        Predictor that feeds measured outputs back.
    """

    psi: FloatArray
    errors: FloatArray
    counted: BoolArray
    places: IntArray
    start: FloatArray
    feedback: PredictorValues | None = None


def _joined(segments: Sequence[_SegmentSensitivities]) -> RecordSensitivities:
    """Return the sensitivities of a record to the unknowns that affect it, from its segments in order."""
    fed = [(each.feedback, each.places) for each in segments if each.feedback is not None]
    only, moving = segments[0], np.flatnonzero(segments[0].start.any(axis=0))
    if len(segments) == 1 and np.array_equal(only.start[:, moving], np.eye(len(only.start))):  # the initial state
        columns, psi = np.concatenate([only.places, moving]), only.psi
        place = np.arange(len(only.places))
    else:
        touched = np.any([each.start.any(axis=0) for each in segments], axis=0)
        touched[np.concatenate([each.places for each in segments])] = True
        columns, order, stretches = np.flatnonzero(touched), np.cumsum(touched) - 1, []
        for each in segments:
            n_p = len(each.places)
            stretches.append(each.start[:, columns].T @ each.psi[:, n_p:])
            stretches[-1][:, order[each.places]] += each.psi[:, :n_p]
        psi, place = np.concatenate(stretches, axis=2), order[fed[-1][1]] if fed else order
    errors, counted = (np.concatenate(parts) for parts in zip(*((s.errors, s.counted) for s in segments), strict=True))
    return RecordSensitivities(columns, psi, errors, counted, (fed[-1][0], place) if fed else None)


def _symmetric(omitted: PartHessian, tie: FloatArray | None) -> PartHessian:
    """Return the symmetrised second-order term with respect to the unknowns of the problem."""
    theta = (omitted.theta + omitted.theta.T) / 2
    return PartHessian(theta, omitted.mixed) if tie is None else PartHessian(tie.T @ theta @ tie, tie.T @ omitted.mixed)


def _total(at: Estimate, sums: Sequence[Sweep], chains: Chains) -> FloatArray:
    """Return the Hessian with respect to all unknowns (n_all, n_all); chains convert segment starts."""
    total = np.zeros((at.n_all, at.n_all))
    for part, first, sweep in zip(at.problem.parts, at.problem.first_window[:-1], sums, strict=True):
        index = part.index
        total[np.ix_(index, index)] += sweep.hessian
        for window, mixed, of_start in zip(
            part.blocks.segment_first, sweep.hessian_mixed, sweep.hessian_start, strict=True
        ):
            T, _ = chains[int(first + window)]
            places = np.flatnonzero(T.any(axis=0))  # few: the initial states of other records do not move this start
            T = T[:, places]
            across = mixed @ T
            total[np.ix_(index, places)] += across
            total[np.ix_(places, index)] += across.T
            total[np.ix_(places, places)] += T.T @ of_start @ T
    return total


def _omitted(at: Estimate, sums: Sequence[Sweep], weight: FloatArray) -> list[PartHessian]:
    """Return the second-order term of the Hessian for all parameters, with one window for each segment."""
    joined, kept = in_one_window(at.problem)
    _, starts = joined.unpack(at.problem.pack(at.theta, at.starts)[kept])
    ends, values = np.zeros_like(starts), at.problem.values(at.theta)
    for _ in joined.links:  # backwards from the last segments: derivative of the cost by the ends of segments
        gradients = joined.gradients(values, Lagrangian(starts, ends, weight))
        ends[joined.links[:, 0]] = np.concatenate([by_start for _, by_start in gradients])[joined.links[:, 1]]
    return omitted_part(joined, at.theta, Lagrangian(starts, ends, weight), [np.diag(s.hessian) for s in sums])


# Over a whole record the sensitivities by the initial state of an unstable model grow without bound. Within a window
# they do not. So the state at the start of each window is written as a bounded function of the parameters and of a few
# further coordinates: of all trajectories that close the gaps, those of least norm, and an orthonormal basis of the
# free ones. The coordinates stand for the initial states. The covariance of the parameters does not depend on this
# choice.


def windowed_records(at: Estimate) -> Iterator[RecordSensitivities]:
    """Yield each record's sensitivities to all parameters and to coordinates of its free trajectories.

    All gaps between windows are to be closed.
    """
    problem, n, n_p = at.problem, at.problem.n_states, at.problem.n_theta
    passed, sums = [], []
    for v, part, starts in at.parts():
        (traced,) = part.kernel.trace(v, part.blocks, starts, [np.eye(part.blocks.y.shape[2])])
        passed.append(_Passed((v, part, starts), part.blocks, traced))
        sums.append(tied(traced.sums, part.tie))
    for record, (first, known) in enumerate(zip(at.record_window, at.given, strict=True)):
        chain = problem.windows_from(first)
        parts = np.searchsorted(problem.first_window, chain, side="right") - 1
        places = chain - problem.first_window[parts]
        ends = np.zeros((len(chain), n, n_p + n))
        for end, k, i in zip(ends, parts, places, strict=True):
            end[:, problem.parts[k].index] = sums[k].end_theta[i]
            end[:, n_p:] = sums[k].end_start[i]
        along = _trajectories(ends[:-1, :, n_p:], ends[:-1, :, :n_p], problem.state_scale, known)
        joined = _joined([passed[k].window(i, T) for k, i, T in zip(parts, places, along, strict=True)])
        columns = np.concatenate([np.arange(n_p), n_p + record * n + np.arange(n)])
        yield joined._replace(columns=columns[joined.columns])


def _trajectories(by_start: FloatArray, by_theta: FloatArray, scale: FloatArray, known: BoolArray) -> FloatArray:
    """Return derivatives of window starts, (n_windows, n, n_p + n), that close the linearised gaps.

    `by_start` (n_windows - 1, n, n) and `by_theta` (n_windows - 1, n, n_p) are the derivatives of the windows' ends.
    `known` (n,) tells which states of the first start do not move; their coordinates stay zero.
    """
    links, n = len(by_start), len(scale)
    n_p, size = by_theta.shape[2], (links + 1) * n
    blocks = [[None] * (links + 1) for _ in range(links)]
    for i, step in enumerate(by_start / scale[:, None] * scale):
        blocks[i][i], blocks[i][i + 1] = scipy.sparse.csc_array(-step), scipy.sparse.eye_array(n)
    right = (by_theta / scale[:, None]).reshape(-1, n_p)
    gaps = scipy.sparse.csc_array(scipy.sparse.bmat(blocks)) if links else scipy.sparse.csc_array((0, size))
    if known.any():
        fixed = scipy.sparse.csc_array(scipy.sparse.eye_array(n, size))[known]
        gaps = scipy.sparse.csc_array(scipy.sparse.bmat([[fixed], [gaps]])) if links else scipy.sparse.csc_array(fixed)
        right = np.vstack([np.zeros((int(known.sum()), n_p)), right])
    sides = np.zeros((size, 2 * n))  # a free trajectory is seen at the first window or, where it grows, at the last
    sides[:n, :n] = sides[-n:, n:] = np.eye(n)
    if gaps.shape[0]:
        try:
            factors = scipy.sparse.linalg.splu(scipy.sparse.csc_array(gaps @ gaps.T))
        except RuntimeError as singular:  # far from a solution: the model grows beyond rounding in a window
            raise np.linalg.LinAlgError("the gaps between windows depend on each other") from singular
        following = gaps.T @ factors.solve(right)
        sides -= gaps.T @ factors.solve(np.asarray(gaps @ sides))
    else:
        following = np.zeros((size, n_p))
    free = np.zeros((size, n))
    free[:, ~known] = np.linalg.svd(sides, full_matrices=False)[0][:, : n - int(known.sum())]
    return np.asarray(np.hstack([following, free]).reshape(links + 1, n, n_p + n) * scale[:, None])


def filtered_records(at: Estimate) -> list[RecordSensitivities]:
    """Return whitened errors and sensitivities of each record."""
    n_y = at.problem.parts[0].blocks.y.shape[2]
    records = information_over_records(at, np.eye(n_y)).sensitivities
    return [whitened(record, each) for record, each in zip(records, at.filters, strict=True)]


def _information_of(
    at: Estimate, records: list[RecordSensitivities], weight: FloatArray, shaped: FloatArray
) -> Information:
    """Return the Gauss-Newton information of all records for two weights (n_y, n_y), from sensitivities."""
    hessians = np.zeros((2, at.n_all, at.n_all))
    for record in records:
        for total, W in zip(hessians, (weight, shaped), strict=True):
            products = np.einsum("yik,yz,zjk->ij", record.psi, W, record.psi, optimize=True)
            total[np.ix_(record.columns, record.columns)] += products
    return Information(hessians[0], hessians[1], None, records)


UNDETERMINED = 1e-13  # largest eigenvalue of the scaled information for which a direction is not determined
# Smallest such eigenvalue for which exact Hessian and coloured scores are more than rounding. Below it the curvature is
# that of Gauss-Newton, and the scores are those of white errors.
_RESOLVED = 1e-8
FLATTEST = 1e-4
"""Smallest curvature of a minimum, as a part of the Gauss-Newton curvature."""
_ACTIVE = 1e-4  # of the size of a constraint that lies on its bound
_INVOLVED = 1e-3  # smallest part of a parameter in a direction without information, for which it counts as open


class Covariance(NamedTuple):
    """Covariances of the free parameters; estimated initial states are taken into account.

    Attributes
    ----------
    white : (n_p, n_p) array
        Covariance for white residuals.
    robust : (n_p, n_p) array
        Covariance for coloured residuals.
    flatness : float
        Smallest ratio of the curvature of the cost to the Gauss-Newton curvature, over all directions. It is about one
        for white residuals, and NaN when it was not computed. Below `FLATTEST` the point is not a minimum, and the
        robust covariance uses the Gauss-Newton curvature.
    undetermined : (n_directions, n_p) array
        Unit directions, in parameters scaled by their curvature, that the data do not determine; usually empty.
    condition : float
        Condition number of the scaled information matrix.
    models : tuple of ErrorModel
        Model of the errors of each record; empty where the robust covariance is the white one.
    curvature : (n_p, n_p) array
        Inverse of the cost's Hessian with which the robust covariance is computed: what the curvature alone would give.
    weighted : (n_p, n_p) array or None
        Covariance that generalised least squares would have with these models; None where it cannot be used.
    """

    white: FloatArray
    robust: FloatArray
    flatness: float
    undetermined: FloatArray
    condition: float
    models: tuple[ErrorModel, ...] = ()
    curvature: FloatArray = np.zeros((0, 0))
    weighted: FloatArray | None = None

    @property
    def open(self) -> BoolArray:
        """Parameters that the data do not determine, (n_p,)."""
        return np.asarray((np.abs(self.undetermined) > _INVOLVED).any(axis=0))

    def of(self, kind: Literal["white", "robust"]) -> FloatArray:
        """Return the covariance for white or for coloured ("robust") residuals."""
        chosen: FloatArray = getattr(self, kind)
        return chosen

    def scaled(self, white: float, robust: float) -> Covariance:
        """Return the covariances multiplied by factors for white and coloured residuals."""
        return self._replace(white=self.white * white, robust=self.robust * robust)

    def along(self, projection: FloatArray) -> Covariance:
        """Return the covariances after a projection of the estimates by ``onto`` (n_p, n_p)."""
        white, robust, curvature = (
            projection @ each @ projection.T for each in (self.white, self.robust, self.curvature)
        )
        return self._replace(white=white, robust=robust, curvature=curvature)

    def widened(self, bias: FloatArray) -> Covariance:
        """Return the covariances with the outer product of a known bias (n_p,) added."""
        more = np.outer(bias, bias)
        return self._replace(white=self.white + more, robust=self.robust + more)


def covariance(at: Estimate, error_products: FloatArray, held: BoolArray, *, coloured: bool = False) -> Covariance:
    """Return the covariance of the parameters at an estimate.

    Parameters
    ----------
    at : Estimate
        The estimates.
    error_products : (n_y, n_y) array
        Sum of the products of errors, ``sum e e'``.
    held : (n_p,) boolean array
        Parameters on a bound; they count as known, and their rows are zero.
    coloured : bool
        Whether residuals are coloured. If not, the robust covariance is the white one. If so, it uses a model of the
        residuals and the exact Hessian of the cost, which needs further passes.

    Returns
    -------
    Covariance
        The covariances.

    Notes
    -----
    With the Hessian H of ``sum e' W e / 2`` by parameters and initial states, and the covariance J of its gradient
    ``sum psi' W e``, the estimates have the covariance ``H^-1 J H^-1`` (Ljung, System Identification,
    Secs. 9.2 to 9.4). White residuals do not depend on the past. Then the Gauss-Newton approximation
    ``H = sum psi' W psi`` is sufficient, and with the covariance Lambda of the residuals
    ``J = sum psi' W Lambda W psi``. For coloured residuals H also contains ``-sum psi_i' W d psi_j``, which is its
    largest part along the disturbance gain. Their J is that of `gbid.identify.uncertainty.coloured`. A prior
    adds its information to H, and to J as a measurement with its variance does.
    """
    problem, modelled = at.problem, coloured and bool(at.problem.parts)
    n_p, estimated = problem.n_theta, ~at.given.ravel()
    unit_power = np.eye(len(error_products)) / max(1, problem.n_samples)  # that of filtered errors
    weight = unit_power if at.filters or not problem.parts else problem.weight(error_products)
    freedom = max(1.0, problem.n_samples - (n_p + int(estimated.sum())) / len(weight))
    shaped = weight @ (error_products / freedom) @ weight
    share = float(np.trace(shaped)) / float(np.trace(weight))
    # Weighted by the inverse of the covariance of the errors, one pass gives both.
    is_white = np.allclose(shaped, share * weight, rtol=1e-9, atol=1e-9 * share * float(np.abs(weight).max()))
    if not problem.parts:
        nothing = np.zeros((n_p, n_p))
        information, is_white = Information(nothing, nothing, None, ()), False
    elif at.filters:
        information, is_white = _information_of(at, filtered_records(at), weight, shaped), False
    elif grows(at):
        information = _information_of(at, list(windowed_records(at)), weight, shaped)
    else:
        other = None if is_white else shaped
        left = None if modelled else information_of_last_pass(at, shaped=other)
        information = left or information_over_records(at, weight, shaped=other, observed=modelled)

    # The weight is one over the total error, that of the likelihood one over its variance: they differ by this.
    unit = 1 / problem.likelihood_size
    if problem.parts:
        unit = float(np.trace(weight @ error_products)) / (problem.n_samples * len(weight))
    known = unit * _known(at)
    keep = np.concatenate([~held, estimated])
    kept = np.ix_(keep, keep)
    H = (information.hessian + known)[kept]
    J_white = ((share * information.hessian if is_white else information.shaped) + known * unit)[kept]

    scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    fixed = _along_constraints(at)[:, keep] / scale
    along = scipy.linalg.null_space(fixed) if len(fixed) else None  # directions left free by active constraints, or all

    def within(matrix: FloatArray) -> FloatArray:
        scaled = matrix / np.outer(scale, scale)
        return scaled if along is None else np.asarray(along.T @ scaled @ along)

    eigenvalues, vectors = np.linalg.eigh(within(H))
    vectors = vectors if along is None else along @ vectors
    undetermined = eigenvalues < UNDETERMINED * eigenvalues[-1]
    root = vectors[:, ~undetermined] / np.sqrt(eigenvalues[~undetermined]) / scale[:, None]  # root root' is the inverse
    flatness, n_kept = np.nan, int((~held).sum())

    def over_parameters(J: FloatArray, onto: FloatArray) -> FloatArray:
        result = np.zeros((n_p, n_p))
        result[np.ix_(~held, ~held)] = onto[:n_kept] @ J @ onto[:n_kept].T
        return result

    J_white = root.T @ J_white @ root
    white = robust = over_parameters(J_white, root)
    models, onto, weighted = list[ErrorModel](), root, None
    if modelled:
        records, estimates = information.sensitivities, np.flatnonzero(keep)
        transforms: Sequence[Transform] = OnDemand(lambda i: transformed(records[i], estimates), len(records))
        plain = all(segment.is_plain for part in problem.parts for segment in part.blocks.segments)
        usable = not at.filters and plain and not any(part.predictor.feeds_back for part in problem.parts)
        filtered = np.zeros_like(H) if usable else None
        J, models = score_covariance(transforms, weight, root, filtered)
        if filtered is not None:
            inner = np.asarray(np.linalg.pinv(within(filtered + _known(at)[kept]), hermitian=True), float)
            weighted = over_parameters(inner, (np.eye(len(scale)) if along is None else along) / scale[:, None])
        J += root.T @ (known * unit)[kept] @ root
        blurred = eigenvalues[~undetermined] < _RESOLVED * eigenvalues[-1]
        if information.observed is not None:
            exact = root.T @ (information.observed + known)[kept] @ root
            curvatures, axes = np.linalg.eigh(_with_rounding(exact, blurred, np.eye(len(blurred))))
            flatness = float(curvatures[0])
            onto = root @ (axes / curvatures) @ axes.T if flatness >= FLATTEST else root
        robust = over_parameters(_with_rounding(J, blurred, J_white), onto)
    elif coloured:  # frequency responses alone
        scores = np.diag(problem.prior.information)
        for group in problem.responses:
            scores[np.ix_(group.index, group.index)] += group.score_products(at.theta)
        robust = over_parameters(root.T @ (unit**2 * scores)[kept] @ root, root)

    directions = np.zeros((int(undetermined.sum()), n_p))
    directions[:, ~held] = vectors[:n_kept, undetermined].T
    # A direction of initial states alone does not concern the parameters.
    directions = directions[np.linalg.norm(directions, axis=1) > 1e-2]
    condition = float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny))
    curvature = np.zeros((n_p, n_p))
    curvature[np.ix_(~held, ~held)] = onto[:n_kept] @ root[:n_kept].T
    return Covariance(white, robust, flatness, directions, condition, tuple(models), curvature, weighted)


def _known(at: Estimate) -> FloatArray:
    """Return the information of prior and extra cost on parameters and initial states, (n_all, n_all)."""
    problem = at.problem
    known = np.pad(problem.known(at.theta).hessian, (0, at.n_all - problem.n_theta))
    if problem.extra is not None:
        known[np.ix_(problem.extra.used, problem.extra.used)] += problem.extra.at(at.theta, at.starts).hessian
    return known


def _along_constraints(at: Estimate) -> FloatArray:
    """Return slopes of the caller's active constraints, (n_active, n_all): directions without variance."""
    extra = at.problem.extra
    if extra is None:
        return np.zeros((0, at.n_all))
    values = extra.at(at.theta, at.starts)
    active = ~np.isnan(extra.off_bound(values.rows, _ACTIVE))
    slopes = np.zeros((int(active.sum()), at.n_all))
    slopes[:, extra.used] = values.slopes[active]
    return slopes


def _with_rounding(matrix: FloatArray, blurred: BoolArray, instead: FloatArray) -> FloatArray:
    """Return a matrix with the rows and columns of ill-determined directions replaced by `instead`'s."""
    result = matrix.copy()
    result[blurred], result[:, blurred] = instead[blurred], instead[:, blurred]
    return result


# ---- Standard deviations of modes, static gain and matrices, propagated from the covariance of the parameters.


def mode_slopes(A: Dual, dt: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Return the oscillatory modes of a state matrix, and their derivatives.

    Parameters
    ----------
    A : Dual
        State matrix (n, n) with its derivatives by n_p parameters.
    dt : float, optional
        Sample time of a discrete-time matrix [s], whose poles are ``log(eigenvalue) / dt``.

    Returns
    -------
    modes : (n_modes, 2) array
        Natural frequency [Hz] and damping factor, in the order of rising frequency.
    slopes : (n_p, n_modes, 2) array
        Derivatives of the modes.

    Notes
    -----
    ``d lambda = w' dA v / (w' v)`` with right and left eigenvectors v and w; for
    ``f = |lambda| / 2 pi`` and ``zeta = -Re(lambda) / |lambda|`` the chain rule applies. For a double eigenvalue the
    derivative does not exist; near one the result is very large.
    """
    values, vectors = np.linalg.eig(A.value)
    poles = values.astype(complex) if dt is None else poles_of_samples(values, dt)
    left = np.linalg.inv(vectors)
    keep = one_of_each_pair(poles)
    order = [i for i in np.argsort(np.abs(poles)) if keep[i]]
    slopes = np.zeros((len(A.slope), len(order), 2))
    for row, i in enumerate(order):
        pole, size = poles[i], abs(poles[i])
        d_pole = np.einsum("a,pab,b->p", left[i], A.slope, vectors[:, i]) / (1.0 if dt is None else values[i] * dt)
        d_size = (np.conj(pole) * d_pole).real / size
        slopes[:, row] = np.column_stack([d_size / (2 * np.pi), -d_pole.real / size + pole.real * d_size / size**2])
    return oscillatory_modes(poles), slopes


class ModelSpreads(NamedTuple):
    """Derivatives and standard deviations of the first recording's model.

    Attributes
    ----------
    slopes : ModelSlopes
        Derivatives of its matrices by all free parameters.
    modes : (n_modes, 2) array
        Standard deviations of natural frequencies [Hz] and damping factors.
    static_gain : (n_outputs, n_inputs) array
        Standard deviations of the static gain; nan for a model with a pole at zero.
    """

    slopes: ModelSlopes
    modes: FloatArray
    static_gain: FloatArray


def model_spreads(
    at: Estimate, chosen: FloatArray, model: Any, names: Sequence[str], tie: FloatArray | None = None
) -> ModelSpreads:
    """Return derivatives and standard deviations of the model; a nonlinear one at its working point.

    Parameters
    ----------
    at : Estimate
        The estimates.
    chosen : (n_p, n_p) array
        Their covariance.
    model : LinearModel or NonlinearModel
        Model of the first recording.
    names : sequence of str
        Names of the parameters of the structure.
    tie : (n_own, n_p) array, optional
        Matrix from all free parameters to the predictor's own at the model's point, for a scheduled structure.
    """
    part, predictor, dt = at.problem.groups[0], at.problem.groups[0].predictor, None
    local_covariance = chosen[np.ix_(part.index, part.index)] if tie is None else tie @ chosen @ tie.T
    tie = np.eye(len(at.theta))[part.index] if tie is None else tie
    local = tie @ at.theta
    if isinstance(predictor, NonlinearPredictor):
        A, B, C, D = linearised(model, names, [q.name for q in predictor.free])
        is_delayed = np.isin(np.arange(predictor.n_inputs), predictor.delayed)
        prompt, delayed = np.where(is_delayed, 0.0, B.slope), np.where(is_delayed, B.slope, 0.0)
        slopes = [A.slope, prompt, C.slope, D.slope, delayed, predictor.delay_slopes(local)]
    else:
        assert isinstance(predictor, Predictor)
        (A, B, C, D, _, B_delayed, _), slopes, dt = matrices_with_slopes(predictor, local)
        B = Dual(B.value + B_delayed.value, B.slope + B_delayed.slope)
    by_free = ModelSlopes(*(np.tensordot(tie.T, slope, 1) for slope in slopes))
    gain = np.full(D.value.shape, np.nan)
    if not (np.isfinite(local_covariance).all() and np.isfinite(A.value).all()):
        return ModelSpreads(by_free, np.full((len(model.modes()), 2), np.nan), gain)
    at_rest = A if dt is None else A - np.eye(A.shape[0])  # x[k+1] = x[k]
    if np.linalg.cond(at_rest.value) < 1e15:
        inverse = np.asarray(np.linalg.inv(at_rest.value), float)
        static_gain = D - C @ (Dual(inverse, -inverse @ at_rest.slope @ inverse) @ B)
        gain = std_of(static_gain.slope, local_covariance)
    return ModelSpreads(by_free, std_of(mode_slopes(A, dt)[1], local_covariance), gain)
