"""Excitation design: signals that determine the parameters of a model best within limits."""

from gbid.excite.design import design_excitation
from gbid.excite.excitation import Excitation, ExcitationLines, ExcitationSequence
from gbid.excite.excitation_file import PlayedFile, read_excitation, save_excitation
from gbid.excite.excitation_limits import ExcitationLimits, PossibleMachine
from gbid.excite.information.expected import Expected, expected_covariance
from gbid.excite.known_model import KnownModel, known_model
from gbid.excite.recording_length import RecordingLength, recording_length
from gbid.excite.rig_limits import rig_limits

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
