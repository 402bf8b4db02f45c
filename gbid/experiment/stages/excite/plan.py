"""Plan of an excitation: the limits of a model of a fit."""

from __future__ import annotations

from gbid.excite import ExcitationLimits, rig_limits
from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.excite.schema import ExciteSection
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import machine_at, record_options

DISC = "p"


def excitation_limits(
    experiment: Experiment, section: ExciteSection, planned: PlannedRecording, outputs: tuple[str, ...]
) -> ExcitationLimits:
    """Return the limits of an excitation; of a recording of the rig those with which its machines do not rub.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    section : ExciteSection
        Its section of the excitation.
    planned : PlannedRecording
        A recording of the fit, whose operating point counts.
    outputs : tuple of str
        Outputs of the fit; without the disc among them its motion is not known.
    """
    own = section.limits
    if own.clearance_m is None and planned.imported is None and DISC in outputs:
        return rig_limits(
            machine_at(experiment, planned, rig_model(experiment)),
            conditions=planned.conditions,
            peaks=own.peaks,
            radius=own.radius,
            scatter=record_options(experiment, planned)["scatter"],
        )
    return ExcitationLimits(own.peaks, own.radius, own.clearance_m, DISC, own.taken_m)
