"""Channels as rows (`axis`), and `samples` of a large file: no more than these are read."""

import h5py
import numpy as np
import pytest
import scipy.io

from gbid.core.errors import DataError, UsageError
from gbid.recording import import_recording
from gbid.recording.formats import open_hdf5
from gbid.recording.mapping import FilePart
from gbid.recording.text_files import read_rows

P = np.random.default_rng(0).standard_normal((3, 500))
SIGNALS = {"s": {"columns": ["p[1]"], "unit": "V"}}


@pytest.fixture(params=["h5", "mat", "npz", "parquet"])
def channels_as_rows(request, tmp_path):
    path = tmp_path / f"a.{request.param}"
    if request.param == "h5":
        with h5py.File(path, "w") as file:
            file["p"] = P
            file["t"] = np.arange(500) * 1e-3
            file["short"] = np.zeros(400)
    elif request.param == "mat":
        scipy.io.savemat(path, {"p": P})
    elif request.param == "parquet":
        pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gbid[arrow]'")
        from pyarrow import parquet

        parquet.write_table(pa.table({"p": P.tolist(), "name": ["a", "b", "c"]}), path)  # a row for each channel
    else:
        np.savez(path, p=P)
    return path


def test_channels_are_rows_where_it_is_said(channels_as_rows):
    mapping = {"sample_time_s": 1e-3, "signals": SIGNALS}
    made = import_recording(channels_as_rows, {**mapping, "axis": 1})
    np.testing.assert_array_equal(made.signal("s")[:, 0], P[1])
    some = import_recording(channels_as_rows, {**mapping, "axis": 1, "samples": [100, 102]})
    np.testing.assert_array_equal(some.signal("s")[:, 0], P[1, 100:102])
    assert some.provenance["source_samples"] == "100 to 102"
    for more in ({}, {"axis": 0, "samples": [100, 102]}):
        with pytest.raises(DataError, match=r"3 samples of 500 channels along axis 0; .* give axis: 1|its 3 samples"):
            import_recording(channels_as_rows, {**mapping, **more})
    with pytest.raises(DataError, match="samples 10 to 600 are not within its 500 samples"):
        import_recording(channels_as_rows, {**mapping, "axis": 1, "samples": [10, 600]})


def test_samples_of_matrices_of_matlab_and_numpy_are_read_alone(tmp_path):
    """A matrix in a struct of a v7.3 file; one in an archive, with time along its columns."""
    path = write_part("mat", tmp_path / "a.mat")
    signals = {"s": {"columns": ["run.pos[0]", "run.pos[2]"], "unit": "V"}}
    made = import_recording(path, {"sample_time_s": 1e-3, "signals": signals, "samples": [130, 270]})
    np.testing.assert_array_equal(made.signal("s"), P[::2, 130:270].T)
    np.savez(tmp_path / "a.npz", p=np.asfortranarray(P))
    signals = {"s": {"columns": ["p[0]", "p[2]"], "unit": "V"}}
    mapping = {"sample_time_s": 1e-3, "signals": signals, "samples": [130, 270], "axis": 1}
    np.testing.assert_array_equal(import_recording(tmp_path / "a.npz", mapping).signal("s"), P[::2, 130:270].T)
    np.savez_compressed(tmp_path / "a.npz", p=P)
    np.testing.assert_array_equal(import_recording(tmp_path / "a.npz", mapping).signal("s"), P[::2, 130:270].T)


def test_samples_of_a_universal_file_have_the_times_of_their_function(tmp_path):
    path = write_part("unv", tmp_path / "a.unv")
    for column, values in (("late", P[2]), ("short", P[1])):
        mapping = {"sample_time_s": 1e-3, "signals": {"s": {"columns": column, "unit": "V"}}}
        for first, stop in ((131, 270), (0, 2), (397, 400)):
            made = import_recording(path, {**mapping, "samples": [first, stop]})
            np.testing.assert_allclose(made.signal("s")[:, 0], values[first:stop], rtol=1e-11)
        whole = import_recording(path, mapping)
        np.testing.assert_allclose(whole.signal("s")[:, 0], values[: whole.n_samples], rtol=1e-11)


