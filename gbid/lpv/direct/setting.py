"""What the direct LPV fit of surfaces shares between recordings, and what each has for itself."""

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
from gbid.lpv.surface_fit.fit_lpv import kron_designs
from gbid.lpv.surface_fit.terms import Exponents, Orthonormal, orthonormal
from gbid.recording import Recording
from gbid.structure import KEY_PARAMETERS, Parameter, Structure


@dataclass(frozen=True, eq=False)
class Setting:
    """A direct LPV fit, set up.

    Attributes
    ----------
    structure : Structure
    parameters : tuple of Parameter
        The structure's, with what is held.
    held : dict of str to float
        Parameters that keep a value.
    gains : tuple of str
        Disturbance gains that are estimated, each recording's own.
    shared : tuple of Parameter
        Coefficients of the surfaces in orthogonal terms, then actuators.
    names : tuple of str
        What these make: the key parameters, then actuators.
    X : (n, n_names, n_shared) array
        How they make it, for each recording.
    points : (n, 2) array
        Operating points, bar and rpm.
    exponents : tuple of (int, int)
        Terms in use.
    design : Orthonormal
    """

    structure: Structure
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
        """Where the shared unknowns start, (n_shared,)."""
        return np.array([q.start or 0.0 for q in self.shared])

    def ties(self, scatter: FloatArray) -> Ties:
        """How unknowns make parameters, with a scatter (n_names, n_names) between recordings.

        What a recording lies off the surfaces is ``lift @ own``, `own` of variance one.
        """
        lift = _factor(scatter)
        own = tuple(Parameter(f"off_{i + 1}", 0.0) for i in range(lift.shape[1]))
        return Ties(self.names, self.shared, self.X, own, lift)

    def coefficients(self, shared: FloatArray) -> FloatArray:
        """Coefficients of the six terms in bar and rpm, (14, 6), from the shared unknowns."""
        k, m = len(KEY_PARAMETERS), len(self.exponents)
        found = np.zeros((k, len(EXPONENTS)))
        found[:, [EXPONENTS.index(e) for e in self.exponents]] = shared[: k * m].reshape(k, m) @ self.design.back.T
        return found


def set_up(
    recordings: Sequence[Recording], model: LPVModel, structure: Structure, fixed: Mapping[str, float]
) -> Setting:
    """Set a direct LPV fit up; parameters, errors and what is returned are told at `gbid.fit_lpv_direct`."""
    names = [q.name for q in structure.parameters]
    missing = [key for key in KEY_PARAMETERS if key not in names]
    if missing:
        raise UsageError(f"structure {structure.name!r} has no {', '.join(missing)}; surfaces need all key parameters")
    for key in fixed:
        if key in KEY_PARAMETERS or key not in names:
            what = "is a surface, which is estimated" if key in KEY_PARAMETERS else "is no parameter"
            raise UsageError(f"fixed: {key} {what} of structure {structure.name!r}; leave it out")
    points = _points(recordings)
    exponents = _terms_of(model)
    design = orthonormal(points, exponents)
    noise = noise_names(structure)
    others = [q for q in structure.parameters if q.name not in (*KEY_PARAMETERS, *noise, *fixed)]
    unknown = [q.name for q in others if q.name not in model.actuators and q.start is None]
    if unknown:
        raise UsageError(f"no start for {', '.join(unknown)}; give the start's model actuators, or hold them (fixed)")
    surfaces = _in_columns(model, design, exponents)
    labels = [f"{key} {i + 1}" for key in KEY_PARAMETERS for i in range(len(exponents))]
    shared = [Parameter("coefficient", v).renamed(label) for label, v in zip(labels, surfaces.tolist(), strict=True)]
    shared += [replace(q, start=model.actuators.get(q.name, q.start)) for q in others]
    k, m = len(KEY_PARAMETERS), len(surfaces)
    X = np.zeros((len(points), k + len(others), m + len(others)))
    X[:, :k, :m] = kron_designs(design.columns, k)
    X[:, k:, m:] = np.eye(len(others))
    return Setting(
        structure,
        tuple(
            Parameter(q.name, float(fixed[q.name]), fixed=True, unit=q.unit) if q.name in fixed else q
            for q in structure.parameters
        ),
        dict(fixed),
        tuple(q.name for q in structure.parameters if q.name in noise and q.name not in fixed),
        tuple(shared),
        (*KEY_PARAMETERS, *(q.name for q in others)),
        X,
        points,
        exponents,
        design,
    )


def _in_columns(model: LPVModel, design: Orthonormal, exponents: Exponents) -> FloatArray:
    """Coefficients of a model in orthogonal terms, parameter by parameter."""
    places = [EXPONENTS.index(e) for e in exponents]
    coefficients = np.array([model.coefficients[key] for key in KEY_PARAMETERS])[:, places]
    return np.linalg.solve(design.back, coefficients.T).T.ravel()


def _factor(scatter: FloatArray) -> FloatArray:
    """``L`` with ``L L' = scatter``, a column for each direction that scatters at all."""
    size = np.sqrt(np.diag(scatter))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(scatter / np.outer(scale, scale))
    there = values > 1e-9 * max(values[-1], 1e-300)
    return np.asarray(vectors[:, there] * np.sqrt(values[there]) * scale[:, None])


def _points(recordings: Sequence[Recording]) -> FloatArray:
    """Operating points of recordings, (n, 2)."""
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
    """Terms that a model uses."""
    used = np.any([model.coefficients[key] for key in KEY_PARAMETERS], axis=0)
    return tuple(e for e, there in zip(EXPONENTS, used, strict=True) if there)
