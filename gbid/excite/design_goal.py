"""DesignGoal of a design: the quantities that count, their derivatives by the parameters, and the criterion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.excite.information.line_model import LineModel
from gbid.identify.uncertainty.propagation import mode_slopes

Focused = str | Sequence[str] | Mapping[str, float] | None
"""Names or patterns of quantities that count equally (D-optimal), or each with the deviation that counts as one."""

_OTHERS = 0.01
_SINGULAR = 1e-14


@dataclass(frozen=True, eq=False)
class Quantities:
    """Free parameters and what follows from them.

    Attributes
    ----------
    names : tuple of str
        Free parameters, then ``frequency_1``, ``damping_1``, ``frequency_2`` and so on of the oscillatory modes.
    values : (n,) array
        Their values.
    slopes : (n, n_free) array
        Derivatives by the free parameters.
    """

    names: tuple[str, ...]
    values: FloatArray
    slopes: FloatArray

    def std(self, covariance: FloatArray) -> dict[str, float]:
        """Return standard deviations from the covariance of the free parameters, NaN where it does not determine."""
        # A quantity that a parameter does not move is not touched by that parameter's missing deviation.
        unknown = (self.slopes != 0) @ np.isnan(np.diag(covariance))
        variance = np.einsum("qp,pr,qr->q", self.slopes, np.nan_to_num(covariance), self.slopes)
        variance[unknown] = np.nan
        return dict(zip(self.names, np.sqrt(np.maximum(variance, 0.0)).tolist(), strict=True))

    def matching(self, patterns: Sequence[str], what: str) -> list[int]:
        """Return the positions of the quantities that match one of the patterns.

        Raises
        ------
        UsageError
            When a pattern matches none.
        """
        found = dict[int, None]()
        for pattern in patterns:
            hit = [i for i, name in enumerate(self.names) if fnmatchcase(name, pattern)]
            if not hit:
                raise UsageError(f"{what}: nothing matches {pattern!r}; there are {', '.join(self.names)}")
            found |= dict.fromkeys(hit)
        return list(found)


@dataclass(frozen=True, eq=False)
class DesignGoal:
    """Criterion of a design: of the quantities ``J p`` that count, log det (D) or log trace (A) of their covariance.

    All parameters together count as well, with a weight of one hundredth. So a design for few quantities leaves no
    parameter undetermined.

    Attributes
    ----------
    names : tuple of str
        Quantities that count.
    J : (n_counted, n_free) array
        Their derivatives; for the A-criterion divided by the deviation that counts as one.
    kind : {"D", "A"}
        Criterion.
    """

    names: tuple[str, ...]
    J: FloatArray
    kind: str

    def loss(self, information: FloatArray) -> float:
        """Return twice the logarithm of a mean standard deviation; infinite where parameters are not determined."""
        inverse = _inverse(information)
        if inverse is None:
            return np.inf
        n, own = len(self.J), self.J @ inverse @ self.J.T
        counted = np.linalg.slogdet(own)[1] / n if self.kind == "D" else np.log(np.trace(own) / n)
        return float(counted + _OTHERS * np.linalg.slogdet(inverse)[1] / len(inverse))

    def gradient(self, information: FloatArray) -> FloatArray:
        """Return P: further information dM lowers the loss by tr(P dM). tr(P M) is `full`.

        Raises
        ------
        UsageError
            When parameters are not determined.
        """
        inverse = _inverse(information)
        if inverse is None:
            raise UsageError(
                "no excitation of these inputs determines all parameters; fix some (KnownModel(..., fixed=...))"
            )
        onto = inverse @ self.J.T
        own = self.J @ onto
        P = onto @ np.linalg.solve(own, onto.T) / len(own) if self.kind == "D" else onto @ onto.T / np.trace(own)
        return np.asarray(P + _OTHERS / len(inverse) * inverse)

    @property
    def full(self) -> float:
        """tr(P M): the sum of all sensitivities, without earlier information."""
        return 1.0 + _OTHERS


def quantities_of(lines: LineModel) -> Quantities:
    """Return the free parameters of a model and its modes, with derivatives."""
    A = lines.predictor.matrices(lines.theta)[0]
    modes, slopes = mode_slopes(A)
    of_modes, names, values = list[FloatArray](), list[str](), list[float]()
    met: list[tuple[float, float]] = []
    for (frequency, damping), slope in zip(modes, slopes, strict=True):
        if any(np.allclose((frequency, damping), other, rtol=1e-9) for other in met):
            continue  # the copy of an actuator in a plant with exact delays
        met.append((frequency, damping))
        names += [f"frequency_{len(met)}", f"damping_{len(met)}"]
        values += [frequency, damping]
        of_modes += list(slope)
    n = len(lines.free)
    stacked = np.vstack([np.eye(n), np.reshape(of_modes, (-1, n))])
    return Quantities((*lines.free, *names), np.concatenate([lines.theta, values]), stacked)


def goal_of(lines: LineModel, quantities: Quantities, focus: Focused) -> DesignGoal:
    """Return the goal of a design.

    Parameters
    ----------
    lines : LineModel
        The model.
    quantities : Quantities
        Its quantities.
    focus : str, sequence of str, dict of str to float, or None
        Names or patterns, such as ``"damping_*"`` or ``("k_*", "tau_*")``: D-criterion of these. A dict gives the
        standard deviation that counts as one: A-criterion, the sum of squares over them. None: D-criterion of all
        parameters that do not belong to the noise model alone.

    Raises
    ------
    UsageError
        When a pattern matches nothing, or a deviation is not positive.
    """
    if isinstance(focus, Mapping):
        picked = dict[int, float]()
        for pattern, one in focus.items():
            if not (np.isfinite(one) and one > 0):
                raise UsageError(f"focus: {pattern} = {one}; give the standard deviation that counts as one")
            picked |= dict.fromkeys(quantities.matching((pattern,), "focus"), float(one))
        scale = np.array(list(picked.values()))
        rows = list(picked)
        return DesignGoal(tuple(quantities.names[i] for i in rows), quantities.slopes[rows] / scale[:, None], "A")
    if focus is None:
        rows = [i for i in range(len(lines.free)) if i not in lines.predictor.noise]
    else:
        rows = quantities.matching((focus,) if isinstance(focus, str) else tuple(focus), "focus")
    if not rows:
        raise UsageError("focus: nothing to estimate; name quantities")
    slopes = quantities.slopes[rows]
    if len(rows) > 1 and np.linalg.matrix_rank(slopes / np.linalg.norm(slopes, axis=1)[:, None]) < len(rows):
        raise UsageError(
            "focus: these quantities depend on each other, as modes on the parameters that make them; name fewer, or "
            "give the standard deviation that counts as one for each"
        )
    return DesignGoal(tuple(quantities.names[i] for i in rows), slopes, "D")


def _inverse(information: FloatArray) -> FloatArray | None:
    """Return the covariance, or None where the information is singular."""
    size = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    if not values[0] > _SINGULAR * values[-1]:
        return None
    root = vectors / np.sqrt(values) / size[:, None]
    return np.asarray(root @ root.T)
