"""Model structures: delays, rotor-bearing, actuators, their series connection, and structures of a user."""

from gbid.structure.any_structure import Anatomy, AnyStructure, anatomy, equations_of, model_of
from gbid.structure.delay import pade_delay
from gbid.structure.linear import LinearStructure, Matrices, Structure, as_names, evaluate, symbolic_matrices
from gbid.structure.loop.closed_loop import ClosedLoop
from gbid.structure.model_functions import ModelFunctions, casadi_functions
from gbid.structure.nonlinear.at_values import nonlinear_model
from gbid.structure.nonlinear.equations import symbolic_equations
from gbid.structure.nonlinear.nonlinear_model import NonlinearModel
from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure
from gbid.structure.numeric.frequency_grid import frequency_grid
from gbid.structure.numeric.linear_model import LinearModel
from gbid.structure.numeric.pade_model import with_pade
from gbid.structure.parameter import Parameter, Values, known_names
from gbid.structure.piezo_pair import PiezoPair
from gbid.structure.plant import Plant
from gbid.structure.rotor_bearing import KEY_PARAMETERS, RotorBearing
from gbid.structure.scheduling.scheduled_structure import ScheduledStructure, scheduled
from gbid.structure.user import load_structure, load_structure_or_model

__all__ = [
    "KEY_PARAMETERS",
    "Anatomy",
    "AnyStructure",
    "ClosedLoop",
    "LinearModel",
    "LinearStructure",
    "Matrices",
    "ModelFunctions",
    "NonlinearModel",
    "NonlinearStructure",
    "Parameter",
    "PiezoPair",
    "Plant",
    "RotorBearing",
    "ScheduledStructure",
    "Structure",
    "Values",
    "anatomy",
    "as_names",
    "casadi_functions",
    "equations_of",
    "evaluate",
    "frequency_grid",
    "known_names",
    "load_structure",
    "load_structure_or_model",
    "model_of",
    "nonlinear_model",
    "pade_delay",
    "scheduled",
    "symbolic_equations",
    "symbolic_matrices",
    "with_pade",
]
