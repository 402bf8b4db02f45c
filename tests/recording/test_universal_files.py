"""Universal files (UFF) of modal analysis: time data and frequency responses, written by pyuff."""

import numpy as np
import pytest
from experiment_files import json_of

import gbid
from gbid import FrequencyData
from gbid.core.errors import DataError, UsageError

pyuff = pytest.importorskip("pyuff", reason="pyuff is not installed: pip install 'gbid[uff]'")

DT = 1 / 2048
RANDOM = np.random.default_rng(5)
X, Y = RANDOM.standard_normal((2, 300))
F = np.linspace(0, 50, 26)
G = RANDOM.standard_normal((2, 26)) + 1j * RANDOM.standard_normal((2, 26))


def function(kind, data, x, node=1, direction=1, entity="NONE", **more):
    even = {"abscissa_spacing": 1, "x": x, "data": data, "load_case_id": 0, "orddenom_spec_data_type": 0}
    point = {"rsp_ent_name": entity, "rsp_node": node, "rsp_dir": direction, "ref_node": 9, "ref_dir": 3}
    return {"type": 58, "func_type": kind, **even, **point, **more}


def written(path, *sets):
    pyuff.UFF(str(path)).write_sets(list(sets), mode="overwrite")
    return path


def timed(path, binary=False):
    t, um = DT * np.arange(300), {"ordinate_axis_units_lab": "um"}
    sets = (function(1, X, t, 1, 1, **um), function(1, Y, t, 1, -2, **um), function(1, X * Y, t, 4, 3, "force"))
    written(
        path, *sets, function(4, G[0], F, 1, 1), *([] if binary else [function(4, G[1], F**2, 2, abscissa_spacing=0)])
    )
    if binary:  # the header lines of the text, then the numbers as the format says: pyuff's writer leaves a file open
        texts = [text.splitlines(keepends=True) for text in path.read_text().split("    -1\n")[1::2]]
        kind = f"    58b{1:6}{2:6}{11:12}{2400:12}{0:6}{0:6}{0:12}{0:12}\n"
        values = [X, Y, X * Y, np.ascontiguousarray(G[0]).view(float)]
        heads = ["    -1\n" + kind + "".join(lines[1:12]) for lines in texts]
        blocks = [h.encode() + v.astype("<f8").tobytes() + b"    -1\n" for h, v in zip(heads, values, strict=True)]
        path.write_bytes(b"".join(blocks))
    return path


@pytest.mark.parametrize("binary", [False, True])
def test_functions_of_time_are_imported(tmp_path, capsys, binary):
    path = timed(tmp_path / "run.unv", binary)
    rows = {row["channel"]: row for row in json_of(capsys, "peek", str(path))["channels"]}
    assert list(rows) == ["1x", "1-y", "force", "1x / 9z", *([] if binary else ["2x / 9z"]), "time"]
    assert (rows["1-y"]["unit"], rows["1-y"]["samples"]) == ("um", 300)
    assert rows["1-y"]["sample_time_s"] == pytest.approx(DT, rel=1e-5)
    mapping = {"signals": {"p": {"columns": ["1x", "1-y"]}, "force": {"columns": ["force"], "unit": "N"}}}
    recording = gbid.import_recording(path, mapping)
    np.testing.assert_allclose(recording.signal("p"), 1e-6 * np.column_stack([X, Y]), rtol=1e-10, atol=1e-20)
    assert recording.sample_time == pytest.approx(DT, rel=1e-5)  # the format has six digits
    exact = gbid.import_recording(path, {**mapping, "sample_time_s": DT})
    assert exact.sample_time == DT
    with pytest.raises(DataError, match="no function of time; frequency responses are for a fit's responses"):
        gbid.import_recording(path, {"signals": {"force": {"columns": ["1x / 9z"], "unit": "N"}}})
    with pytest.raises(DataError, match=r"no function '2x'; choose from 1x, 1-y"):
        gbid.import_recording(path, {"signals": {"force": {"columns": ["2x"], "unit": "N"}}})


