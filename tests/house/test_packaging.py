"""What travels inside the wheel, and from where; read from the build's own settings."""

import itertools
import json
import re
import tomllib

import licences
import pins
import try_release
from places import ROOT

from gbid.core.files import share_folder

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
WHEEL = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]


def test_every_experiment_is_in_the_wheel_and_no_result_of_one():
    included = WHEEL["force-include"]
    files = {p.relative_to(ROOT) for p in (ROOT / "experiments").rglob("*") if p.suffix in (".yaml", ".py", ".csv")}
    experiments = {str(p) for p in files if not {"results", "__pycache__"} & set(p.parts)}
    assert {source for source in included if source.startswith("experiments")} == experiments
    for source, target in included.items():
        path = ROOT / source
        assert path.exists()
        assert target == f"gbid/_share/{source}"
        # a folder is taken as it is, so it must be one that no run writes to
        assert path.is_file() or not list(path.rglob("results"))


def test_the_package_brings_its_types_and_its_style():
    assert WHEEL["packages"] == ["gbid"]
    assert (ROOT / "gbid" / "py.typed").is_file()
    assert (ROOT / "gbid" / "__init__.pyi").is_file()
    assert (ROOT / "gbid" / "report" / "gbid.mplstyle").is_file()
    assert (share_folder("models") / "theisen2016.yaml").is_file()
    assert (share_folder("experiments") / "quickstart.yaml").is_file()


def test_the_version_stands_in_one_place():
    version = (ROOT / "gbid" / "_version.py").read_text(encoding="utf-8").split('"')[-2]
    assert PROJECT["project"]["dynamic"] == ["version", "readme"]
    assert re.search(rf"^## {re.escape(version)}\b", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    for name in ("README.md", "CITATION.cff", "CONTRIBUTING.md", "docs/conf.py", "pyproject.toml"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not re.search(rf"(?<![\d.]){re.escape(version)}(?![\d.])", text), name


def test_each_file_of_the_project_is_in_the_source_archive():
    """What stands at the root of the checkout, apart from what the build adds itself."""
    sdist = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    names = {path.name for path in ROOT.iterdir() if not path.name.startswith(".") or path.suffix == ".yaml"}
    made = {"dist", "build", "results"}
    assert names - made <= {*sdist, "README.md", "LICENSE", "pyproject.toml"}
    assert all((ROOT / name).exists() for name in sdist)


def test_the_readme_of_a_package_index_has_no_link_to_a_file_beside_it():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "](docs/" in text
    for step in PROJECT["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(step["pattern"], step["replacement"], text)
    assert not re.findall(r"\]\((?!https?:)", text)
    assert "Method: the mathematics." in text


def test_the_list_of_components_has_the_pinned_versions_and_their_licences():
    listed = json.loads(licences.COMPONENTS.read_text(encoding="utf-8"))["components"]
    assert {each["name"]: each["version"] for each in listed} == licences.pinned()  # else run `make licences`
    assert all(each["licenses"][0]["license"]["name"] not in ("not known", "none stated") for each in listed)
    assert len(listed) > 25


def test_the_licence_of_each_dependency_is_named():
    assert "LGPL" in licences.licence("casadi") or "Lesser" in licences.licence("casadi")
    stated = licences.listed()
    assert list(stated) == list(licences.extras())
    assert not {"not known", "none stated"} & {*stated.values()}
    for package in ("casadi", "nptdms", "asammdf"):
        assert re.search("LGPL|Lesser", stated[package])


def test_the_list_of_versions_holds_all_that_is_installed_with_digests_and_no_client_of_a_service():
    text = pins.LIST.read_text(encoding="utf-8")
    needed, tools = ([*map(pins.canonical, re.findall(r"^([\w.-]+)==", part, re.M))] for part in text.split(pins.TOOLS))
    assert len({*needed, *tools}) == len(needed) + len(tools)
    extras = {pins.canonical(name): words for name, words in licences.extras().items()}
    build = {pins.canonical(re.split("[>=<]", name)[0]) for name in PROJECT["build-system"]["requires"]}
    assert build | {name for name, words in extras.items() if not words} <= set(needed)
    wanted = [each for extra in ("test", "docs") for each in PROJECT["project"]["optional-dependencies"][extra]]
    assert {pins.canonical(re.split("[>=<]", name)[0]) for name in wanted} <= {*needed, *tools}
    assert not [name for name in tools if "google" in name]
    lines = text.splitlines()
    for line, following in itertools.pairwise(lines):
        assert "==" not in line or line.startswith("#") or following.lstrip().startswith("--hash=sha256:")


def test_the_wheel_is_tried_with_newest_and_lowest_dependencies_of_each_python(monkeypatch, tmp_path):
    for name in ("gbid-0-py3-none-any.whl", "gbid-0.tar.gz"):
        (tmp_path / name).touch()
    tried = []
    monkeypatch.setattr(try_release, "check_source", lambda _: 0)
    monkeypatch.setattr(try_release, "found_pythons", lambda: {(3, 11): "a", (3, 13): "b"})
    monkeypatch.setattr(try_release, "try_installed", lambda _, __, *how: tried.append(how))
    try_release.try_release(tmp_path, [])
    assert tried[:4] == [("a", False), ("a", True), ("b", False), ("b", True)]
    assert tried[4][1:] == (False, ["extra"])  # the compiler of the extra
    tried.clear()
    try_release.try_release(tmp_path, ["--here"])
    assert [how[1] for how in tried] == [False, True]
    assert "make release-check TRY=--here" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
