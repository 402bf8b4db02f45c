"""Black-box models of recordings by a subspace method (PBSID), and structures matched to their response."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter
from typing import Literal

import numpy as np
import scipy

from gbid.core.arrays import ComplexArray, FloatArray, one_blas_thread
from gbid.core.brief import Description, brief
from gbid.core.errors import DataError
from gbid.core.figures import Pictured
from gbid.core.option_types import Count
from gbid.core.tables import Column, Table
from gbid.identify.data import Record, column_means, gather
from gbid.identify.predictor import Predictor
from gbid.identify.uncertainty.curves import Tabled
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.structure.linear import as_names

_ENOUGH = 30_000  # largest number of rows of the regression
_MOST_LAGS = 60  # largest number of past samples
_FIRST_LAGS = 5  # smallest number of past samples


@dataclass(frozen=True, eq=False)
class BlackBox:
    """Regression of outputs on past samples, and the state-space model derived from it.

    Attributes
    ----------
    lags : int
        Number of past samples of the regression.
    auto : (lags, n_y, n_y) array
        Coefficients of past outputs, the most recent one first.
    cross : (lags, n_y, n_u) array
        Coefficients of past inputs.
    direct : (n_y, n_u) array
        Coefficient of the present input.
    regression : (n_z, n_z) array
        Inverse of the sum of the products of the regressors, for the covariance of the coefficients. The regressors are
        the past outputs and inputs by lag, then the present input. A constant for each record was estimated along.
    noise : (n_y, n_y) array
        Covariance of the residuals.
    A : (order, order) array
        State matrix in discrete time, without correction by measured outputs.
    C : (n_y, order) array
        Output matrix.
    first_states : (n_records, order) array
        State of each record at sample `lags`.
    B, K : (order, n_u), (order, n_y) array
        Input matrix, and gain of the innovations.
    singular_values : (n,) array
        Singular values of the predictor's product of observability and states; those of noise are small and alike.
    """

    lags: int
    auto: FloatArray
    cross: FloatArray
    direct: FloatArray
    regression: FloatArray
    noise: FloatArray
    A: FloatArray
    C: FloatArray
    first_states: FloatArray
    B: FloatArray
    K: FloatArray
    singular_values: FloatArray

    def response(self, z: ComplexArray) -> tuple[ComplexArray, FloatArray]:
        """Return the frequency response at points of the z-plane, and its standard deviation.

        Parameters
        ----------
        z : (n,) complex array
            Points ``exp(s T)``.

        Returns
        -------
        response : (n, n_y, n_u) complex array
            ``(I - sum auto_i z^-i)^-1 (direct + sum cross_i z^-i)``.
        std : (n, n_y, n_u) array
            Standard deviation of its absolute value, to first order.
        """
        n_y, n_u = self.direct.shape
        powers = z[:, None] ** -np.arange(1, self.lags + 1)
        left = np.linalg.inv(np.eye(n_y) - np.einsum("fi,iyz->fyz", powers, self.auto))
        response = left @ (self.direct + np.einsum("fi,iyu->fyu", powers, self.cross))
        # d response = left (d auto z^-i response + d cross z^-i + d direct): linear in each row of coefficients
        spread = np.zeros(response.shape)
        outer = np.einsum("fya,ab,fyb->fy", left, self.noise, left.conj()).real
        for j in range(n_u):
            past_y = (powers[:, :, None] * response[:, None, :, j]).reshape(len(z), -1)
            one = np.zeros(n_u)
            one[j] = 1.0
            past_u = (powers[:, :, None] * one).reshape(len(z), -1)
            row = np.hstack([past_y, past_u, np.broadcast_to(one, (len(z), n_u))])[:, : len(self.regression)]
            size = np.einsum("fa,ab,fb->f", row, self.regression, row.conj()).real
            spread[:, :, j] = np.sqrt(np.maximum(outer * size[:, None], 0.0) / 2)
        return response, spread


def black_box(records: Sequence[Record], order: int, *, feedthrough: bool, lags: int | None = None) -> BlackBox:
    """Return a black-box model of records, with inputs or as free decays.

    Parameters
    ----------
    records : sequence of Record
        The records. Without inputs they are free decays.
    order : int
        Number of states.
    feedthrough : bool
        Whether an input acts on the outputs within the same sample.
    lags : int, optional
        Number of past samples; by default the one with the smallest information criterion.

    Returns
    -------
    BlackBox

    Raises
    ------
    DataError
        When the records are too short.

    Notes
    -----
    The outputs are regressed on the past of outputs and inputs. This predictor is stable also for an unstable plant,
    and consistent in a closed loop and with coloured noise, when the past is long enough. Its coefficients are the
    Markov parameters ``C (A - K C)^(i-1) [K B]`` of the predictor, from which the product of observability matrix and
    state follows; a singular value decomposition gives the states, and two least-squares problems the matrices (Chiuso,
    "The role of vector autoregressive modeling in predictor-based subspace identification", Automatica 43, 2007). For
    free decays the same is a stochastic subspace method.
    """
    n_y, n_u = records[0].outputs.shape[1], records[0].inputs.shape[1]
    rows = sum(r.n_samples for r in records)
    most = min(_MOST_LAGS, rows // (4 * (n_y + n_u)), min(r.n_samples for r in records) // 3)
    least = max(_FIRST_LAGS, order // n_y + 2)
    if most < least:
        raise DataError(
            f"{rows} samples are too few for a black-box model of {order} states, which start values would come from; "
            "record for longer, or give start values"
        )
    scale_y = np.concatenate([r.outputs for r in records]).std(0)
    scale_u = np.concatenate([r.inputs for r in records]).std(0)
    scale_u = np.where(scale_u > 0, scale_u, 1.0)
    scaled = [(r.outputs[:_ENOUGH] / scale_y, r.inputs[:_ENOUGH] / scale_u) for r in records]
    tried = _regressions(scaled, [lags] if lags else _lag_choices(least, most), most, feedthrough)
    return _states(scaled, min(tried, key=lambda each: each.criterion), order, (scale_y, scale_u))


@dataclass(frozen=True, eq=False)
class _Regression:
    lags: int
    coefficients: FloatArray  # (n_z, n_y)
    inverse: FloatArray  # (n_z, n_z)
    noise: FloatArray  # (n_y, n_y)
    triangle: FloatArray  # R; its first columns are those of the past, without the present input
    criterion: float


def _lag_choices(least: int, most: int) -> list[int]:
    choices = [least]
    while choices[-1] < most:
        choices.append(min(max(choices[-1] + 1, int(1.6 * choices[-1])), most))
    return choices


def _past(y: FloatArray, u: FloatArray, lags: int, first: int, last: int) -> FloatArray:
    """Return past outputs and inputs of the samples `first` to `last - 1`, by lag."""
    return np.hstack([signal[first - i : last - i] for signal in (y, u) for i in range(1, lags + 1)])


def _regressions(
    scaled: Sequence[tuple[FloatArray, FloatArray]], choices: Sequence[int], skip: int, feedthrough: bool
) -> list[_Regression]:
    """Return regressions of the samples from `skip` on, with increasing numbers of lags.

    The triangle of the longest one, with the outputs as last columns, stands for all: it has the products of all rows.
    """
    longest, (n_y, n_u) = choices[-1], (signals.shape[1] for signals in scaled[0])
    past = np.vstack([_past(y, u, longest, skip, len(y)) for y, u in scaled])
    now = [np.vstack([u[skip:] for _, u in scaled])] if feedthrough else []
    outputs = np.vstack([y[skip:] for y, _ in scaled])
    constants = _constants(scaled, skip)
    rows: FloatArray = np.asarray(np.linalg.qr(np.hstack([past, *now, constants, outputs]), mode="r"))
    rest = list(range(past.shape[1], rows.shape[1] - n_y))
    regressions = []
    for p in choices:
        columns = [*range(p * n_y), *range(longest * n_y, longest * n_y + p * n_u), *rest]
        regressions.append(_regress(rows[:, columns], rows[:, -n_y:], p, len(outputs), constants.shape[1]))
    return regressions


def _regress(X: FloatArray, Y: FloatArray, lags: int, n: int, n_constants: int) -> _Regression:
    """Return the regression of Y on X, from products of n samples; the last columns of X are constants."""
    Q, R = np.linalg.qr(X)
    # Directions that the data do not excite, as in a free decay without noise, get no part of the coefficients.
    U, S, Vt = np.linalg.svd(R)
    keep = 1e-9 * S[0] < S
    pseudo = (Vt[keep].T / S[keep]) @ U[:, keep].T
    coefficients = pseudo @ (Q.T @ Y)
    left = Y - X @ coefficients
    noise = left.T @ left / max(n - int(keep.sum()), 1)
    _, log_det = np.linalg.slogdet(noise + 1e-24 * np.eye(Y.shape[1]))
    criterion = n * float(log_det) + 2 * int(keep.sum()) * Y.shape[1]
    n_z, inverse = X.shape[1] - n_constants, pseudo @ pseudo.T
    return _Regression(lags, coefficients[:n_z], inverse[:n_z, :n_z], noise, R, criterion)


def _constants(scaled: Sequence[tuple[FloatArray, FloatArray]], skip: int) -> FloatArray:
    """Return a column of ones for each record (its offset); none for a free decay, which ends at rest."""
    counts = [len(y) - skip for y, _ in scaled]
    if not scaled[0][1].shape[1]:
        return np.zeros((sum(counts), 0))
    return np.repeat(np.eye(len(scaled)), counts, axis=0)


def _states(
    scaled: Sequence[tuple[FloatArray, FloatArray]],
    regression: _Regression,
    order: int,
    scales: tuple[FloatArray, FloatArray],
) -> BlackBox:
    """Return states, state matrix and output matrix from the predictor's Markov parameters."""
    p, (scale_y, scale_u) = regression.lags, scales
    n_y, n_u = len(scale_y), len(scale_u)
    auto = regression.coefficients[: p * n_y].T.reshape(n_y, p, n_y).transpose(1, 0, 2)
    cross = regression.coefficients[p * n_y : p * (n_y + n_u)].T.reshape(n_y, p, n_u).transpose(1, 0, 2)
    direct = regression.coefficients[p * (n_y + n_u) :].T if len(regression.coefficients) > p * (n_y + n_u) else None
    D = np.zeros((n_y, n_u)) if direct is None else direct
    blocks = np.zeros((p, n_y, p * (n_y + n_u)))
    for i in range(p):
        blocks[i, :, : (p - i) * n_y] = auto[i:].transpose(1, 0, 2).reshape(n_y, -1)
        blocks[i, :, p * n_y : p * n_y + (p - i) * n_u] = cross[i:].transpose(1, 0, 2).reshape(n_y, -1)
    H = blocks.reshape(p * n_y, -1)
    U, S, _ = np.linalg.svd(H @ regression.triangle[:, : H.shape[1]].T, full_matrices=False)
    n = min(order, int((1e-12 * S[0] < S).sum()))
    project = (U[:, :n] / np.sqrt(S[:n])).T @ H
    states = [_past(y, u, p, p, len(y)) @ project.T for y, u in scaled]
    inputs = [u[p:] for _, u in scaled]
    outputs = np.vstack([y[p:] - u @ D.T for (y, _), u in zip(scaled, inputs, strict=True)])
    known = np.hstack([np.vstack(states), _constants(scaled, p)])
    rows = np.linalg.lstsq(known, outputs, rcond=None)[0]
    C, errors = rows[:n].T, outputs - known @ rows
    now = np.hstack([known, np.vstack(inputs), errors])
    last = np.cumsum([len(x) for x in states]) - 1  # these samples have no following one
    following = np.delete(np.vstack(states), [0, *(last[:-1] + 1)], axis=0)
    steps = np.linalg.lstsq(np.delete(now, last, axis=0), following, rcond=None)[0]
    offsets = known.shape[1]
    size = np.concatenate([np.tile(scale_y, p), np.tile(scale_u, p), scale_u if direct is not None else []])
    return BlackBox(
        lags=p,
        auto=auto * scale_y[:, None] / scale_y,
        cross=cross * scale_y[:, None] / scale_u,
        direct=D * scale_y[:, None] / scale_u,
        regression=regression.inverse / np.outer(size, size),
        noise=regression.noise * np.outer(scale_y, scale_y),
        A=steps[:n].T,
        C=C * scale_y[:, None],
        first_states=np.array([x[0] for x in states]),
        B=steps[offsets : offsets + n_u].T / scale_u,
        K=steps[offsets + n_u :].T / scale_y,
        singular_values=S,
    )


