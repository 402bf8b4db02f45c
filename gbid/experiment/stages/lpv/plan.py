"""Which actuators the surfaces of an experiment carry."""

from __future__ import annotations

from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.lpv.schema import LpvSection
from gbid.lpv import load_model


def lpv_actuators(experiment: Experiment, section: LpvSection) -> dict[str, float] | None:
    """Give the actuators that surfaces are to carry: those of a model; None when they are still to be chosen.

    Raises
    ------
    UsageError
        When they are to be the nominal ones and no section chooses these; for a model that is not there, or knows none.
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
        raise UsageError(f"model {wanted!r} knows no actuators; name another, or write nominal")
    return dict(found)