@pytest.mark.parametrize(
    ("start", "step", "words"),
    [(15 * DT, DT, ""), (0.0, 1.0005 * DT, "steps of their clocks differ"), (0.0, 2 * DT, "different sample times")],
)
def test_functions_with_their_own_clocks(tmp_path, start, step, words):
    t, um = DT * np.arange(300), {"ordinate_axis_units_lab": "um"}
    path = written(
        tmp_path / "a.uff", function(1, X, t, 1, 1, **um), function(1, Y, start + step / DT * t, 1, -2, **um)
    )
    mapping = {"signals": {"p": {"columns": ["1x", "1-y"]}}}
    if words:
        with pytest.raises(DataError, match=words):
            gbid.import_recording(path, mapping)
        return
    recording = gbid.import_recording(path, mapping)
    np.testing.assert_allclose(recording.signal("p"), 1e-6 * np.column_stack([X[15:], Y[:-15]]), rtol=1e-10)


def test_frequency_responses_have_the_weights_of_their_coherence(tmp_path):
    coherence = RANDOM.uniform(0.5, 0.99, (2, 26))
    sets = [function(k, v[i], F, 3, i + 1) for i in range(2) for k, v in ((4, G), (6, coherence))]
    path = written(tmp_path / "frf.uff", *sets, function(1, X, DT * np.arange(300)))
    data = FrequencyData.read(path, averages=30)
    assert data.output_names == ("3x", "3y")
    assert data.input_names == ("9z",)
    np.testing.assert_allclose(data.frequency_hz, F[1:])  # not at 0 Hz
    np.testing.assert_allclose(data.response[:, :, 0], G[:, 1:].T, rtol=1e-10)
    expected = np.abs(G) * np.sqrt((1 - coherence) / (60 * coherence))
    np.testing.assert_allclose(data.std[:, :, 0], expected[:, 1:].T, rtol=1e-9)
    np.testing.assert_array_equal(FrequencyData.read(path, std=0.1).std, 0.1)
    with pytest.raises(UsageError, match="coherence needs averages"):
        FrequencyData.read(path)


def test_data_at_nodes_over_frequency_are_responses(tmp_path):
    common = {"type": 55, "model_type": 1, "analysis_type": 5, "data_ch": 2, "spec_data_type": 8, "data_type": 5}
    zero, sets = np.zeros(2, complex), []
    for k, f in enumerate(F[1:4]):
        at = {"load_case": 1, "freq_step_n": k + 1, "freq": f, "node_nums": np.array([5, 6])}
        sets.append({**common, **at, "n_data_per_node": 3, "r1": G[:, k], "r2": zero, "r3": 2 * G[:, k]})
    data = FrequencyData.read(written(tmp_path / "nodes.unv", *sets), std=1.0)
    assert data.output_names == ("5x", "6x", "5z", "6z")
    assert data.input_names == ("load1",)
    expected = np.concatenate([G[:, :3], 2 * G[:, :3]]).T
    np.testing.assert_allclose(data.response[:, :, 0], expected, rtol=1e-4)


def test_what_is_missing_or_damaged_is_refused(tmp_path):
    path = timed(tmp_path / "run.unv")
    complete = path.read_bytes()
    signals = {"signals": {"force": {"columns": ["force"], "unit": "N"}}}
    last, lines = complete.rindex(b"    -1\n    58"), complete.splitlines(keepends=True)
    for damaged, words in (
        (complete[: last + 900], "truncated, or no universal file"),
        (b"".join(lines[:30] + lines[31:]), "function 1 has 296 of 300 points"),
        (b"hello\n" * 100, "truncated, or no universal file"),
        (b"", "truncated, or no universal file"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=words):
            gbid.import_recording(path, signals)
    twice = written(tmp_path / "twice.unv", *[function(4, G[i], F) for i in range(2)])
    with pytest.raises(DataError, match="has the response of 1x to 9z twice"):
        FrequencyData.read(twice, std=1.0)
    mapping = {"signals": {"a": {"columns": ["1x", "2x"], "unit": "N", "stored_unit": "N"}}}
    for name, late in (("whole", 100 * DT), ("part", 0.1)):
        delayed = [function(1, X, begin + DT * np.arange(300), node) for node, begin in ((1, 0.0), (2, late))]
        path = written(tmp_path / f"{name}.unv", *delayed)
    with pytest.raises(DataError, match="of a sample off the others"):
        gbid.import_recording(path, mapping)
    aligned = gbid.import_recording(tmp_path / "whole.unv", mapping)
    np.testing.assert_allclose(aligned.signal("a"), np.column_stack([X[100:], X[:200]]), rtol=1e-10)
    with pytest.raises(DataError, match="holds no frequency responses"):
        FrequencyData.read(path, std=1.0)
    with pytest.raises(UsageError, match=r"has no coherence.* give std"):
        FrequencyData.read(written(tmp_path / "bare.unv", function(4, G[0], F)))
