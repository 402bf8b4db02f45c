"""Public names of `gbid.online`, and the files that define them: the one list."""

from .balance import (
    BalanceWhileRunning as BalanceWhileRunning,
    Balancing as Balancing,
    UnbalanceEstimate as UnbalanceEstimate,
)
from .recursive import (
    LearnSample as LearnSample,
    RecursiveFit as RecursiveFit,
    RecursiveResult as RecursiveResult,
)