_MOST_STATES = 20  # tried with order="auto"
_TRAINING = 0.7  # part of each recording that models of all orders are estimated from; the rest judges them
_STANDARD_ERRORS = 2.0  # by which squared errors may exceed the least of twenty orders by chance
_NO_MATTER = 0.01  # of the squared errors: a fit of 95 % changes by 0.025 %
_VISIBLE = 1e-4  # singular value, of the largest, below which a state is rounding or noise in any recording


@dataclass(frozen=True, eq=False)
class SubspaceOrders(Tabled, Pictured):
    """Singular values and errors by order, from which a subspace model's order is chosen.

    Attributes
    ----------
    singular_values : (n,) array
        Singular values of the predictor's product of observability and states, relative to the largest.
    errors : (n_orders,) array
        Mean square of the errors of the models of order 1, 2, ... over the variance of the outputs, in a simulation of
        samples that they were not estimated from, summed over the outputs; inf for an unstable model.
    std : (n_orders,) array
        Standard error of its difference to the least of them.
    order : int
        Order that is chosen.
    """

    singular_values: FloatArray
    errors: FloatArray
    std: FloatArray
    order: int

    drawn_by = "plot_orders"

    def _brief(self) -> Description:
        return brief(self, f"order {self.order} of {len(self.errors)} that were tried", errors=self.errors)

    def table(self) -> Table:
        """Return a table with a row for each order."""
        columns = [Column("order"), *(Column(name, format=4) for name in ("singular value", "error", "std"))]
        columns.append(Column("chosen"))
        numbers = zip(self.singular_values.tolist(), self.errors.tolist(), self.std.tolist(), strict=False)
        rows = [(i, *row, "yes" if i == self.order else "") for i, row in enumerate(numbers, start=1)]
        return Table("orders of a subspace model", columns, rows)


