"""What an experiment means together: each check is a small function that gives the problems it finds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from gbid.errors import DataError, UsageError
from gbid.experiment.checks_control import designs_can_be_tuned
from gbid.experiment.checks_fits import FIT_CHECKS, structure_or_none
from gbid.experiment.checks_impacts import impacts_can_be_made
from gbid.experiment.checks_lpv import surfaces_can_be_drawn
from gbid.experiment.checks_options import OPTION_CHECKS
from gbid.experiment.checks_rig import RIG_CHECKS
from gbid.experiment.checks_static import static_makes_sense
from gbid.experiment.load import Experiment
from gbid.experiment.pairs import SPECIAL, validation_pairs
from gbid.experiment.plan import planned_recordings
from gbid.experiment.problems import Location, nearest
from gbid.experiment.sources import data_file, mapping_of
from gbid.recording import ImportMapping
from gbid.recording.importers.importing import READERS
from gbid.validate.central import ACTUATOR

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
    elif spec.rig is not None and not (experiment.recordings or spec.impacts or spec.controller):
        yield ("rig",), "makes no recordings; set recordings of prbs or stationary to at least 1"


def names_are_unique(experiment: Experiment) -> Found:
    """No two recordings share a name."""
    planned = list(planned_recordings(experiment.spec, experiment.imports.files))
    counts = Counter(q.name for q in planned)
    seen: set[str] = set()
    rig = experiment.spec.rig
    points = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points] if rig else []
    twice: dict[Location, int] = {
        ("rig", "operating_points", i): points.index(point) for i, point in enumerate(points) if points.index(point) < i
    }
    for here, first in twice.items():
        yield here, f"the same operating point as operating_points[{first}]; delete one of the two"
    for q in planned:
        if q.location in twice:
            continue  # told above, once for all recordings of the point
        if counts[q.name] > 1 and q.name in seen:
            where = (*q.location, "name") if q.imported and "recordings" in q.location else q.location
            yield where, f"a second recording named {q.name!r}; each needs a name (or operating point) of its own"
        seen.add(q.name)


def data_can_be_read(experiment: Experiment) -> Found:
    """Import: data files are there and the mappings make sense; what the files hold is looked at later."""
    section = experiment.spec.imported
    if section is None:
        return
    folder = experiment.folder / section.data_folder
    if not folder.is_dir():
        yield ("import", "data_folder"), f"no folder {folder}; give it relative to the experiment file"
    yield from experiment.imports.problems
    told: set[str] = set()
    for found in experiment.imports.files:
        entry, here = found.entry, found.location
        path = data_file(experiment, entry)
        listed = "recordings" in here
        if not listed and str(here) in told:
            continue  # all files of a folder share one mapping
        told.add(str(here))
        here_file = (*here, "file") if listed else here
        if path.suffix.lower() not in READERS:
            yield here_file, f"unknown ending {path.suffix!r}; expected one of {', '.join(READERS)}"
        elif folder.is_dir() and not path.is_file():
            yield here_file, f"no file {path}; put it there, or correct the name or data_folder"
        try:
            ImportMapping.from_dict(mapping_of(entry))
        except (UsageError, DataError) as error:
            yield here if listed else here[:2], str(error)


def runout_maps_can_be_made(experiment: Experiment) -> Found:
    """Each operating point that is prefiltered has a stationary run, with position and angle."""
    section = experiment.spec.prefilter
    if section is None:
        return
    if section.median % 2 == 0:
        yield ("prefilter", "median"), f"{section.median} is even; give an odd size, 1 for no median"
    for planned in experiment.recordings.values():
        if planned.excited and "p" not in planned.signals:
            text = f"recording {planned.name!r} has no signal p, which the prefilter works on"
            yield planned.location, f"{text}; name one so, or remove the section prefilter"
    if section.method == "none":
        return
    still = {q.point for q in experiment.recordings.values() if q.stationary}
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
        if f"{name}_summary" in experiment.spec.crossval:
            text = f"its file {name}_summary.csv is that of the summary of {name}; rename one of the two fits"
            yield ("crossval", f"{name}_summary"), text
        special = [word for word in section.on if word in SPECIAL]
        if special and len(section.on) > 1:
            yield ("crossval", name, "on"), f"{special[0]} stands alone; list names or write {special[0]} only"
            continue
        if not special:
            for pattern in section.on:
                if not experiment.matching((pattern,)):
                    yield (
                        ("crossval", name, "on"),
                        f"no recording matches {pattern!r}; {nearest(pattern, (*SPECIAL, *experiment.recordings))}",
                    )
            continue
        if experiment.spec.fits[name].together and special == ["cyclic"]:
            text = "cyclic needs a fit per recording; write others or point, or name recordings"
            yield ("crossval", name, "on"), text
            continue
        pairs = validation_pairs(experiment, name)
        for model in dict.fromkeys(model for model, _ in pairs):
            if not any(m == model and recording for m, recording in pairs):
                where = "" if special == ["others"] else " at its operating point"
                yield ("crossval", name, "on"), f"no other recording for {model!r}{where}; name some"
                break


def nominal_is_an_actuator(experiment: Experiment) -> Found:
    """Nominal: its fit exists, has its parameters, and gives several models."""
    section = experiment.spec.nominal
    if section is None:
        return
    where: Location = ("nominal", "fit")
    if section.fit not in experiment.spec.fits:
        yield where, f"no fit of this name; {nearest(section.fit, experiment.spec.fits)}"
        return
    if experiment.spec.fits[section.fit].together:
        yield where, f"{section.fit} is one model for all recordings; name a fit per recording"
    structure = structure_or_none(experiment, section.fit)
    missing = [n for n in ACTUATOR if n not in {q.name for q in structure.parameters}] if structure else []
    if missing:
        yield where, f"{section.fit} has no parameters {', '.join(missing)}; name a fit of piezo_pair or plant"


def figures_show_fits(experiment: Experiment) -> Found:
    """Fits to draw exist, and the part shown is not empty."""
    for name, section in experiment.spec.figures.items():
        if name not in experiment.spec.fits:
            yield ("figures", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
        begin = section.from_s or 0.0
        if section.to_s is not None and section.to_s <= begin:
            yield ("figures", name, "to_s"), f"{section.to_s:g} s is not after from_s = {begin:g} s; make it larger"
        rig = experiment.spec.rig
        if rig is not None and experiment.spec.imported is None and begin >= rig.duration_s:
            yield (
                ("figures", name, "from_s"),
                f"{begin:g} s lies beyond the end of the recordings, {rig.duration_s:g} s; make it smaller",
            )


CHECKS: tuple[Check, ...] = (
    has_recordings,
    names_are_unique,
    *RIG_CHECKS,
    data_can_be_read,
    runout_maps_can_be_made,
    static_makes_sense,
    *FIT_CHECKS,
    *OPTION_CHECKS,
    crossval_has_partners,
    nominal_is_an_actuator,
    surfaces_can_be_drawn,
    designs_can_be_tuned,
    impacts_can_be_made,
    figures_show_fits,
)
"""All checks, in the order of the file's sections."""
