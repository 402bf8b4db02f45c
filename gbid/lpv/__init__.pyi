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
)
from .model import (
    Domain as Domain,
    LPVModel as LPVModel,
    MachineData as MachineData,
    characteristics as characteristics,
)
from .model_file import (
    load_machine as load_machine,
    load_model as load_model,
    save_model as save_model,
)