def subspace_orders(
    recordings: Recording | Sequence[Recording],
    *,
    inputs: str | Sequence[str] = "u",
    outputs: str | Sequence[str] = "y",
    feedthrough: bool = False,
) -> SubspaceOrders:
    """Return singular values and errors by order, the basis of ``order="auto"`` in `gbid.subspace`.

    Parameters
    ----------
    recordings, inputs, outputs, feedthrough
        As for `gbid.subspace`.

    Returns
    -------
    SubspaceOrders
        Its ``plot()`` shows both with the order that is chosen, its ``table()`` has a row for each order.

    Raises
    ------
    DataError
        When a recording lacks a signal, or recordings are too short.
    """
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    data = gather(several, as_names(inputs), as_names(outputs), minimum=_FIRST_LAGS)
    with one_blas_thread():
        return _order_of([_centred(record) for record in data.records], feedthrough)


def _centred(r: Record) -> Record:
    return Record(r.name, r.inputs - column_means(r.inputs), r.outputs - column_means(r.outputs))


def subspace(
    recordings: Recording | Sequence[Recording],
    order: Count | Literal["auto"] = "auto",
    *,
    inputs: str | Sequence[str] = "u",
    outputs: str | Sequence[str] = "y",
    feedthrough: bool = False,
) -> LinearModel:
    """Return a discrete-time linear model of recordings, without a structure, by a subspace method.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings with the same channels and sample time.
    order : int or "auto"
        Number of states. "auto": models of 1 to 20 states, as many as have singular values above rounding, from the
        first 70 % of each recording simulate the rest; the smallest whose squared errors exceed the least by no more
        than two standard errors, or a hundredth, is chosen. For an unstable plant state the order.
    inputs, outputs : str or sequence of str
        Signals (``"p"``) or channels (``"p.x"``).
    feedthrough : bool
        Whether an input acts on the outputs within the same sample.

    Returns
    -------
    LinearModel
        In discrete time, with the gain of its innovations as `K`. `gbid.compare` puts models of several orders side by
        side.

    Raises
    ------
    DataError
        When a recording lacks a signal, or recordings are too short for the order.
    UsageError
        When the order is no number of states.

    Notes
    -----
    The method is PBSID, see `black_box`: it is consistent in a closed loop, and for unstable plants, too.
    """
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    names = as_names(inputs), as_names(outputs)
    data = gather(several, *names, minimum=_FIRST_LAGS)
    centred = [_centred(record) for record in data.records]
    with one_blas_thread():
        chosen = _order_of(centred, feedthrough).order if order == "auto" else order
        model = black_box(centred, chosen, feedthrough=feedthrough)
    return LinearModel(
        model.A,
        model.B,
        model.C,
        model.direct,
        model.K,
        dt=data.sample_time,
        input_names=data.input_names,
        output_names=data.output_names,
        name=f"subspace model of order {len(model.A)}",
    )


