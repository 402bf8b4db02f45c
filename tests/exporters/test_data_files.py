"""Recordings and frequency responses written for other programs, read by the libraries of the formats."""

import numpy as np
import pytest
from experiment_files import json_of, printed_by

import gbid
from gbid.core.errors import UsageError

RANDOM = np.random.default_rng(3)
RUN = gbid.Recording(
    {"u": RANDOM.standard_normal((200, 2)), "force": RANDOM.standard_normal(200)},
    1 / 2048,
    units={"u": "m", "force": "N"},
    conditions={"speed_rpm": 3000.0},
    name="run 1",
)
READ_BACK = {"signals": {"u": {"columns": ["u_x", "u_y"]}, "force": {"columns": "force"}}}


def test_parquet(tmp_path, capsys):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed: pip install 'gbid[arrow]'")
    gbid.save_recording(RUN, tmp_path / "run.h5")
    (path,) = json_of(capsys, "export", tmp_path / "run.h5", "--to", "parquet", "-o", tmp_path)["files"]
    table = parquet.read_table(path)
    assert table.column_names == ["time", "u_x", "u_y", "force"]
    assert table.schema.field("u_y").metadata == {b"unit": b"m"}
    np.testing.assert_array_equal(table["u_y"].to_numpy(), RUN.signal("u")[:, 1])
    back = gbid.import_recording(path, {"time": "time", "sample_time_s": RUN.sample_time, **READ_BACK})
    assert back.sample_time == RUN.sample_time
    np.testing.assert_array_equal(back.signal("u"), RUN.signal("u"))


def test_mdf(tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'gbid[mdf]'")
    path = gbid.save_data(RUN, tmp_path / "run.mf4")
    with asammdf.MDF(path) as file:
        channel = file.get("u_y")
        np.testing.assert_array_equal(channel.samples, RUN.signal("u")[:, 1])
        np.testing.assert_array_equal(channel.timestamps, RUN.time)
        assert channel.unit == "m"
    np.testing.assert_array_equal(gbid.import_recording(path, READ_BACK).signal("force"), RUN.signal("force"))


def test_universal(tmp_path, capsys):
    pyuff = pytest.importorskip("pyuff", reason="pyuff is not installed: pip install 'gbid[uff]'")
    sets = pyuff.UFF(str(gbid.save_data(RUN, tmp_path / "run.unv"))).read_sets()
    assert [(s["rsp_ent_name"], s["rsp_dir"], s["func_type"]) for s in sets] == [
        ("u_x", 1, 1), ("u_y", 2, 1), ("force", 0, 1)
    ]  # fmt: skip
    np.testing.assert_allclose(sets[1]["data"], RUN.signal("u")[:, 1], rtol=1e-11)
    np.testing.assert_allclose(sets[1]["x"], RUN.time, rtol=1e-5)
    back = gbid.import_recording(tmp_path / "run.unv", READ_BACK)
    np.testing.assert_allclose(back.signal("u"), RUN.signal("u"), rtol=1e-11)
    f = np.array([1.0, 3.0, 4.0, 7.0])
    response = RANDOM.standard_normal((4, 2, 1)) + 1j * RANDOM.standard_normal((4, 2, 1))
    response[2, 1, 0] = np.nan  # not measured
    data = gbid.FrequencyData(f, response, RANDOM.uniform(1, 2, (4, 2, 1)), inputs="force", outputs=["p_x", "p_y"])
    read = gbid.FrequencyData.read(gbid.save_data(data, tmp_path / "frf.uff"))
    assert (read.input_names, read.output_names) == (("force",), ("p_x", "p_y"))
    np.testing.assert_allclose(read.response, data.response, rtol=1e-11)
    measured = np.isfinite(response)
    np.testing.assert_allclose(read.std[measured], data.std[measured], rtol=1e-11)
    assert len(pyuff.UFF(str(tmp_path / "frf.uff")).read_sets(2)["x"]) == 3
    gbid.save_recording(RUN, tmp_path / "run.h5")
    words = printed_by(capsys, "export", tmp_path / "run.h5", "--to", "matlab", code=2).err
    assert "here are only recordings" in words


def test_what_a_format_cannot_hold_is_refused(tmp_path):
    pytest.importorskip("pyuff", reason="pyuff is not installed: pip install 'gbid[uff]'")
    for recording, words in (
        (gbid.Recording({"y": [1.0, np.nan, 2.0]}, 1.0), "missing samples.*write .parquet"),
        (gbid.Recording({"displacement": [1.0, 2.0]}, 1.0), "at most 10 ASCII characters, not 'displacement'"),
    ):
        with pytest.raises(UsageError, match=words):
            gbid.save_data(recording, tmp_path / "a.unv")
    with pytest.raises(UsageError, match=r"unknown ending '.xls'; for this there is .uff, .unv, .uf, .parquet, .mf4"):
        gbid.save_data(RUN, tmp_path / "a.xls")
    assert not list(tmp_path.iterdir())
