"""Excitation design: signals that determine the parameters of a model best within limits."""

from gbid.excite.design import design_excitation
from gbid.excite.excitation import Excitation, ExcitationLines, ExcitationSequence
from gbid.excite.excitation_limits import ExcitationLimits, PossibleMachine
from gbid.excite.information.expected import Expected, expected_covariance
from gbid.excite.known_model import KnownModel, known_model
from gbid.excite.rig_limits import rig_limits

__all__ = [
    "Excitation",
    "ExcitationLimits",
    "ExcitationLines",
    "ExcitationSequence",
    "Expected",
    "KnownModel",
    "PossibleMachine",
    "design_excitation",
    "expected_covariance",
    "known_model",
    "rig_limits",
]
