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
    with_pade as with_pade,
)
from .linear import (
    LinearStructure as LinearStructure,
    Structure as Structure,
    evaluate as evaluate,
)
from .magnetic_bearing import (
    MagneticBearing as MagneticBearing,
    RigidRotor as RigidRotor,
)
from .models import (
    LinearModel as LinearModel,
)
from .nonlinear import (
    NonlinearModel as NonlinearModel,
    NonlinearStructure as NonlinearStructure,
    nonlinear_model as nonlinear_model,
)
from .parameter import (
    Parameter as Parameter,
    Values as Values,
)
from .scheduling import (
    ScheduledStructure as ScheduledStructure,
    scheduled as scheduled,
)
from .user import (
    casadi_functions as casadi_functions,
    load_structure as load_structure,
)
