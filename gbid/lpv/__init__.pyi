"""Public names of `gbid.lpv`, and the files that define them: the one list."""

from .direct import (
    fit_lpv_direct as fit_lpv_direct,
    lpv_of as lpv_of,
)
from .estimates import (
    Estimates as Estimates,
)
from .fit import (
    LPVFit as LPVFit,
    fit_lpv as fit_lpv,
    load_lpv_fit as load_lpv_fit,
    save_lpv_fit as save_lpv_fit,
)
from .model import (
    ACTUATOR_PARAMETERS as ACTUATOR_PARAMETERS,
    CHARACTERISTICS as CHARACTERISTICS,
    EXPONENTS as EXPONENTS,
    TERMS as TERMS,
    Deviation as Deviation,
    Domain as Domain,
    LPVModel as LPVModel,
    MachineData as MachineData,
    basis as basis,
    characteristics as characteristics,
    polynomial as polynomial,
    regressors as regressors,
)
from .model_file import (
    Correction as Correction,
    PiezoController as PiezoController,
    PiezoControllers as PiezoControllers,
    ProportionalDesign as ProportionalDesign,
    PublishedMachine as PublishedMachine,
    Quantity as Quantity,
    ReferenceModes as ReferenceModes,
    load_machine as load_machine,
    load_model as load_model,
    save_model as save_model,
)
from .regression import (
    OrderScore as OrderScore,
    Outlier as Outlier,
)
