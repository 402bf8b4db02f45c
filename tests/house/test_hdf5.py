"""Atomic writing and checked reading."""

import os
import stat
from importlib import import_module
from pkgutil import walk_packages

import h5py
import numpy as np
import pytest
import stored_values

import gbid
from gbid.core import hdf5
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5.file import add_attribute
from gbid.stored import TYPES

THING = hdf5.FileKind("thing", "make it again")


def write(path, kind=THING, overwrite=False, value=1.0):
    with hdf5.writing(path, kind, overwrite) as file:
        hdf5.add_dataset(file, "x", value, "m", "length")


def test_what_is_written_can_be_read(tmp_path):
    path = tmp_path / "deep" / "er" / "a.h5"
    write(path)
    with hdf5.reading(path, THING) as file:
        assert hdf5.read_dataset(file, "x") == 1.0
        assert hdf5.read_attribute(file["x"], "units") == "m"
        assert hdf5.read_attribute(file["x"], "long_name") == "length"
        assert file.attrs["creator"].startswith("gbid ")
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


@pytest.mark.parametrize(
    "values",
    [
        np.arange(6.0).reshape(2, 3).T,
        np.arange(6)[::-2],
        np.array(3.0),
        np.zeros((0, 2)),
        np.array([True, False]),
        np.array([["a", "ä"], ["", "b"]], dtype=object).T,
        np.array(1.5, dtype=">f8"),
    ],
    ids=["transposed", "strided", "single", "empty", "logical", "texts", "big-endian"],
)
def test_arrays_of_any_layout_are_stored(values, tmp_path):
    with hdf5.writing(tmp_path / "a.h5", THING) as file:
        hdf5.add_dataset(file, "deep/x", values, "m", "length")
        add_attribute(file, "x", values)
    with h5py.File(tmp_path / "a.h5") as file:
        by_h5py = file["deep/x"].asstr()[()] if values.dtype.kind == "O" else file["deep/x"][()]
        for stored in (by_h5py, file.attrs["x"], hdf5.read_attribute(file, "x")):
            np.testing.assert_array_equal(stored, values, strict=values.ndim > 0 and values.dtype.kind != "O")


def test_refuses_to_overwrite_unless_asked(tmp_path):
    path = tmp_path / "a.h5"
    write(path)
    before = path.read_bytes()
    with pytest.raises(UsageError, match=r"a\.h5 exists already"):
        write(path, value=2.0)
    assert path.read_bytes() == before
    write(path, overwrite=True, value=2.0)
    with hdf5.reading(path, THING) as file:
        assert file["x"][()] == 2.0


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, OSError])
def test_a_failure_in_the_middle_leaves_what_was_there(tmp_path, error):
    new, old = tmp_path / "new.h5", tmp_path / "old.h5"
    write(old)
    before = old.read_bytes()
    expected = DataError if error is OSError else error
    for path in (new, old):
        with pytest.raises(expected), hdf5.writing(path, THING, overwrite=True) as file:  # noqa: PT012
            file["half"] = np.arange(1000.0)
            raise error
    assert sorted(p.name for p in tmp_path.iterdir()) == ["old.h5"]
    assert old.read_bytes() == before