def _order_of(records: Sequence[Record], feedthrough: bool) -> SubspaceOrders:
    """Return the smallest order whose validation error is close to the best, and the reason."""
    cuts = [int(_TRAINING * r.n_samples) for r in records]
    begin = [Record(r.name, r.inputs[:cut], r.outputs[:cut]) for r, cut in zip(records, cuts, strict=True)]
    rest = [Record(r.name, r.inputs[cut:], r.outputs[cut:]) for r, cut in zip(records, cuts, strict=True)]
    full = black_box(begin, _MOST_STATES, feedthrough=feedthrough)
    S, scale = full.singular_values, np.concatenate([r.outputs for r in rest]).std(axis=0)
    most = max(1, min(_MOST_STATES, len(full.A), int((_VISIBLE * S[0] < S).sum())))
    squares = []
    for order in range(1, most + 1):
        model = black_box(begin, order, feedthrough=feedthrough, lags=full.lags)
        square = ((np.concatenate([_errors(model, r) for r in rest]) / scale) ** 2).sum(axis=1)
        squares.append(np.array([batch.mean() for batch in np.array_split(square, 20)]))  # nearly independent
    best = int(np.argmin([each.mean() for each in squares]))
    with np.errstate(invalid="ignore"):  # infinite errors of unstable models
        more = np.array([each - squares[best] for each in squares])
        means, std = more.mean(axis=1), more.std(axis=1) / np.sqrt(more.shape[1])
        certain = np.maximum(_STANDARD_ERRORS * std, _NO_MATTER * squares[best].mean())
        order = int(np.argmax(means <= certain)) + 1  # never beyond the best, whose difference is zero
    return SubspaceOrders(S / S[0], np.array([each.mean() for each in squares]), std, order)


