"""Model for which an excitation is designed: known parameters, noise, and linearised structures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Names, check_options
from gbid.core.units import SIGNALS
from gbid.discretise import Hold
from gbid.discretise.exact import check_holds
from gbid.identify import FitResult
from gbid.identify.options import Focus
from gbid.identify.uncertainty.uncertain_model import ModelSlopes
from gbid.structure import LinearModel, LinearStructure, Parameter, Structure
from gbid.structure.kinds import kind_of
from gbid.structure.linear import as_names, evaluate
from gbid.structure.parameter import Values


def tangent_structure(fit: FitResult) -> tuple[LinearStructure, list[int]]:
    """Return a fitted model linearised in its parameters as a structure, and their indices among the free parameters.

    Its matrices are ``A(p) = A + sum dA/dp_i (p_i - p_i0)``, and so on. At the estimates it has the same predictions
    with the same derivatives as the structure of the fit, so it has the same information. A stored fit knows its
    derivatives, but not the equations.

    Parameters
    ----------
    fit : FitResult
        Fit with derivatives of its model.

    Returns
    -------
    LinearStructure
        The parameters start at the estimates.
    list of int
        Their positions among the free parameters of the fit. Parameters of other recordings, trends and hum are not
        among them.
    """
    model, slopes = fit.linear_model, fit.model_slopes
    assert slopes is not None
    acting = [i for i in range(len(fit.free)) if any(part[i].any() for part in _parts(slopes).values())]
    names = {fit.free[i]: f"p{i}" if not fit.free[i].isidentifier() else fit.free[i] for i in acting}
    parameters = [
        Parameter(names[fit.free[i]], fit.parameters[fit.free[i]], unit=fit.units[fit.free[i]]) for i in acting
    ]
    values = {"A": model.A, "B": model.B, "C": model.C, "D": model.D}
    if model.K is not None:
        values["K"] = model.K
    elif slopes.K is not None:
        values["K"] = np.zeros(slopes.K.shape[1:])
    if model.B_delayed is not None and model.delay is not None:
        values |= {"B_delayed": model.B_delayed, "delay": model.delay[:, None]}

    def matrices(p: Values) -> Mapping[str, Any]:
        steps = [p[q.name] - q.start for q in parameters]
        return {letter: _moved(value, _parts(slopes).get(letter), acting, steps) for letter, value in values.items()}

    return LinearStructure(fit.structure, parameters, matrices, model.input_names, model.output_names), acting


def _parts(slopes: ModelSlopes) -> dict[str, FloatArray]:
    parts = {"A": slopes.A, "B": slopes.B, "C": slopes.C, "D": slopes.D, "B_delayed": slopes.B_delayed}
    parts["delay"] = slopes.delay[:, :, None]
    return parts if slopes.K is None else {**parts, "K": slopes.K}


def _moved(value: FloatArray, slope: FloatArray | None, acting: list[int], steps: list[Any]) -> ca.SX:
    result = ca.SX(ca.sparsify(ca.DM(np.array(value))))
    for i, step in zip(acting, steps, strict=True):
        if slope is not None and slope[i].any():
            result += ca.SX(ca.sparsify(ca.DM(np.array(slope[i])))) * step
    return result


@dataclass(frozen=True, eq=False)
class KnownModel(Brief):
    """Structure with known parameters and output noise, for which an expected covariance is computed.

    Parameters
    ----------
    structure : Structure
        Linear structure, as a fit to the coming recording will use it.
    parameters : dict of str to float
        Values of the parameters: of a fit, of the literature, or the truth of a rig. Others have the start values of
        the structure, and further names are ignored.
    noise : (n_outputs,) or (n_outputs, n_outputs) array
        Standard deviations of the errors of the predictions in the units of the outputs, or their covariance. Without
        disturbance gain this is the noise of the sensors.
    fixed : sequence of str
        Parameters that the coming fit will not estimate.
    inputs, outputs : str or sequence of str, optional
        Signals of the recordings; by default those of the structure.
    focus : {"prediction", "simulation"}
        Focus of the coming fit.
    intersample : {"zoh", "foh"} or sequence, optional
        Behaviour of the inputs between samples; by default that of the structure.
    earlier : (n_free, n_free) array, optional
        Information on the free parameters from earlier recordings: the inverse of their covariance.

    Raises
    ------
    UsageError
        When a value is missing, the structure is nonlinear or has no inputs, or the noise does not fit the outputs.
    """

    structure: Structure
    parameters: Mapping[str, float]
    noise: FloatArray
    fixed: Names = ()
    inputs: Names = ()
    outputs: Names = ()
    focus: Focus = "prediction"
    intersample: tuple[Hold, ...] = ()
    earlier: FloatArray | None = None
    model: LinearModel = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", np.atleast_1d(self.noise))  # one number for all outputs
        check_options(self, "KnownModel")
        if kind_of(self.structure).nonlinear:
            raise UsageError(
                f"structure {self.structure.name!r} is nonlinear; an excitation is designed for a linear model: give "
                "the result of its fit, which has the linear model at the working point"
            )
        inputs = as_names(self.inputs or self.structure.inputs)
        outputs = as_names(self.outputs or self.structure.outputs)
        starts = {q.name: q.start for q in self.structure.parameters if q.start is not None}
        names = [q.name for q in self.structure.parameters]
        known = {**starts, **{name: float(value) for name, value in self.parameters.items() if name in names}}
        plain = evaluate(self.structure, known)
        n_y, n_u = plain.D.shape
        if not n_u:
            raise UsageError(f"structure {self.structure.name!r} has no inputs; there is nothing to excite")
        noise = np.asarray(self.noise, float)
        if noise.shape in ((1,), (n_y,)):
            noise = np.diag(np.broadcast_to(noise, (n_y,)) ** 2)
        if noise.shape != (n_y, n_y) or not np.isfinite(noise).all() or np.linalg.eigvalsh(noise)[0] <= 0:
            raise UsageError(
                f"noise of shape {np.shape(self.noise)}: give one positive standard deviation for each of the {n_y} "
                "outputs, or their covariance"
            )
        held = tuple(dict.fromkeys((*as_names(self.fixed), *(q.name for q in self.structure.parameters if q.fixed))))
        if unknown := [name for name in held if name not in names]:
            raise UsageError(f"fixed names {unknown[0]!r}; the structure has {', '.join(names)}")
        hold: Hold | Sequence[Hold] = self.intersample or self.structure.intersample
        values = {
            "parameters": known,
            "inputs": inputs,
            "outputs": outputs,
            "noise": noise,
            "fixed": held,
            "intersample": check_holds(hold, n_u),
            "model": replace(plain, input_names=tuple(_labels(inputs, n_u)), output_names=tuple(_labels(outputs, n_y))),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def earlier_of(self, free: tuple[str, ...]) -> FloatArray | None:
        """Return the information on the free parameters from earlier recordings; None without them.

        Parameters
        ----------
        free : tuple of str
            Names of the free parameters.

        Raises
        ------
        UsageError
            When it is not of their number.
        """
        if self.earlier is not None and np.shape(self.earlier) != (len(free), len(free)):
            raise UsageError(
                f"earlier information of shape {np.shape(self.earlier)}; the free parameters are {', '.join(free)}"
            )
        return self.earlier

    def channels(self, signal: str) -> tuple[bool, list[int]]:
        """Return whether a signal or channel is an input, and its columns.

        Parameters
        ----------
        signal : str
            Signal (``"p"``) or channel (``"p.x"``).

        Raises
        ------
        UsageError
            When the model has no such signal.
        """
        for is_input, names, labels in (
            (True, self.inputs, self.model.input_names),
            (False, self.outputs, self.model.output_names),
        ):
            if signal in names:
                per = len(labels) // len(names)
                first = names.index(signal) * per
                return is_input, list(range(first, first + per))
            if signal in labels or signal.replace(".", "_") in labels:
                return is_input, [labels.index(signal.replace(".", "_"))]
        known = (*self.inputs, *self.outputs, *self.model.input_names, *self.model.output_names)
        raise UsageError(f"the model has no signal {signal!r}; it has {', '.join(dict.fromkeys(known))}")


def known_model(model: Any, earlier: bool = True) -> KnownModel:
    """Return the model for an excitation design from a fit; a `KnownModel` is returned unchanged.

    Parameters
    ----------
    model : FitResult or KnownModel
        The model. Of a fit, parameters, prediction errors and options are those of the next fit. Its structure is
        replaced by matrices that are linear in the parameters, with the derivatives of the fit: information needs
        first derivatives only.
    earlier : bool
        Whether the information of the fit counts as that of an earlier recording.

    Raises
    ------
    UsageError
        For anything else, and for a fit without standard deviations.
    """
    if isinstance(model, KnownModel):
        return model
    if not isinstance(model, FitResult):
        raise UsageError(
            f"{type(model).__name__} has no parameters with noise; give a FitResult, or a KnownModel of a structure, "
            "its parameters and the noise of the outputs"
        )
    slopes, linear = model.model_slopes, model.linear_model
    if slopes is None or not np.isfinite(model.covariance).all():
        raise UsageError(f"the fit of {model.structure} ({model.status}) has no covariance; design from another fit")
    structure, acting = tangent_structure(model)
    covariance = model.covariance[np.ix_(acting, acting)]
    n_u, n_y = linear.B.shape[1], linear.C.shape[0]
    return KnownModel(
        structure,
        {q.name: float(q.start or 0.0) for q in structure.parameters},
        model.error_covariance,
        inputs=_signals(model.options.inputs, n_u, linear.input_names),
        outputs=_signals(model.options.outputs, n_y, linear.output_names),
        focus=model.options.focus,
        intersample=model.options.intersample,
        earlier=np.asarray(np.linalg.inv(covariance), float) if earlier else None,
    )


def _labels(signals: tuple[str, ...], count: int) -> list[str]:
    """Return channel labels such as ``p_x``; unknown signals with several channels get numbers."""
    per, labels = count // len(signals), list[str]()
    if per * len(signals) != count:
        raise UsageError(f"{count} noises for the channels of {', '.join(signals)}; name channels instead of signals")
    for signal in signals:
        known = SIGNALS.get(signal)
        names = known.channels if known and len(known.channels) == per else tuple(str(i + 1) for i in range(per))
        labels += [signal.replace(".", "_")] if per == 1 else [f"{signal}_{name}" for name in names]
    return labels


def _signals(names: tuple[str, ...], count: int, labels: tuple[str, ...]) -> tuple[str, ...]:
    return names if names and count % len(names) == 0 else labels
