"""Actuator parameters of the surfaces."""

from __future__ import annotations

from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.lpv.schema import LpvSection
from gbid.lpv import load_model


def lpv_actuators(experiment: Experiment, section: LpvSection) -> dict[str, float] | None:
    """Return the actuator parameters for the surfaces; None when the nominal stage will choose them.

    Raises
    ------
    UsageError
        When the nominal actuators are wanted without a section nominal, or the model is missing or has no actuators.
    """
    wanted = section.actuators
    if wanted is None:
        return {}
    if wanted == "nominal":
        if experiment.spec.nominal is None:
            raise UsageError("there is no section 'nominal'; add one, or name a model or its file")
        return None
    beside = experiment.folder / wanted
    try:
        found = load_model(beside if beside.suffix in (".yaml", ".yml") else wanted).actuators
    except UsageError as error:
        raise UsageError(f"expected nominal, or a model or its file; {error}") from None
    if not found:
        raise UsageError(f"model {wanted!r} has no actuators; name another, or write nominal")
    return dict(found)
