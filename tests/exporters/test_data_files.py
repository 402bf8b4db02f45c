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
    path = gbid.export.save_data(RUN, tmp_path / "run.mf4")
    with asammdf.MDF(path) as file:
        channel = file.get("u_y")
        np.testing.assert_array_equal(channel.samples, RUN.signal("u")[:, 1])
        np.testing.assert_array_equal(channel.timestamps, RUN.time)
        assert channel.unit == "m"
    np.testing.assert_array_equal(gbid.import_recording(path, READ_BACK).signal("force"), RUN.signal("force"))


def test_several_recordings_are_groups_of_an_mdf_file(tmp_path):
    pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'gbid[mdf]'")
    other = gbid.Recording({"u": RANDOM.standard_normal((50, 2))}, 1 / 1000, units={"u": "V"}, name="run 2")
    path = gbid.export.save_data([RUN, other], tmp_path / "runs.mf4")
    first = {"u": {"columns": ["run 1/u_x", "run 1/u_y"]}}
    np.testing.assert_array_equal(gbid.import_recording(path, {"signals": first}).signal("u"), RUN.signal("u"))
    second = {"u": {"columns": ["run 2/u_x", "run 2/u_y"], "stored_unit": "V"}}
    back = gbid.import_recording(path, {"signals": second})
    np.testing.assert_array_equal(back.signal("u"), other.signal("u"))
    assert back.sample_time == pytest.approx(1e-3)
    with pytest.raises(UsageError, match="two recordings have the name 'run 1'"):
        gbid.export.save_data([RUN, RUN], tmp_path / "twice.mf4")
    with pytest.raises(UsageError, match=r"unknown ending '.parquet'; choose from .mf4"):
        gbid.export.save_data([RUN, other], tmp_path / "runs.parquet")


@pytest.mark.parametrize(("to", "ending"), [("parquet", ".parquet"), ("mdf", ".mf4"), ("universal", ".unv")])
def test_a_folder_of_recordings_becomes_a_file_for_each(tmp_path, capsys, to, ending):
    pytest.importorskip(
        {"parquet": "pyarrow", "mdf": "asammdf", "universal": "pyuff"}[to], reason="extra not installed"
    )
    for name in ("5 bar, run 1", "p6"):
        gbid.save_recording(RUN, tmp_path / f"{name}.h5")
    (tmp_path / "damaged.h5").write_bytes(b"no HDF5")
    made = json_of(capsys, "export", tmp_path, "--to", to, "-o", tmp_path / "out")
    assert [path.rpartition("/")[2] for path in made["files"]] == [f"5 bar, run 1{ending}", f"p6{ending}"]
    assert "damaged.h5" in made["left_out"][0]
    content = (tmp_path / "out" / f"p6{ending}").read_bytes()
    gbid.save_recording(RUN[10:], tmp_path / "p6.h5", overwrite=True)
    assert "exists" in printed_by(capsys, "export", tmp_path, "--to", to, "-o", tmp_path / "out", code=2).err
    assert (tmp_path / "out" / f"p6{ending}").read_bytes() == content
    assert "no recordings and no fits" in printed_by(capsys, "export", tmp_path / "out", "--to", to, code=3).err


def test_universal(tmp_path, capsys):
    pyuff = pytest.importorskip("pyuff", reason="pyuff is not installed: pip install 'gbid[uff]'")
    sets = pyuff.UFF(str(gbid.export.save_data(RUN, tmp_path / "run.unv"))).read_sets()
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
    read = gbid.FrequencyData.read(gbid.export.save_data(data, tmp_path / "frf.uff"))
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
            gbid.export.save_data(recording, tmp_path / "a.unv")
    with pytest.raises(UsageError, match=r"unknown ending '.xls'; choose from .uff, .unv, .uf, .parquet, .mf4"):
        gbid.export.save_data(RUN, tmp_path / "a.xls")
    assert not list(tmp_path.iterdir())
