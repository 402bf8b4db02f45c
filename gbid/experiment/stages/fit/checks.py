"""Checks of the fits of an experiment."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from gbid.errors import GbidError
from gbid.experiment.experiment import Check, Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.stages.fit.schema import FitSection
from gbid.experiment.stages.fit.structures import (
    fit_channels,
    fit_disturbances,
    make_structure,
    plant_structure,
    structure_or_none,
)
from gbid.experiment.stages.loop.plan import found_controller
from gbid.experiment.stages.loop.schema import LoopSection
from gbid.structure import AnyStructure, Parameter, anatomy


def structures_load(experiment: Experiment) -> Found:
    """Yield a problem for each fit whose structure is unknown or cannot be built."""
    for name, section in experiment.spec.fits.items():
        try:
            plant_structure(experiment, name)
        except GbidError as error:
            key = "options" if "option" in str(error) else "structure"
            yield ("fits", name, key), str(error)
            continue
        if section.loop is not None and not _controller_is_found(experiment, section.loop):
            continue  # the checks of loops report it
        try:
            anatomy(make_structure(experiment, name, planned=True))
        except GbidError as error:
            yield ("fits", name, "structure" if section.loop is None else "loop"), str(error)


def _controller_is_found(experiment: Experiment, section: LoopSection) -> bool:
    try:
        found_controller(experiment, section, planned=True)
    except GbidError:
        return False
    return True


def fits_find_recordings(experiment: Experiment) -> Found:
    """Yield a problem for each pattern that matches no recording."""
    for name, section in experiment.spec.fits.items():
        for pattern in section.recordings or ():
            if not experiment.matching((pattern,)):
                yield (
                    ("fits", name, "recordings"),
                    f"no recording matches {pattern!r}; {nearest(pattern, experiment.recordings)}",
                )
        if section.recordings is None and experiment.recordings and not experiment.fit_recordings(name):
            yield ("fits", name), "there are no excited recordings; name the recordings to fit"


def parameters_are_known(experiment: Experiment) -> Found:
    """Yield problems of parameter names, start values, fixed values and bounds."""
    for name, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, name)
        if structure is None:
            continue
        known = {q.name: q for q in structure.parameters}
        disturbing = _disturbing(experiment, name, structure)
        given: dict[str, Collection[str]] = {
            "start": _given_starts(section),
            "fixed": section.fixed,
            "bounds": section.bounds,
            "prior": section.prior,
            "local": section.local,
        }
        for key, parameters in given.items():
            for parameter in parameters:
                if key == "prior" and parameter.partition("[")[0] in disturbing:
                    continue
                if (parameter.partition("[")[0] if key == "prior" else parameter) not in known:
                    where = ("fits", name, key, parameter)
                    yield where, f"no parameter of {structure.name}; {nearest(parameter, known)}"
                elif key != "fixed" and parameter.partition("[")[0] in section.fixed:
                    yield ("fits", name, key, parameter), "the parameter is fixed; remove one of the two"
        yield from _bounds_hold(name, section, known)


def _disturbing(experiment: Experiment, fit: str, structure: AnyStructure) -> list[str]:
    """Return the names of the coefficients of trends and hum; none where another check reports their options."""
    try:
        return list(fit_disturbances(experiment, fit, structure).names)
    except GbidError:
        return []


def _given_starts(section: FitSection) -> Mapping[str, float]:
    """Return the start values of a section; none where the fit finds them in the data."""
    return {} if isinstance(section.start, str) else section.start


def _bounds_hold(name: str, section: FitSection, known: Mapping[str, Parameter]) -> Found:
    """Yield a problem for bounds that are not in order or exclude the start value."""
    for parameter, (low, high) in section.bounds.items():
        where = ("fits", name, "bounds", parameter)
        lower, upper = float("-inf") if low is None else low, float("inf") if high is None else high
        if not lower < upper:
            yield where, f"the lower bound {lower:g} is not below the upper one {upper:g}; swap or change them"
        elif parameter in known:
            start = _given_starts(section).get(parameter, known[parameter].start)
            if start is not None and section.start != "data" and not lower <= start <= upper:
                yield where, f"the bounds exclude the start value {start:g}; widen them or give another start"
    for parameter, start in _given_starts(section).items():
        if parameter in known and parameter not in section.bounds:
            lower, upper = known[parameter].lower, known[parameter].upper
            if not lower <= start <= upper:
                where = ("fits", name, "start", parameter)
                yield where, f"{start:g} lies outside the bounds {lower:g} to {upper:g}; give bounds as well"


def signals_are_there(experiment: Experiment) -> Found:
    """Yield a problem for each signal or channel that a recording of a fit does not have."""
    for name, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, name)
        if structure is None:
            continue
        for key, given, used in zip(
            ("inputs", "outputs"), (section.inputs, section.outputs), fit_channels(experiment, name), strict=True
        ):
            where: Location = ("fits", name, key) if given else ("fits", name)
            for wanted in used:
                yield from ((where, text) for text in _missing(experiment, name, wanted))


def _missing(experiment: Experiment, fit: str, wanted: str) -> Iterator[str]:
    signal, _, channel = wanted.partition(".")
    for planned in experiment.fit_recordings(fit):
        if signal not in planned.signals:
            yield f"recording {planned.name!r} has no signal {signal!r}; {nearest(signal, planned.signals)}"
            return
        if channel and channel not in planned.signals[signal]:
            there = nearest(channel, planned.signals[signal])
            yield f"recording {planned.name!r}: signal {signal!r} has no channel {channel!r}; {there}"
            return


FIT_CHECKS: tuple[Check, ...] = (
    structures_load,
    fits_find_recordings,
    parameters_are_known,
    signals_are_there,
)
"""Checks of the fits."""


def a_fit_is_named(experiment: Experiment, where: Location, name: str, needed: Sequence[str], remedy: str) -> Found:
    """Yield problems of a section that starts from the models of a fit, one per recording.

    Parameters
    ----------
    experiment : Experiment
    where : Location
        Entry with the name of the fit.
    name : str
        Fit that is named there.
    needed : sequence of str
        Parameters that its structure must have.
    remedy : str
        Which fit to name instead.
    """
    if name not in experiment.spec.fits:
        yield where, f"no fit of this name; {nearest(name, experiment.spec.fits)}"
        return
    if experiment.spec.fits[name].together:
        yield where, f"{name} is one model for all recordings; name a fit per recording"
    structure = structure_or_none(experiment, name)
    missing = [n for n in needed if n not in {q.name for q in structure.parameters}] if structure else []
    if missing:
        yield where, f"{name} has no parameters {', '.join(missing)}; {remedy}"