def _errors(model: BlackBox, record: Record) -> FloatArray:
    """Return simulation errors with the best initial state, (n_samples, n_y); infinite for an unstable model.

    One step ahead, an order that is too high would take the noise in.
    """
    n = len(model.A)
    if not np.abs(np.linalg.eigvals(model.A)).max() < 1:
        return np.full(record.outputs.shape, np.inf)
    states, free = np.zeros((record.n_samples, n)), np.empty((record.n_samples, n, n))
    drive, x, power = record.inputs @ model.B.T, np.zeros(n), np.eye(n)
    for k, push in enumerate(drive):
        states[k], free[k] = x, power
        x, power = model.A @ x + push, model.A @ power
    rest = record.outputs - states @ model.C.T - record.inputs @ model.direct.T
    from_start = (model.C @ free).reshape(-1, n)
    start = np.linalg.lstsq(from_start, rest.ravel(), rcond=1e-9)[0]
    return np.asarray(rest - (from_start @ start).reshape(rest.shape))


# ---- Match of a structure to the frequency response of a black-box model.

_SAME, _AGREEING = 1e-3, 3  # largest relative difference of equal misfits, and the number of them that is enough
_POOR = 0.3  # smallest misfit that is not believed, however often it is found, and that a near start does not have
_CLEAR, _CERTAIN = 0.05, 3.0  # misfit, and this in standard deviations of the response, below which one match is enough
_FEW, _BEHIND = 30, 2.0  # steps after which a match is given up when its misfit is so many times the smallest
_CAPPED = 1e12  # largest size of a residual, so that squares of wild starts stay finite


