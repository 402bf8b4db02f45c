"""HDF5 files that take data from other files: no byte from outside their folder, and all bytes from inside it."""

from random import Random

import h5py
import numpy as np
import pytest

import gbid
from gbid.core.errors import DataError
from gbid.experiment.load import load_experiment
from gbid.experiment.recordings import recording_result
from gbid.recording import hdf5_links
from gbid.recording.importing import list_channels

N = 40
INSIDE, SECRET = np.arange(1.0, N + 1), -np.arange(1.0, N + 1)
MAPPING = {"sample_time": 1e-3, "signals": {"y": {"columns": ["y"], "unit": "m"}}}


def read(path):
    """Return the samples of the column y."""
    return gbid.import_recording(path, MAPPING).signals["y"][:, 0]


class Made:
    """Folder of data beside a private one, and what generates links between their files.

    Whether a way leads outside is known from its parts, not from a look at the files.
    """

    def __init__(self, root, random):
        self.data, self.private, self.random, self.count = root / "data", root / "private", random, 0
        self.sub = self.data / "sub"
        self.sub.mkdir(parents=True)
        self.private.mkdir()
        (self.data / "to_private").symlink_to(self.private)
        (self.data / "to_sub").symlink_to(self.sub)

    def name(self, to, outside):
        """Return a way from the folder of the data to a file there, or in the private folder."""
        relative = [f"../private/{to}", f"sub/../../private/{to}", f"to_private/{to}", f"./../private/./{to}"]
        if outside:
            return self.random.choice([*relative, str(self.private / to), str(self.data / "to_private" / to)])
        return self.random.choice([to, f"./{to}", f"sub/../{to}", f"../data/{to}", str(self.data / to)])

    def place(self, outside):
        self.count += 1
        return (self.private if outside else self.data) / f"f{self.count}"

    def plain(self, outside):
        """Return a file with y, and whether its bytes are outside."""
        path = self.place(outside).with_suffix(".h5")
        with h5py.File(path, "w") as file:
            file["y"] = SECRET if outside else INSIDE
        return path, outside

    def raw(self, outside):
        path = self.place(outside).with_suffix(".bin")
        path.write_bytes((SECRET if outside else INSIDE).tobytes())
        return path

    def link(self, depth):
        """Return a file of the data folder whose y is found by a number of links, and whether they lead outside."""
        kind = self.random.choice(("external", "virtual", "soft") if depth > 1 else ("external", "virtual", "storage"))
        if kind == "storage":
            outside = self.random.random() < 0.5
            raw, path = self.raw(outside), self.place(False).with_suffix(".h5")
            with h5py.File(path, "w") as file:
                size = self.random.choice((8 * N, h5py.h5f.UNLIMITED))
                file.create_dataset("y", (N,), "f8", external=[(self.name(raw.name, outside), 0, size)])
            return path, outside
        other, outside = self.link(depth - 1) if depth > 1 else self.plain(self.random.random() < 0.5)
        name = self.name(other.name, depth == 1 and outside)
        path = self.place(False).with_suffix(".h5")
        with h5py.File(path, "w") as file:
            if kind == "virtual":
                layout = h5py.VirtualLayout((N,), "f8")
                layout[:] = h5py.VirtualSource(name, "y", (N,))
                file.create_virtual_dataset("y", layout)
            elif kind == "external":
                file["y"] = h5py.ExternalLink(name, "/y")
            else:
                file["group"] = h5py.ExternalLink(name, "/")
                file["y"] = h5py.SoftLink(self.random.choice(("group/y", "/group/y", "./group/./y")))
        return path, outside


@pytest.mark.parametrize("seed", range(10))
def test_no_byte_comes_from_outside_the_folder(tmp_path, monkeypatch, seed):
    """In 200 files with one to three links in a row; inside it, only storage beside a linked file is refused."""
    random = Random(seed)
    made = Made(tmp_path, random)
    monkeypatch.chdir(made.private)  # where HDF5 looks for files, too
    for _ in range(20):
        path, outside = made.link(random.choice((1, 1, 2, 3)))
        listed, values = result_of(list_channels, path), result_of(read, path)
        assert isinstance(listed, str) or not {value for each in listed for value in each.first} & set(SECRET)
        if isinstance(values, str):
            assert str(path) in values
            assert outside or "looks for in the current folder" in values
        else:
            assert not outside
            np.testing.assert_array_equal(values, INSIDE)


