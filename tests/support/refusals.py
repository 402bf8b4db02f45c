"""Imports that are refused: one line with the name of the file."""

from pathlib import Path
from typing import Any

import pytest

from gbid.core.errors import DataError
from gbid.recording import import_recording


def refused(path: Path, mapping: dict[str, Any], *words: str, error: type[Exception] = DataError) -> str:
    with pytest.raises(error) as caught:
        import_recording(path, mapping)
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    for word in words:
        assert word in text
    return text
