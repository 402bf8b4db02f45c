"""The documentation holds what it says: code runs, links lead somewhere, every public argument is documented."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import gbid
from gbid.experiment.load import load_experiment
from gbid.experiment.stages import Job, make_rig_recordings
from gbid.structure import Structure

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"_build", "jupyter_execute"} & set(p.relative_to(DOCS).parts))
LINKED = [*PAGES, ROOT / "README.md", ROOT / "CHANGELOG.md"]
PUBLIC = [name for name in gbid.__all__ if name != "__version__"]

FENCE = re.compile(r"^(`{3,}|~{3,})([^\n]*)\n(.*?)^\1[ ]*$", re.MULTILINE | re.DOTALL)


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def fences(path: Path) -> list[tuple[str, str]]:
    """Info string and body of each fenced block."""
    return [(info.strip(), body) for _, info, body in FENCE.findall(path.read_text(encoding="utf-8"))]


def prose(path: Path) -> str:
    """Text of a page without code."""
    return re.sub(r"`[^`\n]*`", "", FENCE.sub("", path.read_text(encoding="utf-8")))


def anchors(path: Path) -> set[str]:
    """What a link may name after '#': headings as GitHub and MyST slug them, and explicit targets."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    headings = [h.replace("`", "") for h in re.findall(r"^#{1,3} +(.+?) *$", text, re.MULTILINE)]
    slugs = {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
    return slugs | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


def test_readme_python_runs_on_what_make_run_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "gbid run experiments/quickstart.yaml" in (ROOT / "Makefile").read_text(encoding="utf-8")
    blocks = [body for info, body in fences(ROOT / "README.md") if info == "python"]
    fitting, tuning = blocks
    text = (ROOT / "experiments" / "quickstart.yaml").read_text(encoding="utf-8")
    shorter = text.replace("duration_s: 5.0", "duration_s: 1.5")
    assert shorter != text
    experiment = tmp_path / "experiments" / "quickstart.yaml"
    experiment.parent.mkdir()
    experiment.write_text(shorter, encoding="utf-8")
    make_rig_recordings(Job(load_experiment(experiment)))

    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(fitting, "README.md", "exec"), names)

    result = names["result"]
    assert isinstance(result, gbid.FitResult)
    assert result.success
    truth = gbid.load_model("theisen2016").at(5.0, 6000.0).modes()
    for (frequency, damping), (true_frequency, true_damping) in zip(result.model.modes(), truth, strict=True):
        assert abs(frequency - true_frequency) < 0.3
        assert abs(damping - true_damping) < 0.003
    printed = capsys.readouterr().out
    assert all(re.search(rf"^{name} .*{re.escape(result.units[name])}$", printed, re.M) for name in result.parameters)
    percents = re.findall(r"[\d.]+", printed.rsplit("]:", 1)[1])
    assert len(percents) == 2
    assert min(map(float, percents)) > 90

    exec(compile(tuning, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "optimal" in printed
    assert "peak S_o" in printed


@pytest.mark.parametrize("path", LINKED, ids=relative)
def test_internal_links_resolve(path: Path) -> None:
    for target in re.findall(r"\]\(<?([^)\s>]+)>?[^)]*\)", prose(path)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        found = (path.parent / file).resolve() if file else path
        assert found.is_file(), f"{relative(path)}: {target}"
        if anchor:
            assert anchor in anchors(found), f"{relative(path)}: {target}"
    for info, body in fences(path):
        if info.startswith("{literalinclude}"):
            assert (path.parent / info.split()[1]).is_file(), f"{relative(path)}: {info}"
        for name in re.findall(r"\{doc\}`([^`]+)`", body):
            assert (path.parent / f"{name}.md").is_file()


def test_equation_labels_are_defined() -> None:
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        defined = set(re.findall(r"^\$\$ *\(([\w-]+)\)", text, re.MULTILINE))
        assert set(re.findall(r"\{eq\}`([\w-]+)`", text)) <= defined, relative(path)


def test_every_page_is_in_a_toctree() -> None:
    listed = {DOCS / "index.md"}
    for path in PAGES:
        for info, body in fences(path):
            if info.startswith("{toctree}"):
                entries = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
                listed |= {(path.parent / f"{entry}.md").resolve() for entry in entries}
    assert listed == set(PAGES)


def test_tree_of_fit_results_names_what_is_written(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    u = random.standard_normal((200, 1))
    lag = gbid.LinearStructure(
        "lag", [gbid.Parameter("a", 1.0, 0.1, 10.0), gbid.Parameter("k", 0.1)], _lag, inputs="u", outputs="y"
    )
    y = 0.1 * random.standard_normal((200, 1)) + np.cumsum(u, axis=0) * 0.01
    gbid.save_fit(gbid.fit(lag, gbid.Recording({"u": u, "y": y}, 0.1)), tmp_path / "fit.h5")
    section = (DOCS / "file-formats.md").read_text(encoding="utf-8").split("## Fit results")[1].split("\n## ")[0]
    written: dict[str, set[str]] = {"/": set(), "parameters": set(), "model": set()}
    with h5py.File(tmp_path / "fit.h5") as file:
        common = {"gbid_kind", "schema_version", "creator", "created"}
        for place in written:
            written[place] = set(file[place]) | set(file[place].attrs) - common
    names = set.union(*written.values())
    assert {"K", "B_delayed", "delay", "covariance_white", "covariance_robust", "notes"} <= names
    assert not [name for name in names if not re.search(rf"(^|[ ,│├└─]){name}[ ,/:]", section, re.MULTILINE)]


def _lag(p: Any) -> dict[str, Any]:
    late = {"B_delayed": [[0.1]], "delay": [0.05]}
    return {"A": [[-p.a]], "B": [[p.k]], "C": [[1]], "K": [[0.5]], **late}


def cells(path: Path) -> list[str]:
    """Executed code of a page, without the cells' options."""
    return [re.sub(r"\A(:[^\n]*\n)+", "", body) for info, body in fences(path) if info.startswith("{code-cell}")]


@pytest.mark.parametrize("path", [p for p in PAGES if cells(p)], ids=relative)
def test_code_cells_import_what_is_there(path: Path) -> None:
    """The build runs the cells; this finds at once what was renamed."""
    assert path.read_text(encoding="utf-8").startswith("---\nfile_format: mystnb\n"), "cells would not be executed"
    for body in cells(path):
        for node in ast.walk(ast.parse(body)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "gbid":
                module = importlib.import_module(node.module)
                assert not [a.name for a in node.names if not hasattr(module, a.name)]
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "gbid":
                importlib.import_module("gbid.errors")
                assert hasattr(gbid, node.attr), node.attr


def sections(docstring: str) -> dict[str, str]:
    """Sections of a numpydoc docstring."""
    parts = re.split(r"^(\w[\w ]*)\n-{3,}\n", inspect.cleandoc(docstring), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def described(section: str) -> set[str]:
    """Names at the left margin of a section, those sharing a line apart."""
    lines = [line for line in section.splitlines() if line and not line.startswith(" ")]
    return {name.strip().lstrip("*") for line in lines for name in line.split(" : ")[0].split(",")}


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_document_each_argument(name: str) -> None:
    value = getattr(gbid, name)
    if inspect.ismodule(value):  # gbid.prefilter, the callable package
        value = getattr(value, name)
    assert value.__doc__
    found = sections(value.__doc__)
    known = described(found.get("Parameters", "")) | described(found.get("Attributes", ""))
    if inspect.isclass(value):
        assert {"Parameters", "Attributes"} & set(found)
        if all(hasattr(value, key) for key in ("matrices", "intersample")):  # said once, at the protocol
            assert Structure.__doc__
            known |= described(sections(Structure.__doc__)["Attributes"])
    elif inspect.signature(value).return_annotation not in (None, "None"):
        assert "Returns" in found
    arguments = {key for key in inspect.signature(value).parameters if not key.startswith("_")}
    assert arguments <= known, f"{name}: no word about {sorted(arguments - known)}"


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_in_the_api_page(name: str) -> None:
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    assert re.search(rf"^\.\. auto\w+:: gbid(\.{name}|\.{name}::{name})$", text, re.MULTILINE)


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("myst_nb", reason="the docs extra is not installed: pip install .[docs]")
    docs = shutil.copytree(DOCS, tmp_path / "docs", ignore=shutil.ignore_patterns("_build", "jupyter_execute"))
    for folder in ("models", "experiments", "benchmarks"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("results", "__pycache__"))
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", docs, tmp_path / "html"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
