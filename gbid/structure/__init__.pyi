"""Public names of `gbid.structure`, and the files that define them: the one list."""

from .blocks import (
    smooth_hinge as smooth_hinge,
    wiener_hammerstein as wiener_hammerstein,
)
from .built_in import (
    KEY_PARAMETERS as KEY_PARAMETERS,
    PiezoPair as PiezoPair,
    Plant as Plant,
    RotorBearing as RotorBearing,
)
from .closed_loop import (
    ClosedLoop as ClosedLoop,
)
from .delay import (
    pade_delay as pade_delay,
    with_pade as with_pade,
)
from .kinds import (
    Anatomy as Anatomy,
    AnyStructure as AnyStructure,
    Kind as Kind,
    equations_of as equations_of,
    kind_of as kind_of,
)
from .linear import (
    LinearStructure as LinearStructure,
    Matrices as Matrices,
    Structure as Structure,
    as_names as as_names,
    evaluate as evaluate,
    symbolic_matrices as symbolic_matrices,
)
from .magnetic_bearing import (
    MagneticBearing as MagneticBearing,
    RigidRotor as RigidRotor,
)
from .models import (
    LinearModel as LinearModel,
    frequency_grid as frequency_grid,
)
from .nonlinear import (
    NonlinearModel as NonlinearModel,
    NonlinearStructure as NonlinearStructure,
    nonlinear_model as nonlinear_model,
    symbolic_equations as symbolic_equations,
)
from .parameter import (
    Parameter as Parameter,
    Values as Values,
    known_names as known_names,
)
from .scheduling import (
    ScheduledStructure as ScheduledStructure,
    scheduled as scheduled,
)
from .user import (
    ModelFunctions as ModelFunctions,
    casadi_functions as casadi_functions,
    load_structure as load_structure,
    load_structure_or_model as load_structure_or_model,
)
