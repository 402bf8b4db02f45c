"""One thread in each BLAS before numpy is loaded: the matrices here are small, and threads cost more than they give.

Property tests draw the same examples in every run, so that a change is judged by what it changed;
``HYPOTHESIS_PROFILE=search make unit`` draws new ones.
"""

import gc
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator

import pytest

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("GBID_CFLAGS", "-O1")  # hundreds of kernels, each for a few small fits
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a shell's way with what it starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)  # and with it for the programs that tests interrupt

from hypothesis import settings  # noqa: E402  it may load numpy

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("search", derandomize=False, deadline=None, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the pages of the documentation: they take longest, and at the end they would leave processors idle."""
    items.sort(key=lambda item: not item.name.startswith("test_code_cells_run"))
    from gbid.experiment.engines import collect_less

    gc.collect()
    collect_less()  # else each collection of garbage goes through half a million objects of pytest


@pytest.fixture(autouse=True)
def _no_figures_left() -> Iterator[None]:
    """Close the figures of a test: where pyplot was imported, pictures belong to it, and it warns at 20 of them."""
    yield
    if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
        pyplot.close("all")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """Say last what was not tested here, and why: a skip that nobody sees would pass for a test."""
    yield
    reasons = Counter(
        report.longrepr[2].removeprefix("Skipped: ")
        for report in terminalreporter.stats.get("skipped", [])
        if isinstance(report.longrepr, tuple)
    )
    for reason, tests in sorted(reasons.items()):
        terminalreporter.write_line(f"NOT TESTED HERE ({tests} skipped): {reason}", yellow=True)