@dataclass(frozen=True, eq=False)
class Target:
    """Continuous-time response that a structure is matched to.

    Attributes
    ----------
    s : (n,) complex array
        Points ``i 2 pi f`` [rad/s].
    response : (n, n_y, n_columns) complex array
        Response from the inputs, or of free decays.
    weight : (n, n_y, n_columns) array
        One over the standard deviation.
    poles : (n_poles,) complex array
        Poles of the black-box model in continuous time [rad/s].
    decays : bool
        Whether the columns are free decays, whose initial states are unknown.
    """

    s: ComplexArray
    response: ComplexArray
    weight: FloatArray
    poles: ComplexArray
    decays: bool


@dataclass(frozen=True, eq=False)
class Match:
    """Parameters of a structure matched to a response.

    Attributes
    ----------
    theta : (n_free,) array
        The parameters.
    misfit : float
        Part of the weighted response that remains, from 0 (exact) to about 1.
    """

    theta: FloatArray
    misfit: float


def match(
    predictor: Predictor, target: Target, starts: Iterable[FloatArray], lower: FloatArray, upper: FloatArray
) -> Match:
    """Return the parameters whose response is closest to a target.

    Parameters
    ----------
    predictor : Predictor
        Predictor of the structure; its matrices are used.
    target : Target
        The response.
    starts : iterable of (n_free,) array
        Start values of the match. No more are taken when one has led to a small misfit within the errors of the
        response, or several to the same smallest misfit.
    lower, upper : (n_free,) array
        Bounds.

    Returns
    -------
    Match
        The best one.

    Notes
    -----
    The first stage minimises ``d(s) / q(s) (G_0(s) - G(s))``: the difference of the responses times the characteristic
    polynomial d of the structure, over that of the black-box model q. In the coefficients of the transfer function this
    is a linear least-squares problem (Levy; Sanathanan and Koerner, 1963), so that it leads to the resonances from far
    off, where the response has a local minimum at each of them. The second stage minimises the difference itself, from
    the result of the first, or from a start that is near itself (the polynomial weighs little at low frequencies).
    For free decays ``B`` is replaced by the initial states, which enter linearly and are eliminated.
    """
    matches, by_misfit = list[Match](), attrgetter("misfit")
    one_std = np.sqrt(np.count_nonzero(target.weight)) / np.linalg.norm(target.response * target.weight)  # a misfit
    for start in starts:
        rough = _solve(predictor, target, start, lower, upper, True, 60)
        at_start, at_rough = (_solve(predictor, target, x, lower, upper, False, 1) for x in (start, rough.theta))
        begin = at_start if at_start.misfit < min(at_rough.misfit, _POOR) else rough
        near = _solve(predictor, target, begin.theta, lower, upper, False, _FEW)
        if near.misfit <= _BEHIND * min((each.misfit for each in matches), default=np.inf):
            near = _solve(predictor, target, near.theta, lower, upper, False, 100)
        matches.append(near)
        least = min(each.misfit for each in matches)
        agreeing = sum(each.misfit <= least * (1 + _SAME) + 1e-9 for each in matches)
        if least < min(_CLEAR, _CERTAIN * one_std) or (least < _POOR and agreeing >= _AGREEING):
            break
    return min(matches, key=by_misfit)


