"""What an experiment means together: each check is a small function that gives the problems it finds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.checks_fits import FIT_CHECKS
from gbid.experiment.checks_options import OPTION_CHECKS
from gbid.experiment.load import Experiment
from gbid.experiment.pairs import validation_pairs
from gbid.experiment.plan import planned_recordings
from gbid.experiment.problems import Location, nearest
from gbid.experiment.sources import data_file, machine_at, mapping_of, rig_experiment
from gbid.experiment.structures import rig_model
from gbid.recording import ImportMapping
from gbid.recording.importers.importing import READERS
from gbid.rig.excitation import whole_samples

Found = Iterator[tuple[Location, str]]
Check = Callable[[Experiment], Found]


def find_experiment_problems(experiment: Experiment) -> list[tuple[Location, str]]:
    """Run all checks; one that needs what another found missing stays silent.

    Returns
    -------
    list of (location, text)
        Where in the YAML, and what is wrong; each once.
    """
    found: list[tuple[Location, str]] = []
    for check in CHECKS:
        found += check(experiment)
    return list(dict.fromkeys(found))


def has_recordings(experiment: Experiment) -> Found:
    """There is something to work on."""
    spec = experiment.spec
    if spec.rig is None and spec.imported is None:
        yield (), "no recordings: add a rig section (virtual rig) or an import section (files of your own)"
    elif not experiment.recordings:
        yield ("rig",), "makes no recordings; set recordings of prbs or stationary to at least 1"


def names_are_unique(experiment: Experiment) -> Found:
    """No two recordings share a name."""
    planned = list(planned_recordings(experiment.spec))
    counts = Counter(q.name for q in planned)
    seen: set[str] = set()
    for q in planned:
        if counts[q.name] > 1 and q.name in seen:
            where = (*q.location, "name") if q.imported else q.location
            yield where, f"a second recording named {q.name!r}; each needs a name (or operating point) of its own"
        seen.add(q.name)


def rig_runs(experiment: Experiment) -> Found:
    """Rig: its model loads and holds at each operating point; times are whole samples."""
    rig = experiment.spec.rig
    if rig is None:
        return
    try:
        model = rig_model(experiment)
    except GbidError as error:
        yield ("rig", "model"), str(error)
        return
    if not model.actuators:
        yield ("rig", "model"), f"model {model.name!r} has no actuators; the rig needs them"
        return
    inside = True
    for i, point in enumerate(rig.operating_points):
        for key in ("pressure_bar", "speed_rpm"):
            value, (low, high) = getattr(point, key), getattr(model.domain, key)
            if not low <= value <= high:
                inside = False
                yield (
                    ("rig", "operating_points", i, key),
                    f"{value:g} lies outside the domain of {model.name}, {low:g} to {high:g}; choose a value inside",
                )
    for location, seconds in (
        (("rig", "duration_s"), rig.duration_s),
        (("rig", "prbs", "hold_s"), rig.prbs.hold_s),
        (("rig", "stationary", "duration_s"), rig.stationary.duration_s),
    ):
        if seconds is not None:
            try:
                whole_samples(str(location[-1]), seconds, rig.sample_time_s)
            except UsageError as error:
                yield location, str(error)
    for planned in experiment.recordings.values():
        if inside and planned.imported is None:
            try:
                machine_at(experiment, planned, model).rotor_bearing.check_stable()
                rig_experiment(experiment, planned)
            except UsageError as error:
                yield ("rig",), str(error)
                return


def data_can_be_read(experiment: Experiment) -> Found:
    """Import: data files are there and the mappings make sense; what the files hold is looked at later."""
    section = experiment.spec.imported
    if section is None:
        return
    folder = experiment.folder / section.data_folder
    if not folder.is_dir():
        yield ("import", "data_folder"), f"no folder {folder}; give it relative to the experiment file"
    for i, entry in enumerate(section.recordings):
        here: Location = ("import", "recordings", i)
        path = data_file(experiment, entry)
        if path.suffix.lower() not in READERS:
            yield (*here, "file"), f"unknown ending {path.suffix!r}; expected one of {', '.join(READERS)}"
        elif folder.is_dir() and not path.is_file():
            yield (*here, "file"), f"no file {path}"
        try:
            ImportMapping.from_dict(mapping_of(entry))
        except (UsageError, DataError) as error:
            yield here, str(error)


def runout_maps_can_be_made(experiment: Experiment) -> Found:
    """Each operating point that is prefiltered has a stationary run, with position and angle."""
    section = experiment.spec.prefilter
    if section is None:
        return
    if section.median % 2 == 0:
        yield ("prefilter", "median"), f"{section.median} is even; give an odd size, 1 for no median"
    for planned in experiment.recordings.values():
        if planned.excited and "p" not in planned.signals:
            yield planned.location, f"recording {planned.name!r} has no signal p, which the prefilter works on"
    if section.method == "none":
        return
    still = {q.point for q in experiment.recordings.values() if not q.excited}
    told: set[str] = set()
    for planned in experiment.recordings.values():
        if planned.excited and planned.point not in still | told:
            told.add(planned.point)
            yield (
                ("prefilter",),
                f"no stationary recording at {planned.point} (as {planned.name!r}), so no run-out map; "
                "add one, or write method: none",
            )


def crossval_has_partners(experiment: Experiment) -> Found:
    """Fits to validate exist, and there are recordings to validate them on."""
    for name, section in experiment.spec.crossval.items():
        if name not in experiment.spec.fits:
            yield ("crossval", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
            continue
        special = [word for word in section.on if word in ("cyclic", "others")]
        if special and len(section.on) > 1:
            yield ("crossval", name, "on"), f"{special[0]} stands alone; list names or write {special[0]} only"
            continue
        if not special:
            for pattern in section.on:
                if not experiment.matching((pattern,)):
                    yield (
                        ("crossval", name, "on"),
                        f"no recording matches {pattern!r}; {nearest(pattern, experiment.recordings)}",
                    )
            continue
        if experiment.spec.fits[name].together and special == ["cyclic"]:
            yield ("crossval", name, "on"), "cyclic needs a fit per recording; write others or name recordings"
            continue
        pairs = validation_pairs(experiment, name)
        for model in dict.fromkeys(model for model, _ in pairs):
            if not any(m == model and recording for m, recording in pairs):
                yield ("crossval", name, "on"), f"no other recording for {model!r} at its operating point; name some"


def figures_show_fits(experiment: Experiment) -> Found:
    """Fits to draw exist, and the part shown is not empty."""
    for name, section in experiment.spec.figures.items():
        if name not in experiment.spec.fits:
            yield ("figures", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
        begin = section.from_s or 0.0
        if section.to_s is not None and section.to_s <= begin:
            yield ("figures", name, "to_s"), f"{section.to_s:g} s is not after from_s = {begin:g} s"
        rig = experiment.spec.rig
        if rig is not None and experiment.spec.imported is None and begin >= rig.duration_s:
            yield (
                ("figures", name, "from_s"),
                f"{begin:g} s lies beyond the end of the recordings, {rig.duration_s:g} s",
            )


CHECKS: tuple[Check, ...] = (
    has_recordings,
    names_are_unique,
    rig_runs,
    data_can_be_read,
    runout_maps_can_be_made,
    *FIT_CHECKS,
    *OPTION_CHECKS,
    crossval_has_partners,
    figures_show_fits,
)
"""All checks, in the order of the file's sections."""
