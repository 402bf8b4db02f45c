"""Public names of `gbid.excite`, and the files that define them: the one list."""

from .design import (
    RecordingLength as RecordingLength,
    design_excitation as design_excitation,
    recording_length as recording_length,
)
from .excitation import (
    Excitation as Excitation,
    ExcitationLines as ExcitationLines,
    ExcitationSequence as ExcitationSequence,
    PlayedFile as PlayedFile,
    read_excitation as read_excitation,
    save_excitation as save_excitation,
)
from .goal import (
    Expected as Expected,
    expected_covariance as expected_covariance,
)
from .limits import (
    ExcitationLimits as ExcitationLimits,
    PossibleMachine as PossibleMachine,
)
from .model import (
    KnownModel as KnownModel,
    known_model as known_model,
)
