"""Values from YAML and Python that repeat or contain themselves are refused at once."""

import math

import numpy as np
import pandas as pd
import pytest

import gbid
from gbid.core.errors import UsageError
from gbid.core.yaml_file import read_yaml
from gbid.recording import ImportMapping

RING: list = []
RING.append(RING)
CIRCLE: dict = {}
CIRCLE["signals"] = CIRCLE


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [" + "1, " * 12_000 + "1]\nb: [" + "*a, " * 13 + "]\n",
        "a: [" + "1," * 60_000 + "1]\n",
        "a: &a {"
        + ", ".join(f"x{i}: 1" for i in range(2000))
        + "}\n"
        + "".join(f"b{i}: {{<<: *a}}\n" for i in range(2000)),
        "a:\n  b0: &b0 [x, x]\n" + "".join(f"  b{i}: &b{i} [{f'*b{i - 1}, ' * 9}]\n" for i in range(1, 12)),
    ],
)
def test_many_values_of_a_small_yaml_file(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"a\.yaml: .*(values|aliases)"):
        read_yaml(path)


@pytest.mark.parametrize(
    "change", [CIRCLE, {"conditions": CIRCLE}, {"samples": RING}, {"signals": {"y": {"columns": ["a"], "scale": RING}}}]
)
def test_a_mapping_that_contains_itself(tmp_path, change):
    path = tmp_path / "a.csv"
    path.write_text("t,a\n0.000,1\n0.001,2\n0.002,1\n")
    mapping = {"time": "t", "signals": {"y": {"columns": ["a"], "unit": "m"}}, **change}
    for door in (lambda: gbid.import_recording(path, mapping), lambda: ImportMapping(**mapping)):
        with pytest.raises(UsageError, match="in themselves"):
            door()


def test_a_value_of_another_type_is_named():
    mapping = {"time": "t", "signals": {"y": {"columns": ["a"], "hold": np.zeros((2, 2))}}}
    with pytest.raises(UsageError, match="hold"):
        ImportMapping.from_dict(mapping)
    with pytest.raises(UsageError, match="signals: expected columns by signal"):
        gbid.Recording.from_frame(pd.DataFrame({"a": [1.0, 2.0]}), math.nan, sample_time=1e-3)