def test_folders_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a.h5", tmp_path / ("a" * 300), tmp_path):
        with pytest.raises((DataError, UsageError), match=r"cannot be written|its longest part 300"):
            write(path, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def bad_files(folder):
    """Path and the words that its error must have."""
    good = folder / "good.h5"
    write(good)
    content = good.read_bytes()
    yield folder / "none.h5", "no such file"
    yield folder, "not a file"
    for name, data in {
        "empty": b"",
        "text": b"hello",
        "half": content[: len(content) // 2],
        "head": content[:100],
    }.items():
        (folder / name).write_bytes(data)
        is_hdf5 = name in ("half", "head")
        yield folder / name, "the checksum at its end is missing" if is_hdf5 else "not a readable HDF5 file"
    for name, attributes in {
        "foreign": {"gbid_kind": 1.0},
        "other": {"gbid_kind": "fit", "schema_version": 1},
        "list": {"gbid_kind": ["thing", "thing"], "schema_version": 1},
    }.items():
        write(folder / name)
        with hdf5.changing(folder / name) as file:
            file.attrs.update(attributes)
        yield folder / name, "expected a gbid thing file"
    for name, version in {"newer": 99, "words": "one", "many": [1, 1], "without": None}.items():
        write(folder / name)
        with hdf5.changing(folder / name) as file:
            del file.attrs["schema_version"]
            if version is not None:
                file.attrs["schema_version"] = version
        yield folder / name, "schema_version"


def test_bad_files_are_refused_in_one_line_with_the_name(tmp_path):
    for path, words in bad_files(tmp_path):
        with pytest.raises(DataError) as caught, hdf5.reading(path, THING):
            pass
        text = str(caught.value)
        assert text.startswith(f"{path}: ")
        assert words in text
        assert "\n" not in text


def test_missing_entries_are_named(tmp_path):
    path = tmp_path / "a.h5"
    with hdf5.writing(path, THING) as file:
        file.create_group("g")["text"] = "words"
        file["g"]["null"] = h5py.Empty("f8")
        file["x"] = 1.0
    cases = [
        (lambda f: f["absent"], "incomplete thing file"),
        (lambda f: hdf5.read_dataset(f, "absent"), "/absent is missing"),
        (lambda f: hdf5.read_dataset(f, "g"), "/g is a group"),
        (lambda f: hdf5.read_dataset(f["g"], "text"), "/g/text holds object, not numbers"),
        (lambda f: hdf5.read_dataset(f["g"], "null"), "not numbers"),
        (lambda f: hdf5.read_attribute(f["x"], "units"), "/x has no attribute 'units'"),
    ]
    for read, words in cases:
        with pytest.raises(DataError) as caught, hdf5.reading(path, THING) as file:
            read(file)
        assert str(caught.value).startswith(f"{path}: ")
        assert words in str(caught.value)


def test_a_file_without_checksum_is_refused_before_the_library_sees_it(tmp_path):
    """As gbid 0.1.0 and other programs write it."""
    path = tmp_path / "old.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"gbid_kind": "thing", "schema_version": 1})
    words = r"old\.h5: the checksum at its end is missing: .* gbid 0\.1\.0.*; create it again, import it, or"
    with pytest.raises(DataError, match=words), hdf5.reading(path, THING):
        pass


def test_load_returns_the_type_that_the_file_names(tmp_path):
    recording = stored_values.recording()
    gbid.save(recording, tmp_path / "a.h5")
    assert type(gbid.load(tmp_path / "a.h5")) is gbid.Recording
    with pytest.raises(DataError, match="expected a gbid table file, found recording"):
        gbid.load(tmp_path / "a.h5", gbid.identify.FitTable)
    write(tmp_path / "b.h5")
    with pytest.raises(DataError, match=r"b\.h5: a thing file; `gbid\.load` reads fit, impact"):
        gbid.load(tmp_path / "b.h5")


def test_load_knows_each_type_with_a_file_of_its_own():
    kinds = set()
    for name in (module.name for module in walk_packages(gbid.__path__, "gbid.")):
        for value in vars(import_module(name)).values():
            if isinstance(value, type) and issubclass(value, hdf5.InFile) and value is not hdf5.InFile:
                kinds.add((value.FILE.name, value))
    known = {(name, getattr(import_module(module), made)) for name, (module, made) in TYPES.items()}
    assert kinds == known


def test_an_error_of_input_or_output_is_one_line(tmp_path, monkeypatch):
    """The HDF5 library tells it in three."""
    path = tmp_path / "a.h5"
    gbid.save(gbid.Recording({"u": np.zeros((3, 1))}, 1.0), path)

    def failing(*_arguments, **_options):
        raise OSError("Can't read data (file read failed: time = Mon Nov 23\n, filename = 'a.h5'\n, errno = 5)")

    monkeypatch.setattr(h5py, "File", failing)
    with pytest.raises(DataError, match=r"time = Mon Nov 23 , filename = 'a.h5' , errno = 5\)$"):
        gbid.load(path)


def test_an_array_in_any_order_of_memory_is_stored(tmp_path):
    values = np.arange(6.0).reshape(2, 3).T
    with h5py.File(tmp_path / "a.h5", "w") as file:
        hdf5.add_dataset(file, "values", values, "m", "a transposed array")
        np.testing.assert_array_equal(file["values"][()], values)
