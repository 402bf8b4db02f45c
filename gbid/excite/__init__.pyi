"""Public names of `gbid.excite`, and the files that define them: the one list."""

from .design import (
    design_excitation as design_excitation,
    recording_length as recording_length,
)
from .excitation import (
    Excitation as Excitation,
    read_excitation as read_excitation,
    save_excitation as save_excitation,
)
from .limits import (
    ExcitationLimits as ExcitationLimits,
    PossibleMachine as PossibleMachine,
)
from .model import (
    KnownModel as KnownModel,
    known_model as known_model,
)
