"""Text files with checksums: each writer, changes that are noticed, and changes that are none."""

import random

import pytest

import gbid
from gbid.core.errors import DataError
from gbid.core.files import add_text_checksum, has_valid_checksum, is_changed, with_checksum, with_text_checksum
from gbid.core.tables import plain_table, write_csv
from gbid.experiment.fields import writing_keyed
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import write_chain
from gbid.lpv import load_model, save_model

MODEL = load_model("theisen2016")


def controller(folder):
    gbid.save_controller(folder / "p.yaml", "P", {"kappa_x": 1.125, "kappa_y": 0.99}, sample_time=2e-4)
    return [folder / "p.yaml"]


def model(folder):
    save_model(MODEL, folder / "model.yaml")
    return [folder / "model.yaml"]


def table(folder):
    with writing_keyed(folder / "table.csv", "") as part:
        write_csv(plain_table(("a", "b"), [(1.0, 2.5)], ("note",)), part)
    return [folder / "table.csv"]


def source(folder):
    controller(folder)
    chain = chain_of(gbid.load_controller(folder / "p.yaml"), options=ChainOptions(stroke_m=45e-6, disc_limit_m=2e-5))
    return write_chain(chain, folder)[:-1]  # the last one holds the digests of the others


@pytest.mark.parametrize("write", [controller, model, table, source])
def test_each_writer(write, tmp_path):
    for path in write(tmp_path):
        content = path.read_bytes()
        assert b" gbid sha256 " in content
        assert not is_changed(content)
        assert not is_changed(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n") + b"\n")  # as editors save it
        assert is_changed(content[: len(content) // 2])
        assert is_changed(content + b"# one more line\n")
        chance = random.Random(1)
        for _ in range(100):
            place = chance.randrange(len(content))
            damaged = bytearray(content)
            damaged[place] ^= 1 << chance.randrange(8)
            assert is_changed(bytes(damaged)) or without_checksum(damaged) == without_checksum(content), place


def without_checksum(content):
    return [line for line in bytes(content).replace(b"\r", b"").rstrip().split(b"\n") if b"sha" not in line]


def test_a_changed_byte_of_a_binary_file_is_noticed(tmp_path):
    path, content = tmp_path / "file.h5", bytearray(with_checksum(bytes(range(256))))
    path.write_bytes(content)
    assert has_valid_checksum(path)
    for place in (0, 255, len(content) - 2):  # of the content, and of the digest
        changed = content.copy()
        changed[place] ^= 1
        path.write_bytes(changed)
        with pytest.raises(DataError, match="checksum"):
            has_valid_checksum(path)
    path.write_bytes(content[:-1])
    assert not has_valid_checksum(path)


def test_text_of_people_and_new_checksum(tmp_path):
    assert not is_changed(b"# my sha256 notes\nkind: controller\n")
    text = with_text_checksum("a: 1\n", ".yaml")
    again = with_text_checksum(f"# content_key: 12\n{text}", ".yaml")
    assert again.count("gbid sha256") == 1
    assert not is_changed(again.encode())
    path = tmp_path / "page.html"
    path.write_text("<p>as it is</p>")
    add_text_checksum(path, path.suffix)
    assert path.read_text() == "<p>as it is</p>"
