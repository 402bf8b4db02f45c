"""Public names of `gbid.identify`, and the files that define them: the one list."""

from .data import (
    select as select,
)
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
    Minimum as Minimum,
    MultiStart as MultiStart,
    fit_multistart as fit_multistart,
)
from .options import (
    FitOptions as FitOptions,
    SettledOptions as SettledOptions,
)
from .problem.solve import (
    Progress as Progress,
)
from .result import (
    FitResult as FitResult,
    FitStatus as FitStatus,
    Profile as Profile,
    StartsTried as StartsTried,
    load_fit as load_fit,
    save_fit as save_fit,
)
from .start.black_box import (
    SubspaceOrders as SubspaceOrders,
    subspace as subspace,
    subspace_orders as subspace_orders,
)
from .table import (
    FitRow as FitRow,
    FitTable as FitTable,
    TableEntry as TableEntry,
    load_table as load_table,
    save_table as save_table,
    tabulate as tabulate,
)
from .uncertainty.curves import (
    Bode as Bode,
    PoleZero as PoleZero,
    TimeResponse as TimeResponse,
    bode as bode,
    pole_zero as pole_zero,
    time_response as time_response,
)
from .uncertainty.residual_tests import (
    Whiteness as Whiteness,
    correlation as correlation,
    whiteness_test as whiteness_test,
)
from .spectra import (
    DelayEstimate as DelayEstimate,
    MeasuredResponse as MeasuredResponse,
    estimate_delay as estimate_delay,
    measured_response as measured_response,
)
from .uncertainty.uncertain_model import (
    ModelLike as ModelLike,
    ModelSlopes as ModelSlopes,
    UncertainModel as UncertainModel,
)