def _solve(
    predictor: Predictor,
    target: Target,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    equation: bool,
    steps: int,
) -> Match:
    reference = np.linalg.norm(target.response * target.weight)

    @lru_cache(maxsize=1)  # the solver asks for value and slopes at one point in turn
    def at(point: bytes) -> tuple[FloatArray, FloatArray]:
        value, slope = _residual(predictor, target, np.frombuffer(point).copy(), equation)
        columns = np.concatenate([slope.reshape(value.size, -1), value.reshape(-1, 1)], axis=1) / reference
        rows = np.concatenate([columns.real, columns.imag])
        if not np.isfinite(rows).all():
            rows = np.full(rows.shape, [*[0.0] * len(start), _CAPPED])
        triangle: FloatArray = np.asarray(np.linalg.qr(rows, mode="r"))  # norms and products of columns in few rows
        return triangle[:, -1], triangle[:, :-1]

    inside = np.clip(start, lower, upper)
    width = np.where(np.isfinite(upper - lower), upper - lower, np.maximum(np.abs(inside), 1.0))
    theta = np.clip(inside, lower + 1e-9 * width, upper - 1e-9 * width)
    with np.errstate(all="ignore"):
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):
            theta = scipy.optimize.least_squares(
                lambda theta: at(theta.tobytes())[0],
                theta,
                jac=lambda theta: at(theta.tobytes())[1],
                bounds=(lower, upper),
                x_scale="jac",
                max_nfev=steps,
                xtol=1e-10,
                ftol=1e-10,
            ).x
        misfit = float(np.linalg.norm(at(theta.tobytes())[0]))
    return Match(theta, misfit if np.isfinite(misfit) else _CAPPED)


def _residual(
    predictor: Predictor, target: Target, theta: FloatArray, equation: bool
) -> tuple[ComplexArray, ComplexArray]:
    """Return weighted differences (n, n_y, n_columns), and derivatives (n, n_y, n_columns, n_free)."""
    A, B, C, D, _, B_delayed, delay = predictor.matrices(theta)
    s = target.s
    inverse = np.asarray(np.linalg.inv(s[:, None, None] * np.eye(len(A.value)) - A.value), complex)
    left: ComplexArray = np.asarray(C.value @ inverse, complex)
    if target.decays:
        size = np.abs(_characteristic_ratio(A.value, target)) if equation else np.ones(len(s))
        value, d_value = _decay(target, target.weight * size[:, None, None], inverse, left, A.slope, C.slope)
    else:
        turn = np.exp(-s[:, None] * delay.value[:, 0])
        drive = np.broadcast_to(B.value, (len(s), *B.shape)).astype(complex)
        drive[:, :, predictor.delayed] += B_delayed.value[:, predictor.delayed] * turn[:, None]
        states = inverse @ drive
        value = left @ drive + D.value
        d_value = _of_states(left, states, A.slope, C.slope) + _times(left, B.slope) + np.moveaxis(D.slope, 0, -1)
        for k, i in enumerate(predictor.delayed):
            d_value[:, :, i] += _times(left, B_delayed.slope[:, :, i, None])[:, :, 0] * turn[:, k, None, None]
            late = left @ B_delayed.value[:, i] * (s * turn[:, k])[:, None]
            d_value[:, :, i] -= late[..., None] * delay.slope[:, k, 0]
    difference = (target.response - value) * target.weight
    d_difference = -d_value * target.weight[..., None]
    if not equation:
        return difference, d_difference
    ratio = _characteristic_ratio(A.value, target)[:, None, None]
    to, of = np.nonzero(A.slope.any(axis=0))
    d_log = -inverse[:, of, to] @ A.slope[:, to, of].T
    change = d_difference + d_log[:, None, None] * difference[..., None]
    return ratio * difference, ratio[..., None] * change


