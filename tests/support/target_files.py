"""A small experiment from the rig to a tuned controller, for the tests of the target."""

from __future__ import annotations

from pathlib import Path

EXPERIMENT = """\
format: 1
name: box
rig:
  model: theisen2016
  operating_points: [{pressure_bar: 6.0, speed_rpm: 3000}]
  duration_s: 1.0
  prbs: {recordings: 1}
  stationary: {recordings: 1}
prefilter: {method: harmonics, harmonics: 5}
controller:
  feedback:
    structure: P
    operating_points: [{pressure_bar: 6.0, speed_rpm: 3000}]
"""


def write_box(folder: Path, further: str = "", **changed: str) -> Path:
    """Write the experiment, and return its path.

    Parameters
    ----------
    folder : Path
        Where.
    further : str
        Further sections.
    **changed : str
        New text by old text that is a single word of the file.
    """
    text = EXPERIMENT
    for old, new in changed.items():
        text = text.replace(old, new)
    path = folder / "box.yaml"
    path.write_text(text + further, encoding="utf-8")
    return path
