"""Model structures: delays, rotor-bearing, actuators, their series connection, and structures of a user."""

from gbid.structure.built_in import KEY_PARAMETERS, PiezoPair, Plant, RotorBearing
from gbid.structure.closed_loop import ClosedLoop
from gbid.structure.delay import pade_delay, with_pade
from gbid.structure.kinds import Anatomy, AnyStructure, Kind, equations_of, kind_of
from gbid.structure.linear import LinearStructure, Matrices, Structure, as_names, evaluate, symbolic_matrices
from gbid.structure.models import LinearModel, frequency_grid
from gbid.structure.nonlinear import NonlinearModel, NonlinearStructure, nonlinear_model, symbolic_equations
from gbid.structure.parameter import Parameter, Values, known_names
from gbid.structure.scheduled import ScheduledStructure, scheduled
from gbid.structure.user import ModelFunctions, casadi_functions, load_structure, load_structure_or_model

__all__ = [
    "KEY_PARAMETERS",
    "Anatomy",
    "AnyStructure",
    "ClosedLoop",
    "Kind",
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
    "as_names",
    "casadi_functions",
    "equations_of",
    "evaluate",
    "frequency_grid",
    "kind_of",
    "known_names",
    "load_structure",
    "load_structure_or_model",
    "nonlinear_model",
    "pade_delay",
    "scheduled",
    "symbolic_equations",
    "symbolic_matrices",
    "with_pade",
]
