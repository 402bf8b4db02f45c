"""Setting of a direct LPV fit: parameters shared by the recordings, and those of each recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.identify.predictor import noise_names
from gbid.identify.problem.ties import Ties
from gbid.lpv.basis import EXPONENTS
from gbid.lpv.model import LPVModel
from gbid.lpv.surface_fit.regression import kron_designs
from gbid.lpv.surface_fit.terms import Orthonormal, orthonormal
from gbid.recording import Recording
from gbid.structure import KEY_PARAMETERS, Parameter, Structure
from gbid.structure.scheduling.monomials import Exponents


@dataclass(frozen=True, eq=False)
class Setting:
    """Setting of a direct LPV fit.

    Attributes
    ----------
    structures : tuple of Structure
        Structure of each recording.
    parameters : tuple of Parameter
        Parameters of the structures, with the fixed ones marked.
    held : dict of str to float
        Parameters with fixed values.
    gains : tuple of str
        Disturbance gains to estimate, separately for each recording.
    shared : tuple of Parameter
        Shared unknowns: coefficients of the surfaces in orthogonal terms, then actuators.
    names : tuple of str
        Parameters that follow from the shared unknowns: the key parameters, then actuators.
    X : (n, n_names, n_shared) array
        Matrix from shared unknowns to these parameters, for each recording.
    points : (n, 2) array
        Operating points [bar], [rpm].
    exponents : tuple of (int, int)
        Exponents of the terms in use.
    design : Orthonormal
        Orthogonal terms.
    """

    structures: tuple[Structure, ...]
    parameters: tuple[Parameter, ...]
    held: Mapping[str, float]
    gains: tuple[str, ...]
    shared: tuple[Parameter, ...]
    names: tuple[str, ...]
    X: FloatArray
    points: FloatArray
    exponents: Exponents
    design: Orthonormal

    @property
    def start(self) -> FloatArray:
        """Return the start values of the shared unknowns, (n_shared,)."""
        return np.array([q.start or 0.0 for q in self.shared])

    def ties(self, scatter: FloatArray) -> Ties:
        """Return the map from unknowns to parameters, with a scatter (n_names, n_names) between recordings.

        The deviation of a recording from the surfaces is ``lift @ own``, with `own` of variance one.
        """
        lift = _factor(scatter)
        own = tuple(Parameter(f"off_{i + 1}", 0.0) for i in range(lift.shape[1]))
        return Ties(self.names, self.shared, self.X, own, lift)

    def coefficients(self, shared: FloatArray) -> FloatArray:
        """Return the coefficients of the six terms in bar and rpm, (14, 6), from the shared unknowns."""
        k, m = len(KEY_PARAMETERS), len(self.exponents)
        found = np.zeros((k, len(EXPONENTS)))
        found[:, [EXPONENTS.index(e) for e in self.exponents]] = shared[: k * m].reshape(k, m) @ self.design.back.T
        return found


def set_up(
    recordings: Sequence[Recording], model: LPVModel, structures: Sequence[Structure], fixed: Mapping[str, float]
) -> Setting:
    """Return the setting of a direct LPV fit; parameters and errors are those of `gbid.fit_lpv_direct`."""
    for one in structures:
        missing = [key for key in KEY_PARAMETERS if key not in [q.name for q in one.parameters]]
        if missing:
            raise UsageError(f"structure {one.name!r} has no {', '.join(missing)}; surfaces need all key parameters")
    parameters = {q.name: q for one in structures for q in one.parameters}
    names = list(parameters)
    for key in fixed:
        if key in KEY_PARAMETERS or key not in names:
            what = "is a surface, which is estimated" if key in KEY_PARAMETERS else "is not a parameter"
            used = " or ".join(dict.fromkeys(repr(one.name) for one in structures))
            raise UsageError(f"fixed: {key} {what} of structure {used}; leave it out")
    points = _points(recordings)
    exponents = _terms_of(model)
    design = orthonormal(points, exponents)
    noise = frozenset[str]().union(*(noise_names(one) for one in _different(structures)))
    others = [q for q in parameters.values() if q.name not in (*KEY_PARAMETERS, *noise, *fixed)]
    for one in structures:
        own = [q.name for q in one.parameters]
        if lacking := [q.name for q in others if q.name not in own]:
            raise UsageError(f"structure {one.name!r} has no {', '.join(lacking)}, which another has; fix them (fixed)")
    unknown = [q.name for q in others if q.name not in model.actuators and q.start is None]
    if unknown:
        raise UsageError(f"no start for {', '.join(unknown)}; give the start model actuators, or fix them (fixed)")
    surfaces = _in_columns(model, design, exponents)
    labels = [f"{key} {i + 1}" for key in KEY_PARAMETERS for i in range(len(exponents))]
    shared = [Parameter("coefficient", v).renamed(label) for label, v in zip(labels, surfaces.tolist(), strict=True)]
    shared += [replace(q, start=model.actuators.get(q.name, q.start)) for q in others]
    k, m = len(KEY_PARAMETERS), len(surfaces)
    X = np.zeros((len(points), k + len(others), m + len(others)))
    X[:, :k, :m] = kron_designs(design.columns, k)
    X[:, k:, m:] = np.eye(len(others))
    return Setting(
        tuple(structures),
        tuple(
            Parameter(q.name, float(fixed[q.name]), fixed=True, unit=q.unit) if q.name in fixed else q
            for q in parameters.values()
        ),
        dict(fixed),
        tuple(q.name for q in parameters.values() if q.name in noise and q.name not in fixed),
        tuple(shared),
        (*KEY_PARAMETERS, *(q.name for q in others)),
        X,
        points,
        exponents,
        design,
    )


def _different(structures: Sequence[Structure]) -> list[Structure]:
    """Return each structure once."""
    return [one for i, one in enumerate(structures) if one not in structures[:i]]


def _in_columns(model: LPVModel, design: Orthonormal, exponents: Exponents) -> FloatArray:
    """Return the coefficients of a model in orthogonal terms, parameter by parameter."""
    places = [EXPONENTS.index(e) for e in exponents]
    coefficients = np.array([model.coefficients[key] for key in KEY_PARAMETERS])[:, places]
    return np.linalg.solve(design.back, coefficients.T).T.ravel()


def _factor(scatter: FloatArray) -> FloatArray:
    """Return ``L`` with ``L L' = scatter``, one column for each direction with scatter."""
    size = np.sqrt(np.diag(scatter))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(scatter / np.outer(scale, scale))
    there = values > 1e-9 * max(values[-1], 1e-300)
    return np.asarray(vectors[:, there] * np.sqrt(values[there]) * scale[:, None])


def _points(recordings: Sequence[Recording]) -> FloatArray:
    """Return the operating points of recordings, (n, 2)."""
    rows = []
    for recording in recordings:
        point = [recording.conditions.get(key) for key in ("pressure_bar", "speed_rpm")]
        if None in point:
            raise DataError(f"recording {recording.name!r} states no pressure_bar and speed_rpm; surfaces need both")
        rows.append([float(v) for v in point if v is not None])
    names = [recording.name for recording in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(f"several recordings are named {twice[0]!r}; give each its own name")
    if not rows:
        raise DataError("no recordings to fit; give at least one")
    return np.array(rows)


def _terms_of(model: LPVModel) -> Exponents:
    """Return the exponents of the terms that a model uses."""
    used = np.any([model.coefficients[key] for key in KEY_PARAMETERS], axis=0)
    return tuple(e for e, there in zip(EXPONENTS, used, strict=True) if there)
