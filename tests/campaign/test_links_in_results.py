"""A link in a results folder is refused by every verb that writes there, and nothing outside changes."""

import shutil

import pytest
from experiment_files import gbid, printed_by, write_spring

VERBS = ("run", "fit", "batch", "crossval", "report", "import", "clean", "clean --everything", "run --overwrite")
PLACES = (
    ".gbid.lock",
    "fits",
    "fits/spring",
    "fits/spring/run1.h5",
    "recordings",
    "table.csv",
    "report.html",
    "failed",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = write_spring(tmp_path_factory.mktemp("links"))
    assert gbid("run", path) == 0
    return path


@pytest.mark.parametrize("place", PLACES)
def test_no_verb_follows_a_link_in_the_results(place, made, tmp_path, capsys):
    folder, victim = tmp_path / "made", tmp_path / "victim"
    shutil.copytree(made.parent, folder)
    link = folder / "results" / "spring" / place
    if link.is_dir() or place == "failed":
        shutil.copytree(link, victim) if link.is_dir() else victim.mkdir()
        (victim / "run1.json").write_text("precious")
    else:
        victim.write_text("precious")
    if link.is_dir():
        shutil.rmtree(link)
    link.unlink(missing_ok=True)
    link.symlink_to(victim)
    before = {path: path.read_bytes() for path in [victim, *victim.rglob("*")] if path.is_file()}
    for verb in VERBS:
        name, *options = verb.split()
        told = printed_by(capsys, name, folder / made.name, *options, code=3).err.splitlines()
        assert len(told) == 1
        assert f"{link}: is a link" in told[0]
    assert {path: path.read_bytes() for path in [victim, *victim.rglob("*")] if path.is_file()} == before


def test_the_results_folder_itself_may_be_a_link(made, tmp_path):
    folder = tmp_path / "made"
    shutil.copytree(made.parent, folder)
    shutil.move(folder / "results", tmp_path / "disk")
    (folder / "results").symlink_to(tmp_path / "disk")
    assert gbid("run", folder / made.name) == 0
