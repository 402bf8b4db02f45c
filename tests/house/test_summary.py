"""What was not tested is said in the last lines."""

import pytest
from places import ROOT

pytest_plugins = ("pytester",)
SKIPPED = """
import pytest

@pytest.mark.skipif(True, reason="no wind")
@pytest.mark.parametrize("sail", "ab")
def test_sail(sail): ...

def test_row():
    pytest.skip("no oars")
"""


def test_the_last_lines_say_what_was_skipped_and_why(pytester: pytest.Pytester) -> None:
    pytester.makeconftest((ROOT / "tests" / "conftest.py").read_text(encoding="utf-8"))
    pytester.makepyfile(SKIPPED)
    *_, oars, wind, total = pytester.runpytest_inprocess().outlines
    assert oars == "NOT TESTED HERE (1 skipped): no oars"
    assert wind == "NOT TESTED HERE (2 skipped): no wind"
    assert "3 skipped" in total
