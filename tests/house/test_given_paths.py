"""What is no path is refused by every function that takes one, before anything is opened."""

import inspect
import os
from pathlib import Path

import numpy as np
import pytest

import gbid
from gbid.core.errors import UsageError
from gbid.core.names import LONGEST, file_stem

OF_A_PATH = [name for name in gbid.__all__ if name.startswith(("load", "import_"))]


def wrong_call(name, path):
    """Call a public function with a path, and None for what else it needs."""
    function = getattr(gbid, name)
    needed = [q for q in inspect.signature(function).parameters.values() if q.default is q.empty]
    needed = [q for q in needed if q.kind is not q.VAR_KEYWORD]
    return function(*(path if "path" in q.name else {} for q in needed))


NO_PATHS = {
    "none": None,
    "bytes": b"bytes",
    "nul": "a\0b.h5",
    "long": f"{300 * 'x'}.h5",
    "deep": f"{3000 * 'd/'}a.yaml",
}


@pytest.mark.parametrize("path", [*NO_PATHS.values(), Path("a\0b.yaml")], ids=[*NO_PATHS, "nul in a path"])
@pytest.mark.parametrize("name", OF_A_PATH)
def test_what_is_no_path_is_refused(name, path):
    with pytest.raises(
        UsageError, match=r"path = .*; give a text or Path|cannot contain a NUL|bytes, its longest part"
    ):
        wrong_call(name, path)


def test_a_recording_is_saved_to_a_path_only():
    recording = gbid.Recording({"u": np.zeros((2, 1))}, 1.0)
    for path in (None, "a\0b.h5"):
        with pytest.raises(UsageError, match=r"path = .*; give a text or Path|cannot contain a NUL"):
            gbid.save_recording(recording, path)
    assert {"load", "load_recording", "import_recording", "load_model"} <= set(OF_A_PATH)


def test_long_names_are_cut_and_stay_apart():
    names = ["x" * 400, "x" * 399 + "y", "\N{CJK UNIFIED IDEOGRAPH-6F22}" * 100]
    stems = [file_stem(name) for name in names]
    assert len(set(stems)) == len(names)
    assert all(len(os.fsencode(stem)) <= LONGEST for stem in stems)
    assert file_stem("x" * LONGEST) == "x" * LONGEST
