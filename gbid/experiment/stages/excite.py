"""Stage of the excitations of the next recordings: checks, tasks and files."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path

from gbid import excite, identify
from gbid.core.errors import GbidError, nearest
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, Item
from gbid.experiment.machine import clearance_of_rig
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work
from gbid.experiment.schema import ExciteSection
from gbid.experiment.stages.fit import fit_entries, fit_result, load_made_fit
from gbid.experiment.structures import fit_channels


def excitations_have_fits(experiment: Experiment) -> Found:
    """Yield a problem for each excitation whose fit is missing or has no inputs."""
    for name, section in experiment.spec.excite.items():
        if section.fit not in experiment.spec.fits:
            yield ("excite", name, "fit"), f"no fit {section.fit!r}; {nearest(section.fit, experiment.spec.fits)}"
            continue
        with suppress(GbidError):  # another check reports it
            if not experiment.fit_recordings(section.fit):
                text = f"fit {section.fit!r} has no recordings, whose samples and operating point are needed"
                yield ("excite", name, "fit"), text
            elif not fit_channels(experiment, section.fit)[0]:
                yield ("excite", name, "fit"), f"fit {section.fit!r} has no inputs; there is nothing to excite"


FOLDER = "excite"
_DISC = "p"


def excite_tasks(job: Job) -> Work:
    """Return a task for each model of the fit of each excitation; a failed outcome for a model that is missing."""
    experiment, work = job.experiment, list[Task | Outcome]()
    for name, section in experiment.spec.excite.items():
        for entry in fit_entries(job, section.fit):
            item = Item("excite", name, entry.model)
            if entry.result is None:
                path = experiment.path(FOLDER, *item.names, ending=".csv")
                work.append(Outcome(item, path, "failed", entry.failure, cause="input"))
                continue
            settings = {"limits": _limits(experiment, section, entry.result), **section.model_dump(exclude={"limits"})}
            source = fit_result(experiment, section.fit, entry.model)
            result = experiment.result(item, FOLDER, settings, [source], ending=".csv")
            work.append(Task.of(result, partial(_write, name=name, model=entry.model), entry.recordings))
    return work


def _limits(experiment: Experiment, section: ExciteSection, result: identify.FitResult) -> excite.ExcitationLimits:
    """Return the limits of an excitation: from its section, or such that no possible machine touches the bearing.

    The operating point is that of the first recording of the fit. Without the disc among the outputs of the fit its
    motion is not known.
    """
    limits, planned = section.limits, experiment.recordings[result.recordings[0]]
    clearance, taken, machines = limits.clearance_m, limits.taken_m, tuple[excite.PossibleMachine, ...]()
    if clearance is None and planned.imported is None and _DISC in result.options.outputs:
        clearance, ((_, taken), *others) = clearance_of_rig(experiment, planned)
        machines = tuple(excite.PossibleMachine(*other) for other in others)
    return excite.ExcitationLimits(limits.peaks, limits.radius, clearance, _DISC, taken, machines)


def _write(job: Job, part: Path, name: str, model: str) -> Made:
    section = job.experiment.spec.excite[name]
    result = load_made_fit(job, section.fit, model)
    excitation = excite.design_excitation(
        excite.known_model(result, earlier=section.together),
        duration=section.duration_s,
        sample_time=result.sample_time,
        limits=_limits(job.experiment, section, result),
        kind=section.kind,
        focus=section.focus,
    )
    excite.save_excitation(excitation, part, overwrite=True)
    sizes = {name: abs(excitation.values[name]) for name in excitation.counted}
    counted = [100 * excitation.std[name] / size for name, size in sizes.items() if size]
    mean = f"mean std expected {sum(counted) / len(counted):.3g} %; " if counted else ""
    return Made(f"{mean}limits reached: {', '.join(excitation.reached) or 'none'}")


EXCITE = Stage("excite", "excite", (excitations_have_fits,), excite_tasks)
"""``excite/<name>/<model>.csv`` with the signals of the next recording, for the signal generator and the rig."""
