"""The C compiler of this machine, and small libraries to compile."""

import ctypes
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from gbid.core import compiled as compiler
from gbid.core.compiled import load_library

COMPILER = shutil.which(os.environ.get("CC", "cc").split()[0]) or shutil.which("gcc") or shutil.which("clang")
NEEDS_COMPILER = pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
SOURCE = "double gbid_test_{name}(void) {{ return {value}; }}\n"


def value_of(library, name):
    """What the function of a library from `SOURCE` returns."""
    function = getattr(library, f"gbid_test_{name}")
    function.restype = ctypes.c_double
    return function()


@contextmanager
def no_compiler():
    """A machine without a C compiler: what is portable runs."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("CC", "/nonexistent/cc")
        forget_libraries()
        yield
    forget_libraries()


def forget_libraries():
    """Forget what this process has loaded, as another process would begin."""
    for function in (load_library, compiler.find_compiler):
        function.cache_clear()


def load_in_a_process(folder, source, log, ready, results):
    """Load a library named race once all are ready, and write to a log where it is compiled."""
    os.environ["GBID_CACHE_DIR"] = folder
    compile_one = compiler.compile_source

    def counted(*arguments):
        with Path(log).open("a") as file:
            file.write("compiled\n")
        compile_one(*arguments)

    compiler.compile_source = counted
    ready.wait(30)
    results.put(value_of(load_library(source), "race"))
