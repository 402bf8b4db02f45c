"""Goals of a design, with the disturbance that recordings of the experiment show."""

from __future__ import annotations

from gbid.control import DisturbanceSpectrum, Goal, recorded_disturbance
from gbid.experiment.recordings import load_made
from gbid.experiment.run.job import Job
from gbid.experiment.stages.tune.design_goals import made_goal
from gbid.experiment.stages.tune.schema import ControllerSection


def design_goals(job: Job, section: ControllerSection) -> list[Goal] | None:
    """Return the goals of a design; None when the section has none and uses the short form.

    Raises
    ------
    DataError
        When a recording of a disturbance is missing or was made from other settings.
    """
    if section.goals is None:
        return None

    def shown(patterns: tuple[str, ...]) -> DisturbanceSpectrum:
        return recorded_disturbance([load_made(job, planned) for planned in job.experiment.matching(patterns)])

    return [made_goal(entry, shown) for entry in section.goals]
