"""Public names of `gbid.export`, and the files that define them: the one list."""

from .chain import (
    ChainOptions as ChainOptions,
    chain_of as chain_of,
)
from .chain_c import (
    CompiledChain as CompiledChain,
    write_chain as write_chain,
)
from .chain_python import (
    ChainInput as ChainInput,
    ChainMode as ChainMode,
    PythonChain as PythonChain,
)
from .data_files import (
    save_data as save_data,
)
from .fmu import (
    save_fmu as save_fmu,
)
from .matlab import (
    save_mat as save_mat,
)
from .ross import (
    bearing_element as bearing_element,
    from_ross as from_ross,
)
from .tables import (
    save_csv as save_csv,
    save_yaml as save_yaml,
)
