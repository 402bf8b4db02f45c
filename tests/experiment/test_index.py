import os

import pytest

from gbid.core import index
from gbid.core.index import known, load_index, save_index


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A hundred files, each of which is read once."""
    monkeypatch.setattr(index, "_facts", {})
    monkeypatch.setattr(index, "_SETTLED_NS", -1_000_000_000)
    for i in range(100):
        (tmp_path / f"{i}.txt").write_text(f"{i:03d}")
    assert read_again(tmp_path, fresh=False) == list(range(100))
    save_index(tmp_path)
    return tmp_path


def read_again(folder, fresh=True):
    """Numbers of the files that are read when another process asks for the same fact about all of them."""
    if fresh:
        index._facts.clear()
        load_index(folder)
    taken = []
    for i in range(100):
        path = folder / f"{i}.txt"
        assert known(path, "text", lambda path: taken.append(int(path.stem)) or path.read_text()) == path.read_text()
    return taken


def test_a_file_that_has_not_changed_is_not_read_again(folder):
    assert read_again(folder) == []


def test_a_changed_file_is_read_again_also_with_its_old_size_and_time(folder):
    path = folder / "7.txt"
    before = path.stat()
    path.write_text("abc")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    other = folder / "new"
    other.write_text("012")
    other.replace(folder / "12.txt")
    assert read_again(folder) == [7, 12]


def test_another_fact_of_the_same_file_is_read(folder):
    assert known(folder / "3.txt", "length", lambda path: len(path.read_text())) == 3


@pytest.mark.parametrize("damage", [lambda t: t[:-9], lambda t: t.replace(b"003", b"004", 1), lambda _: b""])
def test_a_damaged_index_is_none(folder, damage):
    path = folder / index.NAME
    path.write_bytes(damage(path.read_bytes()))
    assert read_again(folder) == list(range(100))


def test_an_index_of_another_version_is_none(folder, monkeypatch):
    monkeypatch.setattr(index, "__version__", "0.0.1")
    assert read_again(folder) == list(range(100))


def test_a_change_of_the_last_seconds_is_not_trusted(folder, monkeypatch):
    monkeypatch.setattr(index, "_SETTLED_NS", 60_000_000_000)
    (folder / index.NAME).unlink()
    save_index(folder)
    assert not (folder / index.NAME).exists()