def test_a_symbolic_link_before_a_link_is_refused_where_hdf5_follows_it(tmp_path):
    made = Made(tmp_path, Random(0))
    with h5py.File(made.sub / "b.h5", "w") as file:
        file["y"] = h5py.ExternalLink("c.h5", "/y")
    with h5py.File(made.sub / "c.h5", "w") as file:
        file["y"] = INSIDE
    (made.data / "b.h5").symlink_to(made.sub / "b.h5")
    for name, refused in (("sub/b.h5", False), ("b.h5", True)):
        with h5py.File(made.data / "a.h5", "w") as file:
            layout = h5py.VirtualLayout((N,), "f8")
            layout[:] = h5py.VirtualSource(name, "y", (N,))
            file.create_virtual_dataset("y", layout)
        values = result_of(read, made.data / "a.h5")
        assert ("follows by itself" in values) if refused else np.array_equal(values, INSIDE)


def test_many_datasets_are_not_listed_but_one_is_read(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file["y"] = INSIDE
        for i in range(4100):
            file[f"d{i}"] = i
    with pytest.raises(DataError, match="4101 entries or more"):
        list_channels(path)
    np.testing.assert_array_equal(read(path), INSIDE)


def result_of(function, path):
    """Return the result, or the text of the refusal."""
    try:
        return function(path)
    except DataError as error:
        return str(error)


def test_a_private_file_is_no_data(tmp_path):
    """By external storage, as a user of a foreign file would hand on a key."""
    (tmp_path / "private.txt").write_bytes(b"k" * 8 * N)
    (tmp_path / "data").mkdir()
    path = tmp_path / "data" / "a.h5"
    with h5py.File(path, "w") as file:
        file["t"] = INSIDE
        file.create_dataset("y", (N,), "f8", external=[("../private.txt", 0, 8 * N)])
    with pytest.raises(DataError, match=r"takes its data from the file '../private\.txt', outside the folder"):
        read(path)
    t, y = list_channels(path)
    assert t.n_samples == N
    assert "outside the folder" in y.remark


@pytest.mark.parametrize("kind", ["short", "missing", "gap", "circle", "folder"])
def test_where_hdf5_fills_in_zeros_a_file_is_refused(tmp_path, kind):
    path = tmp_path / "a.h5"
    (tmp_path / "short.bin").write_bytes(INSIDE[:-1].tobytes())
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["y"] = INSIDE
    with h5py.File(path, "w") as file:
        if kind == "short":
            file.create_dataset("y", (N,), "f8", external=[("short.bin", 0, 8 * N)])
        elif kind == "folder":
            file.create_dataset("y", (N,), "f8", external=[(".", 0, 8 * N)])
        elif kind == "circle":
            file["y"], file["z"] = h5py.SoftLink("/z"), h5py.SoftLink("/y")
        else:
            layout = h5py.VirtualLayout((N,), "f8")
            layout[: N - 10 * (kind == "gap")] = h5py.VirtualSource(
                "none.h5" if kind == "missing" else "b.h5", "y", (N,)
            )[: N - 10 * (kind == "gap")]
            file.create_virtual_dataset("y", layout)
    words = {"short": "ends before its last sample", "missing": "not there", "gap": "not all of its samples"}
    with pytest.raises(DataError, match=words.get(kind, "no file" if kind == "folder" else "circle|one after another")):
        read(path)


def test_bytes_of_a_linked_file_count(tmp_path):
    """They are in the provenance, and those of every file that it takes data from make a digest."""
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["y"] = INSIDE
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["y"] = h5py.ExternalLink("b.h5", "y")
    (tmp_path / "e.yaml").write_text(EXPERIMENT)
    key = content_key_of(tmp_path / "e.yaml")
    rec = gbid.import_recording(tmp_path / "a.h5", MAPPING)
    assert rec.provenance["source_linked"].startswith("b.h5 ")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["y"] = 2 * INSIDE
    changed = gbid.import_recording(tmp_path / "a.h5", MAPPING)
    assert changed.provenance["source_linked"] != rec.provenance["source_linked"]
    assert changed.provenance["source_sha256"] == rec.provenance["source_sha256"]
    assert content_key_of(tmp_path / "e.yaml") != key
    origin = load_experiment(tmp_path / "e.yaml").origin(["a"])
    assert set(origin["data"]) == {"a.h5", "b.h5"}


def test_a_reader_that_does_not_tell_the_links_is_named(tmp_path, monkeypatch):
    """A recording without the digests of its linked files would stay when these change."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["y"] = INSIDE

    def late(_read, path):
        raise DataError(f"{path}: time-out")

    monkeypatch.setattr(hdf5_links, "read_apart", late)
    with pytest.raises(DataError, match="time-out"):
        gbid.import_recording(tmp_path / "a.h5", MAPPING)
    (tmp_path / "e.yaml").write_text(EXPERIMENT)
    assert content_key_of(tmp_path / "e.yaml")


EXPERIMENT = """\
format: 1
name: linked
import:
  recordings:
    - {name: a, file: a.h5, sample_time_s: 1.0e-3, signals: {y: {columns: [y], unit: m}}}
"""


def content_key_of(path):
    experiment = load_experiment(path)
    return recording_result(experiment, experiment.recordings["a"]).key


def test_a_scale_that_is_not_applied_needs_a_calibration(tmp_path):
    path, mapping = tmp_path / "a.h5", {"columns": ["y"], "unit": "V"}
    with h5py.File(path, "w") as file:
        file["y"] = np.arange(N, dtype="i2")
        file["y"].attrs["scale_factor"] = 0.01
    with pytest.raises(DataError, match=r"has raw numbers: the file states scale_factor = 0\.01"):
        gbid.import_recording(path, MAPPING | {"signals": {"y": mapping}})
    rec = gbid.import_recording(path, MAPPING | {"signals": {"y": mapping | {"scale": 0.01}}})
    np.testing.assert_allclose(rec.signals["y"][:, 0], 0.01 * np.arange(N))


def test_nested_groups_are_listed(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
        group["y"] = INSIDE
    (channel,) = list_channels(tmp_path / "a.h5")
    assert channel.name == "g/" * 3000 + "y"


@pytest.mark.parametrize("link", ["external", "storage", "virtual"])
@pytest.mark.parametrize("of", ["gbid", "MATLAB"])
def test_files_of_gbid_and_of_matlab_take_data_from_no_other_file(tmp_path, of, link):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["y"] = INSIDE
    path = tmp_path / ("a.h5" if of == "gbid" else "a.mat")
    if of == "gbid":
        gbid.save_recording(gbid.Recording({"y": INSIDE}, 1e-3), path)
    else:
        from matio import save_to_mat

        save_to_mat(str(path), {"y": INSIDE[:, None]}, version="v7.3")
    import_it(path)
    content = path.read_bytes()
    with h5py.File(path, "r+") as file:
        place = "signals/y" if of == "gbid" else "y"
        kept = dict(file[place].attrs)
        shape = file[place].shape
        del file[place]
        if link == "external":
            file[place] = h5py.ExternalLink("b.h5", "y")
        elif link == "storage":
            file.create_dataset(place, shape, "f8", external=[("b.h5", 0, 8 * N)])
        else:
            layout = h5py.VirtualLayout(shape, "f8")
            layout[...] = h5py.VirtualSource("b.h5", "y", (N,))
            file.create_virtual_dataset(place, layout)
        if link != "external":
            file[place].attrs.update(kept)
    if of == "gbid":
        from gbid.core.files import with_checksum

        path.write_bytes(with_checksum(path.read_bytes()))
    assert path.read_bytes() != content
    with pytest.raises(DataError, match=r"another file|takes its data from"):
        import_it(path)


def import_it(path):
    return gbid.load_recording(path) if path.suffix == ".h5" else read(path)
