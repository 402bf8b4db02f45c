"""Public names of `gbid.validate`, and the files that define them: the one list."""

from .central import (
    ActuatorOutlier as ActuatorOutlier,
    NominalActuator as NominalActuator,
    load_actuators as load_actuators,
    nominal_actuator as nominal_actuator,
    save_nominal_actuator as save_nominal_actuator,
)
from .comparison import (
    ModelComparison as ModelComparison,
    compare as compare,
)
from .crossval import (
    PointSummary as PointSummary,
    Validation as Validation,
    ValidationScores as ValidationScores,
    ValidationSummary as ValidationSummary,
    WorstPair as WorstPair,
    cross_validate as cross_validate,
    cross_validate_many as cross_validate_many,
    summarise as summarise,
)
from .residuals import (
    ResidualTest as ResidualTest,
    ShaftLine as ShaftLine,
    check_residuals as check_residuals,
    shaft_lines as shaft_lines,
)
from .simulate import (
    estimate_initial_state as estimate_initial_state,
    fit_percent as fit_percent,
)
