"""Public names of `gbid.validate`, and the files that define them: the one list."""

from .central import (
    NominalActuator as NominalActuator,
    load_actuators as load_actuators,
    nominal_actuator as nominal_actuator,
)
from .comparison import (
    ModelComparison as ModelComparison,
    compare as compare,
)
from .crossval import (
    Validation as Validation,
    ValidationScores as ValidationScores,
    ValidationSummary as ValidationSummary,
    cross_validate as cross_validate,
    cross_validate_many as cross_validate_many,
    summarise as summarise,
)
from .residuals import (
    ResidualTest as ResidualTest,
    check_residuals as check_residuals,
)
from .simulate import (
    fit_percent as fit_percent,
)
