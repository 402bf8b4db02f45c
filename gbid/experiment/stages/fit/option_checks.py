"""Checks of the options of a fit together with its structure and recordings."""

from __future__ import annotations

from gbid.errors import GbidError
from gbid.experiment.experiment import Check, Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.stages.fit.structures import fit_disturbances, output_labels, structure_or_none
from gbid.identify.problem.initial_states import initial_states
from gbid.structure import Anatomy, AnyStructure, anatomy


def focus_sees_options(experiment: Experiment) -> Found:
    """Yield a problem for each option that has no effect on a fit for simulation."""
    for name, section in experiment.spec.fits.items():
        if section.focus != "simulation":
            continue
        if section.horizon > 1:
            yield ("fits", name, "horizon"), "a horizon is for focus: prediction; a simulation has no horizon"
        known = _known(experiment, name)
        if known is None:
            continue
        unseen = known[0].gain_only
        for key, given in (("prior", section.prior), ("local", section.local)):
            for parameter in given:
                if parameter.partition("[")[0] in unseen:
                    yield ("fits", name, key, parameter), "a simulation does not use the disturbance gain; remove it"


def vectors_have_their_length(experiment: Experiment) -> Found:
    """Yield a problem when the numbers of weights and outputs, or of initial values and states, differ."""
    for name, section in experiment.spec.fits.items():
        known = _known(experiment, name)
        if known is None:
            continue
        parts, structure = known
        labels = output_labels(experiment, name, structure)
        weights, state = section.output_weights, section.initial_state
        if weights is not None and labels and len(weights) != len(labels):
            there = ", ".join(labels)
            yield ("fits", name, "output_weights"), f"{len(weights)} weights for {len(labels)} outputs: {there}"
        if weights is not None and section.criterion == "det":
            yield (
                ("fits", name, "output_weights"),
                "are for criterion: trace; det weighs outputs by their errors",
            )
        wrong = False
        for given in state.values() if isinstance(state, dict) else (state,):
            if not isinstance(given, str) and len(given) != parts.n_states:
                yield (
                    ("fits", name, "initial_state"),
                    f"{len(given)} numbers for the {parts.n_states} states of {structure.name}; give one each",
                )
                wrong = True
        used = {q.name for q in experiment.fit_recordings(name)}
        if isinstance(state, dict) and set(state) != used:
            wrong = True
            yield ("fits", name, "initial_state"), f"give one for each recording of the fit: {', '.join(sorted(used))}"
        if not wrong:
            free = [q for q in structure.parameters if q.name not in section.fixed]
            try:
                initial_states(structure, free, state, sorted(used))
            except GbidError as error:
                yield ("fits", name, "initial_state"), str(error)


def trends_are_of_outputs(experiment: Experiment) -> Found:
    """Yield a problem for each trend and hum that the fit would refuse."""
    for name in experiment.spec.fits:
        structure = structure_or_none(experiment, name)
        if structure is None or not output_labels(experiment, name, structure):
            continue
        try:
            fit_disturbances(experiment, name, structure)
        except GbidError as error:
            yield ("fits", name, "hum" if str(error).startswith("hum") else "trend"), str(error)


def local_parameters_have_groups(experiment: Experiment) -> Found:
    """Yield a problem for local parameters of a fit to one recording, or without operating points."""
    for name, section in experiment.spec.fits.items():
        planned = experiment.fit_recordings(name)
        if section.local and (not section.together or len(planned) < 2):
            yield (
                ("fits", name, "local"),
                "is for a fit to several recordings at once; write together: true",
            )
            continue
        for parameter, scope in section.local.items():
            silent = [q.name for q in planned if not {"pressure_bar", "speed_rpm"} <= set(q.conditions)]
            if scope == "operating_point" and silent:
                yield (
                    ("fits", name, "local", parameter),
                    f"recording {silent[0]!r} has no pressure_bar and speed_rpm; add them to its conditions",
                )


def stretches_left_out_exist(experiment: Experiment) -> Found:
    """Yield a problem for each left-out stretch that is not inside a recording of the fit."""
    rig = experiment.spec.rig
    for name, section in experiment.spec.fits.items():
        used = {q.name: q for q in experiment.fit_recordings(name)}
        for recording, stretches in section.left_out.items():
            where: Location = ("fits", name, "left_out", recording)
            if recording not in used:
                yield where, f"no recording of this fit; {nearest(recording, used)}"
                continue
            for i, (begin, end) in enumerate(stretches):
                if end <= begin:
                    yield (*where, i), f"{end:g} s is not after {begin:g} s; make it larger"
                elif rig is not None and used[recording].imported is None and end > rig.duration_s:
                    yield (
                        (*where, i),
                        f"{end:g} s is beyond the end of the recording, {rig.duration_s:g} s; end it there",
                    )
        known = _known(experiment, name)
        if known is not None and section.left_out and section.horizon > 1 and section.focus == "prediction":
            parts, _ = known
            if parts.has_gain and not parts.gain_only <= set(section.fixed):
                yield (
                    ("fits", name, "left_out"),
                    "needs a horizon of 1, or a structure without disturbance gain; change one of them",
                )


def _known(experiment: Experiment, fit: str) -> tuple[Anatomy, AnyStructure] | None:
    """Return what is known of a structure, and the structure; None when another check reports it."""
    structure = structure_or_none(experiment, fit)
    if structure is None:
        return None
    try:
        return anatomy(structure), structure
    except GbidError:
        return None


OPTION_CHECKS: tuple[Check, ...] = (
    focus_sees_options,
    vectors_have_their_length,
    trends_are_of_outputs,
    local_parameters_have_groups,
    stretches_left_out_exist,
)
"""Checks of the options of fits."""
