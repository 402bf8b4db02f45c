"""Folders that the tests read from: the checkout, and the measured recordings that may lie beside it."""

from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
ROOT = SUPPORT.parents[1]
EXPERIMENTS = ROOT / "experiments"
DOCS = ROOT / "docs"
MEASURED = ROOT.parent / "shared" / "data"
"""Real recordings by others, which are no part of the project; tests that need one skip where it is absent."""
