"""Public names of `gbid.recording`, and the files that define them: the one list."""

from .importing import (
    import_recording as import_recording,
    load_iddata as load_iddata,
)
from .mapping import (
    ImportMapping as ImportMapping,
    SignalMapping as SignalMapping,
)
from .quality import (
    find_problems as find_problems,
)
from .recording import (
    Recording as Recording,
    load_recording as load_recording,
    save_recording as save_recording,
    with_unbalance as with_unbalance,
)
