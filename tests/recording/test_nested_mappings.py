"""Values from YAML and Python that repeat or contain themselves are refused at once."""

import math

import numpy as np
import pandas as pd
import pytest

import gbid
from gbid.core.errors import GbidError, UsageError
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
    for key in ("scale", "offset"):
        with pytest.raises(UsageError, match=f"{key}: 0 for 1 columns"):
            ImportMapping(signals={"y": {"columns": ["a"], "unit": "m", key: np.zeros(0)}})
    with pytest.raises(UsageError, match="signals = nan; give a dict by name"):
        gbid.Recording.from_frame(pd.DataFrame({"a": [1.0, 2.0]}), math.nan, sample_time=1e-3)


DEEP: list = []
for _ in range(3000):
    DEEP = [DEEP]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda f: gbid.Recording.from_frame(f, {"u": 3}, sample_time=1e-3), r"signals\['u'\] = 3; give a text"),
        (lambda f: gbid.Recording.from_frame(f, {"u": ()}, sample_time=1e-3), "no column ''; it has a"),
        (lambda f: gbid.Recording.from_frame(f, sample_time=1e-3, conditions=np.zeros(0)), "conditions"),
        (lambda f: gbid.Recording.from_frame(f, range(10**9), sample_time=1e-3), "give a dict by name"),
        (lambda f: gbid.Recording({"y": f["a"]}, stamps="12"), "stamps is not an array of real numbers"),
        (lambda f: gbid.Recording({"y": f["a"]}, DEEP), "sample_time = a value of type list s"),
        (lambda f: gbid.Recording({"y": f["a"]}, 1e-3, {"load": range(10**9)}), "condition load"),
    ],
)
def test_odd_values_of_recordings_are_named(make, words):
    with pytest.raises(GbidError, match=words):
        make(pd.DataFrame({"a": [1.0, 2.0]}))


@pytest.mark.parametrize("of", ["dataset", "signal", "time"])
def test_odd_attributes_of_datasets_are_named(of):
    pytest.importorskip("xarray", reason="xarray is not installed: pip install 'gbid[xarray]'")
    dataset = gbid.Recording({"y": np.arange(9.0)}, 1e-3).to_xarray()
    at, key = {"dataset": (dataset, "name"), "signal": (dataset["y"], "units"), "time": (dataset["time"], "units")}[of]
    at.attrs[key] = DEEP
    with pytest.raises(UsageError, match="give a text"):
        gbid.Recording.from_xarray(dataset)


def test_commas_in_comments_are_no_values(tmp_path):
    (tmp_path / "a.yaml").write_text(("# " + "1, " * 100 + "\n") * 600 + "a: '\n# b'\n")
    assert read_yaml(tmp_path / "a.yaml").data == {"a": " # b"}
    (tmp_path / "a.yaml").write_text("a: ['\n# '" + ",1" * 60_000 + "]\n")
    with pytest.raises(UsageError, match="60003 values, more than"):
        read_yaml(tmp_path / "a.yaml")
