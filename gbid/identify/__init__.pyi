"""Public names of `gbid.identify`, and the files that define them: the one list."""

from .fitting import (
    FitProblem as FitProblem,
    fit as fit,
    fit_problem as fit_problem,
    profile as profile,
)
from .frequency_data import (
    FrequencyData as FrequencyData,
)
from .multistart import (
    MultiStart as MultiStart,
    fit_multistart as fit_multistart,
)
from .options import (
    FitOptions as FitOptions,
)
from .problem.solve import (
    Progress as Progress,
)
from .result import (
    FitResult as FitResult,
    FitStatus as FitStatus,
    Profile as Profile,
)
from .start.black_box import (
    subspace as subspace,
    subspace_orders as subspace_orders,
)
from .table import (
    FitTable as FitTable,
)
from .uncertainty.curves import (
    bode as bode,
    pole_zero as pole_zero,
    time_response as time_response,
)
from .frequency_data import (
    DelayEstimate as DelayEstimate,
    MeasuredResponse as MeasuredResponse,
    estimate_delay as estimate_delay,
    measured_response as measured_response,
)