def test_an_axis_the_other_way_and_one_of_text_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", p=P.T)
    (tmp_path / "a.csv").write_text("a;b\n1;2\n2;3\n")
    mapping = {"sample_time_s": 1e-3, "signals": SIGNALS, "axis": 1}
    with pytest.raises(DataError, match=r"3 samples of 500 channels along axis 1; .* give axis: 0"):
        import_recording(tmp_path / "a.npz", mapping)
    with pytest.raises(UsageError, match="axis is for files of arrays"):
        import_recording(tmp_path / "a.csv", mapping)


def test_samples_of_an_hdf5_file_are_read_alone(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["p"], file["t"], file["short"] = P, np.arange(500) * 1e-3, np.zeros(400)
    with open_hdf5(path, None) as file:
        stored = file.get("p", FilePart(1, (100, 120)))
        assert (stored.values.shape, stored.first) == ((3, 20), 100)
    mapping = {"time": "t", "axis": 1, "signals": SIGNALS, "samples": [100, 120]}
    made = import_recording(path, mapping)
    assert made.provenance["source_rows"].startswith("rows 100 to 120, read alone; the first: t = 0.1, ")
    with pytest.raises(DataError, match="columns have different numbers of samples: t 500, short 400"):
        import_recording(path, {**mapping, "signals": {"s": {"columns": ["short"], "unit": "V"}}})


def test_samples_of_a_large_text_file_are_read_alone(tmp_path):
    path = tmp_path / "a.csv"
    rows, filling = 10_000, "x" * 250
    body = "".join(f"{k / 1000};{k}.25;{filling}\n" + "\n# note\n" * (k % 1000 == 7) for k in range(rows))
    path.write_text(f"a;b;c\nRecorded by hand\n{body}End of file\n")
    mapping = {"time": "a", "signals": {"s": {"columns": ["b"], "unit": "V"}}}
    made = import_recording(path, {**mapping, "samples": [7000, 7100]})
    np.testing.assert_array_equal(made.signal("s")[:, 0], np.arange(7000, 7100) + 0.25)
    assert made.provenance["source_samples"] == "7000 to 7100"
    assert made.provenance["source_rows"].startswith("rows 7000 to 7100, read alone")
    assert made.sample_time == 1e-3
    assert len(read_rows(path, None, 7000, 7100).rows) == 100
    with pytest.raises(DataError, match=rf"samples 5 to {rows + 1} are not within its {rows} samples"):
        import_recording(path, {**mapping, "samples": [5, rows + 1]})


def write_part(kind, path):
    """Write channels p (500 samples) and short (400), in pieces of 100 where the format has pieces."""
    if kind == "parquet":
        pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gbid[arrow]'")
        from pyarrow import parquet

        parquet.write_table(
            pa.table({"p": P[0], "list": list(P.T)}), path, row_group_size=100, write_page_checksum=True
        )
    elif kind == "tdms":
        nptdms = pytest.importorskip("nptdms", reason="nptdms is not installed: pip install 'gbid[tdms]'")
        with nptdms.TdmsWriter(str(path)) as writer:
            for k in range(5):
                here = slice(100 * k, 100 * (k + 1))
                channels = [nptdms.ChannelObject("g", "p", P[0, here])]
                writer.write_segment(channels + [nptdms.ChannelObject("g", "short", P[1, here])] * (k < 4))
    elif kind == "feather":
        pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gbid[arrow]'")
        from pyarrow import feather

        feather.write_feather(pa.table({"p": P[0], "q": P[1]}), path, chunksize=100)
    elif kind == "npz":
        np.savez(path, p=P[0], short=P[1, :400])
    elif kind == "mat":  # v7.3: HDF5 with a block of its own before, and shapes the other way round
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, values in (("p", P[0]), ("short", P[1, :400]), ("run/pos", P)):
                file[name] = np.atleast_2d(values)
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
            file["run"].attrs["MATLAB_class"] = np.bytes_("struct")
        with path.open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    elif kind in ("uff", "unv"):  # in binary; in text, of which the third function has times of its own
        pyuff = pytest.importorskip("pyuff", reason="pyuff is not installed: pip install 'gbid[uff]'")
        common = {"type": 58, "func_type": 1, "load_case_id": 0, "rsp_dir": 3, "ref_node": 0, "ref_dir": 0}
        common |= {"orddenom_spec_data_type": 0, "abscissa_spec_data_type": 17}
        values = {"p": P[0], "short": P[1, :400], "late": P[2]}
        sets = [
            common
            | {"rsp_ent_name": name, "rsp_node": k, "abscissa_spacing": k < 3, "x": 1e-3 * np.arange(len(y)), "data": y}
            for k, (name, y) in enumerate(values.items(), 1)
        ]
        pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")
        if kind == "uff":
            texts = [text.splitlines(keepends=True) for text in path.read_text().split("    -1\n")[1:4:2]]
            blocks = [
                f"    -1\n    58b{1:6}{2:6}{11:12}{8 * len(y):12}{0:6}{0:6}{0:12}{0:12}\n".encode()
                + "".join(lines[1:12]).encode()
                + y.astype("<f8").tobytes()
                + b"    -1\n"
                for lines, y in zip(texts, values.values(), strict=False)
            ]
            path.write_bytes(b"".join(blocks))
    else:
        asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'gbid[mdf]'")
        with asammdf.MDF(version="4.10") as file:
            for name, values in (("p", P[0]), ("short", P[1, :400])):
                file.append([asammdf.Signal(values, 1e-3 * np.arange(len(values)), name=name)])
            file.save(path, overwrite=True)
    return path


@pytest.mark.parametrize("kind", ["parquet", "tdms", "mf4", "feather", "npz", "mat", "uff", "unv"])
def test_samples_of_a_file_of_a_logger_are_read_alone(tmp_path, kind):
    path = write_part(kind, tmp_path / f"a.{kind}")
    mapping = {"sample_time_s": 1e-3, "signals": {"s": {"columns": "p", "unit": "V"}}}
    for first, stop in ((130, 270), (100, 200), (0, 2), (498, 500)):
        made = import_recording(path, {**mapping, "samples": [first, stop]})
        np.testing.assert_allclose(made.signal("s")[:, 0], P[0, first:stop], rtol=1e-11 if kind == "unv" else 0)
        assert made.provenance["source_rows"].startswith(f"rows {first} to {stop}, read alone")
    for samples in ([10, 501], [600, 700]):
        with pytest.raises(DataError, match=rf"samples {samples[0]} to {samples[1]} are not within its 500 samples"):
            import_recording(path, {**mapping, "samples": samples})
    if kind == "parquet":
        complete = path.read_bytes()
        place = complete.index(P[0, 450:452].tobytes())
        path.write_bytes(complete[:place] + bytes(16) + complete[place + 16 :])  # damage in the last row group
        import_recording(path, {**mapping, "samples": [0, 400]})
        with pytest.raises(DataError, match="not a readable Parquet"):
            import_recording(path, mapping)
    elif kind != "feather":
        several = {"s": {"columns": ["p", "short"], "unit": "V"}}
        wanted = {**mapping, "signals": several, "samples": [0, 10]}
        if kind in ("mf4", "uff", "unv"):  # they state clocks, by which columns are aligned
            assert import_recording(path, wanted).n_samples == 10
            return
        with pytest.raises(DataError, match="different numbers of samples: p 500, short 400"):
            import_recording(path, wanted)
