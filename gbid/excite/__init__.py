"""Excitation design: signals that determine the parameters of a model best within limits."""

from gbid.excite.design import RecordingLength, design_excitation, recording_length
from gbid.excite.excitation import (
    Excitation,
    ExcitationLines,
    ExcitationSequence,
    PlayedFile,
    read_excitation,
    save_excitation,
)
from gbid.excite.goal import Expected, expected_covariance
from gbid.excite.limits import ExcitationLimits, PossibleMachine, rig_limits
from gbid.excite.model import KnownModel, known_model

__all__ = [
    "Excitation",
    "ExcitationLimits",
    "ExcitationLines",
    "ExcitationSequence",
    "Expected",
    "KnownModel",
    "PlayedFile",
    "PossibleMachine",
    "RecordingLength",
    "design_excitation",
    "expected_covariance",
    "known_model",
    "read_excitation",
    "recording_length",
    "rig_limits",
    "save_excitation",
]