def _times(left: ComplexArray, slope: FloatArray) -> ComplexArray:
    """Return the products of (n_f, n_y, n) with slopes (n_p, n, n_u), as (n_f, n_y, n_u, n_p)."""
    n_p, n, n_u = slope.shape
    product = left.reshape(-1, n) @ slope.transpose(1, 2, 0).reshape(n, n_u * n_p)
    return np.asarray(product.reshape(*left.shape[:2], n_u, n_p), complex)


def _of_states(left: ComplexArray, states: ComplexArray, dA: FloatArray, dC: FloatArray) -> ComplexArray:
    """Return derivatives of ``C (s I - A)^-1 X`` by A and C, (n_f, n_y, n_columns, n_p); states (n_f, n, n_columns)."""
    to, of = np.nonzero(dA.any(axis=0))  # entries of A that depend on parameters
    by_entry = left[:, :, None, to] * states.swapaxes(1, 2)[:, None, :, of]
    by_output = _times(states.swapaxes(1, 2), dC.swapaxes(1, 2)).swapaxes(1, 2)
    return by_entry @ dA[:, to, of].T + by_output


def _characteristic_ratio(A: FloatArray, target: Target) -> ComplexArray:
    """Return ``det(s I - A)`` divided by the characteristic polynomial of the black-box model."""
    poles = np.linalg.eigvals(A)
    s, known = target.s, target.poles
    middle = float(np.sqrt(np.abs(s[0]) * np.abs(s[-1])))
    padded = np.concatenate([known, np.full(max(len(poles) - len(known), 0), -middle)])[: max(len(poles), len(known))]
    logs = np.log(s[:, None] - poles).sum(1) - np.log(s[:, None] - padded).sum(1)
    return np.asarray(np.exp(np.clip(logs.real, -200, 200) + 1j * logs.imag))


def _decay(
    target: Target, weights: FloatArray, inverse: ComplexArray, left: ComplexArray, dA: FloatArray, dC: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return the response ``C (s I - A)^-1 X`` with the best initial states X (n, n_columns), and its derivatives."""
    n_f, n_y, n = left.shape
    value = np.zeros(target.response.shape, complex)
    d_value = np.zeros((*target.response.shape, len(dA)), complex)
    for j in range(target.response.shape[2]):
        weight = weights[:, :, j, None]
        rows = (left * weight).reshape(n_f * n_y, n)
        base = np.vstack([rows.real, rows.imag])
        goal = target.response[:, :, j].ravel() * weight.ravel()
        x = np.linalg.lstsq(base, np.concatenate([goal.real, goal.imag]), rcond=1e-12)[0]
        value[:, :, j] = left @ x
        d_value[:, :, j] = _of_states(left, (inverse @ x)[:, :, None], dA, dC)[:, :, 0]
        # what the initial state follows of the change (Kaufman's form of variable projection)
        flat = (d_value[:, :, j] * weight).reshape(n_f * n_y, -1)
        moved = np.concatenate([flat.real, flat.imag])
        Q = np.linalg.qr(base)[0]
        rest = moved - Q @ (Q.T @ moved)
        d_value[:, :, j] = (rest[: n_f * n_y] + 1j * rest[n_f * n_y :]).reshape(n_f, n_y, -1) / weight
    return value, d_value
