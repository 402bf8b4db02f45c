"""Schema of the nominal section."""

from __future__ import annotations

from gbid.experiment.fields import Name, Section


class NominalSection(Section):
    """Fit whose most central model is the nominal actuator; see `gbid.nominal_actuator`."""

    fit: Name
