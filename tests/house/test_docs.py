"""The documentation holds what it says: code runs, links lead somewhere, every public argument is documented."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import shutil
import subprocess
import sys
from enum import Enum
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import h5py
import numpy as np
import pytest
from places import ROOT
from run_page import FENCE, cells, fences, run_apart
from typer.main import get_command

import gbid
from gbid.cli.main import app
from gbid.cli.printing import print_tables
from gbid.core.tables import titled
from gbid.experiment.load import load_experiment
from gbid.experiment.machine import true_model, true_values
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.rig import RIG
from gbid.identify import FitOptions
from gbid.identify.fit_tables import fit_document, fit_tables
from gbid.structure import Plant, RotorBearing, Structure

DOCS = ROOT / "docs"
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"_build", "jupyter_execute"} & set(p.relative_to(DOCS).parts))
LINKED = [*PAGES, ROOT / "README.md", ROOT / "CHANGELOG.md"]
PUBLIC = [name for name in gbid.__all__ if name != "__version__" and not inspect.ismodule(getattr(gbid, name))]


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


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
    experiment = tmp_path / "experiments" / "quickstart.yaml"
    experiment.parent.mkdir()
    shutil.copy(ROOT / "experiments" / "quickstart.yaml", experiment)
    run_stage(Job(load_experiment(experiment)), RIG)

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
    percents = [float(percent) for percent in re.findall(r"[\d.]+", printed.rsplit("]:", 1)[1])]
    joint = next(body for info, body in fences(ROOT / "README.md") if "joint, p5_n6000_prbs1" in body)
    assert_printed(joint, result, percents)
    structure = Plant(RotorBearing(disturbance_gain="none"))
    truth_of = true_values(load_experiment(experiment), ["p5_n6000_prbs1"], structure)
    document = fit_document(result, truth_of, true_model(structure, truth_of, result.linear_model))
    print_tables(*titled("joint, p5_n6000_prbs1", fit_tables(document)))
    lines = {skeleton(line) for line in capsys.readouterr().out.splitlines()}
    of_the_fit = joint.partition("joint, cross-validation")[0].splitlines()
    assert [line for line in of_the_fit if skeleton(line) not in lines] == []

    exec(compile(tuning, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "optimal" in printed
    assert "peak S_o" in printed


def skeleton(line: str) -> str:
    """Words and signs of a printed line, without its digits and the widths of its columns."""
    return " ".join(re.sub(r"\d[\d.]*(e[+-]?\d+)?", "#", line).split())


def assert_printed(joint: str, result: gbid.FitResult, percents: list[float]) -> None:
    """Compare README's block of `make run` with a fit of the same recordings: estimates, std, modes, fit percent.

    A figure may be off by its last digit, and by a tenth of its standard deviation: the solver stops there.
    """
    scale = {"ms": 1e3}
    rows = re.findall(r"^([a-z]\w*_\w+) +(-?[\d.e]+) +([\d.e-]+) .* (\S+|N s/\(kg m\)|N/\(kg m\))$", joint, re.M)
    assert [name for name, *_ in rows] == [name for name in result.parameters if not name.startswith("offset")]
    for name, value, std, unit in rows:
        factor = scale.get(unit, 1.0)
        assert float(std) == pytest.approx(factor * result.std[name], rel=0.06), name
        assert float(value) == pytest.approx(factor * result.parameters[name], rel=1e-4, abs=0.1 * float(std)), name
    modes = re.findall(r"^[12] +([\d.]+) +[\d.]+ +[\d.]+ +([\d.]+)", joint, re.M)
    np.testing.assert_allclose(np.array(modes, float), result.model.modes(), rtol=1e-5)
    others = re.findall(r"^p5_n6000_prbs1 +p5_n6000_prbs2 +\w+ +([\d.]+)", joint, re.M)
    np.testing.assert_allclose(np.array(others, float), percents, atol=0.011)


@pytest.mark.parametrize("path", LINKED, ids=relative)
def test_internal_links_resolve(path: Path) -> None:
    for target in re.findall(r"\]\(<?([^)\s>]+)>?[^)]*\)", prose(path)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        computed = (path.parent / file).resolve() if file else path
        assert computed.is_file(), f"{relative(path)}: {target}"
        if anchor:
            assert anchor in anchors(computed), f"{relative(path)}: {target}"
    for info, body in fences(path):
        if info.startswith("{literalinclude}"):
            assert (path.parent / info.split()[1]).is_file(), f"{relative(path)}: {info}"
        for name in re.findall(r"\{doc\}`([^`]+)`", body):
            assert (path.parent / f"{name}.md").is_file()


WORDS_AT_MOST = 40_000


def test_pages_are_no_longer_than_a_reader_can_bear() -> None:
    """Words between blanks, code and tables included, of all pages but the decisions."""
    pages = {path.relative_to(DOCS).as_posix(): path for path in DOCS.rglob("*.md") if path.parent.name != "decisions"}
    words = {name: len(path.read_text(encoding="utf-8").split()) for name, path in pages.items()}
    longest = sorted(words.items(), key=lambda item: -item[1])[:5]
    assert sum(words.values()) <= WORDS_AT_MOST, f"{sum(words.values())} words; the longest pages: {longest}"


NOTEBOOK = re.compile(r"\{nb-download\}`([^`]+)`")


def test_notebooks_to_download_need_nothing_but_gbid() -> None:
    """Their cells run with the pages; files of the source are not beside a notebook."""
    offered = {path: NOTEBOOK.findall(path.read_text(encoding="utf-8")) for path in PAGES}
    offered = {path: names for path, names in offered.items() if names}
    assert len(offered) >= 3
    for path, names in offered.items():
        assert names == [f"{path.stem}.ipynb"]
        code = "\n".join(cells(path))
        assert not re.search(r"\b(tests\.benchmarks|parents\[|docs/)", code), relative(path)
        assert "literalinclude" not in path.read_text(encoding="utf-8"), relative(path)


@pytest.mark.parametrize("path", [p for p in PAGES if any("Markdown(" in cell for cell in cells(p))], ids=relative)
def test_tables_made_by_cells_are_rendered(path: Path) -> None:
    """Without this line of its head a page shows such a table as running text with bars."""
    assert "\nmystnb:\n  render_markdown_format: myst\n" in path.read_text(encoding="utf-8").split("\n---\n")[0] + "\n"


def test_equation_labels_are_defined() -> None:
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        defined = set(re.findall(r"^\$\$ *\(([\w-]+)\)", text, re.MULTILINE))
        assert set(re.findall(r"\{eq\}`([\w-]+)`", text)) <= defined, relative(path)


def test_benchmarks_need_no_package_of_the_tests_to_show_their_results() -> None:
    """A fresh clone builds the pages in an environment with the extra docs alone, which has no pytest."""
    for path in sorted((ROOT / "tests" / "benchmarks").glob("*.py")):
        for line in ast.parse(path.read_text(encoding="utf-8")).body:
            first = line.module or "" if isinstance(line, ast.ImportFrom) else ""
            names = [alias.name for alias in line.names] if isinstance(line, ast.Import) else [first]
            assert not {name.split(".")[0] for name in names} & {"pytest", "hypothesis", "cma"}, relative(path)


def test_every_page_is_in_a_toctree() -> None:
    listed = {DOCS / "index.md"}
    for path in PAGES:
        for info, body in fences(path):
            if info.startswith("{toctree}"):
                entries = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
                listed |= {(path.parent / f"{entry}.md").resolve() for entry in entries}
    assert listed == set(PAGES)


def test_tree_of_fit_results_names_what_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(1)
    u = random.standard_normal((200, 1))
    lag = gbid.LinearStructure(
        "lag", [gbid.Parameter("a", 1.0, 0.1, 10.0), gbid.Parameter("k", 0.1)], _lag, inputs="u", outputs="y"
    )
    y = 0.1 * random.standard_normal((200, 1)) + np.cumsum(u, axis=0) * 0.01
    gbid.save(gbid.fit(lag, gbid.Recording({"u": u, "y": y}, 0.1)), tmp_path / "fit.h5")
    page = DOCS / "file-formats.md"
    exec(compile(cells(page)[-1], page.name, "exec"), {})
    printed = capsys.readouterr().out
    section = page.read_text(encoding="utf-8").split("## Fit results")[1].split("\n## ")[0]
    section += printed[printed.index("FitResult/") : printed.index("FitTable/")]
    written: dict[str, set[str]] = {"/": set(), "parameters": set(), "model": set()}
    with h5py.File(tmp_path / "fit.h5") as file:
        common = {"gbid_kind", "schema_version", "creator", "created", "made_with", "checksum"}
        for place in written:
            written[place] = set(file[place]) | set(file[place].attrs) - common
    names = set.union(*written.values())
    assert {"K", "B_delayed", "delay", "covariance_white", "covariance_robust", "notes"} <= names
    assert not [name for name in names if not re.search(rf"(^|[ `/@]){name}[ ,`/)]", section, re.MULTILINE)]


def _lag(p: Any) -> dict[str, Any]:
    delayed = {"B_delayed": [[0.1]], "delay": [0.05]}
    return {"A": [[-p.a]], "B": [[p.k]], "C": [[1]], "K": [[0.5]], **delayed}


@pytest.mark.whole
@pytest.mark.parametrize("path", [p for p in PAGES if cells(p)], ids=relative)
def test_code_cells_run(path: Path, tmp_path: Path) -> None:
    """All cells of a page in order, in a process of their own, warnings as errors; the build shows what they print."""
    assert path.read_text(encoding="utf-8").startswith("---\nfile_format: mystnb\n"), "cells would not be executed"
    surroundings = {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1", "COLUMNS": "120"}
    code, output = run_apart(path, tmp_path, surroundings)
    assert code == 0, output[-5000:]


COMMAND = re.compile(r"(?<![\w.-])gbid( [a-z]+\b[^`'\n]*| --[a-z][^`'\n]*)")


def commands(path: Path) -> list[str]:
    """What pages tell to type: lines of console and text blocks, and inline code."""
    typed = [body for info, body in fences(path) if info in ("console", "text", "bash", "sh")]
    lines = [line.split(" # ")[0] for body in typed for line in body.splitlines() if "$ " in line]
    inline = re.findall(r"`(gbid [^`\n]+)`", FENCE.sub("", path.read_text(encoding="utf-8")))
    return [computed.strip() for line in (*lines, *inline) for computed in COMMAND.findall(line)]


@pytest.mark.parametrize("path", LINKED, ids=relative)
def test_commands_exist(path: Path) -> None:
    group: Any = get_command(app)
    for command in commands(path):
        words = command.split()
        options = {"--help"}
        if words[0].startswith("-"):
            verb = group
        else:
            verb = group.commands.get(words[0])
            assert verb, f"{relative(path)}: gbid {command}: no such verb"
        options |= {opt for parameter in verb.params for opt in (*parameter.opts, *parameter.secondary_opts)}
        named = {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert named <= options, f"{relative(path)}: gbid {command}: no such option"


def test_commands_are_found() -> None:
    assert "tune" in [command.split()[0] for command in commands(DOCS / "index.md")]
    assert [c for c in commands(DOCS / "campaign.md") if "--shard" in c]


def sections(docstring: str) -> dict[str, str]:
    """Sections of a numpydoc docstring."""
    parts = re.split(r"^(\w[\w ]*)\n-{3,}\n", inspect.cleandoc(docstring), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def described(section: str) -> set[str]:
    """Names at the left margin of a section, those sharing a line apart."""
    lines = [line for line in section.splitlines() if line and not line.startswith(" ")]
    return {name.strip().lstrip("*") for line in lines for name in line.split(" : ")[0].split(",")}


API_TEXT = "".join(path.read_text(encoding="utf-8") for path in PAGES if path.parent.name == "api")
API = re.findall(r"^\.\. auto(?:function|class):: (\S+)$", API_TEXT, re.MULTILINE)


def public(name: str) -> Any:
    """What a directive of the API page names."""
    module, _, attribute = name.replace("::", ".").rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def methods(cls: type) -> dict[str, Any]:
    """Public methods that a class defines itself."""
    plain = {name: getattr(value, "__func__", value) for name, value in vars(cls).items() if not name.startswith("_")}
    return {name: value for name, value in plain.items() if inspect.isfunction(value)}


def arguments(value: Any) -> set[str]:
    return {key for key in inspect.signature(value).parameters if not key.startswith("_")} - {"self", "cls"}


def words_on(value: Any) -> set[str]:
    """Arguments that a docstring describes, in a list or in its sentences."""
    result = sections(value.__doc__ or "")
    return {
        *described(result.get("Parameters", "")),
        *described(result.get("Attributes", "")),
        *re.findall(r"(?<!`)`(\w+)`(?!`)", value.__doc__ or ""),
    }


def shared_words() -> dict[str, set[str]]:
    """Arguments of methods that several classes have alike (`matrices`, `reference`): said once is enough."""
    shared: dict[str, set[str]] = {}
    for name in API:
        if inspect.isclass(value := public(name)):
            for method, function in methods(value).items():
                shared.setdefault(method, set()).update(
                    described(sections(function.__doc__ or "").get("Parameters", ""))
                )
    return shared


SHARED = shared_words()


@pytest.mark.parametrize("name", API)
def test_the_api_page_documents_each_argument(name: str) -> None:
    value = public(name)
    assert value.__doc__
    known = words_on(value)
    if not inspect.isclass(value):
        nothing = inspect.signature(value).return_annotation in (None, "None")
        assert nothing or name.count(".") > 1 or "Returns" in sections(value.__doc__), f"{name}: what does it return"
    elif all(hasattr(value, key) for key in ("matrices", "intersample")):  # said once, at the protocol
        known |= words_on(Structure)
    elif issubclass(value, FitOptions):  # said once, at the options of a fit
        known |= words_on(FitOptions)
    nobody_calls_it = value is Structure or (inspect.isclass(value) and issubclass(value, Enum))
    missing = set() if nobody_calls_it else arguments(value) - known
    assert not missing, f"{name}: no word about {sorted(missing)}"
    for method, function in methods(value).items() if inspect.isclass(value) else ():
        assert function.__doc__, f"{name}.{method} has no docstring"
        missing = arguments(function) - words_on(function) - SHARED[method]
        assert not missing, f"{name}.{method}: no word about {sorted(missing)}"


@pytest.mark.parametrize("name", API)
def test_no_bar_in_a_docstring_reads_as_a_substitution(name: str) -> None:
    """The build fails on |r|, which reST takes for the name of a replacement."""
    value = public(name)
    described = [value, *(methods(value).values() if inspect.isclass(value) else ())]
    described += [v for v in vars(value).values() if isinstance(v, property)] if inspect.isclass(value) else []
    text = "\n".join(inspect.cleandoc(each.__doc__ or "") for each in described)
    text = re.sub(r"``.*?``|:math:`.*?`|\.\. math::.*?(?=\n\S)", "", text, flags=re.DOTALL)
    assert re.findall(r"\|\w[^|\n]*\|", text) == []


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_in_the_api_page(name: str) -> None:
    assert re.search(rf"^\.\. auto\w+:: gbid(\.{name}|\.{name}::{name})$", API_TEXT, re.MULTILINE)


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("myst_nb", reason="the docs extra is not installed: pip install .[docs]")
    docs = shutil.copytree(DOCS, tmp_path / "docs", ignore=shutil.ignore_patterns("_build", "jupyter_execute"))
    for folder in ("models", "experiments", "tests/benchmarks"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("results", "__pycache__"))
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", docs, tmp_path / "html"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for path in PAGES:
        for name in NOTEBOOK.findall(path.read_text(encoding="utf-8")):
            notebook = json.loads(next((tmp_path / "html" / "_downloads").rglob(name)).read_text(encoding="utf-8"))
            assert any(cell.get("outputs") for cell in notebook["cells"]), name


def test_architecture_and_decisions_name_files_that_exist() -> None:
    pages = [DOCS / "architecture.md", *sorted((DOCS / "decisions").glob("*.md"))]
    named = {
        (page.name, name)
        for page in pages
        for name in re.findall(
            r"(?<![\w/])((?:gbid|tests|experiments|models|docs)/[\w/.-]*\w)",
            page.read_text(encoding="utf-8"),
        )
    }
    assert len(named) >= 60
    assert sorted(each for each in named if not (ROOT / each[1]).exists()) == []


def test_no_row_of_the_architecture_names_a_file_twice() -> None:
    rows = [line for line in (DOCS / "architecture.md").read_text(encoding="utf-8").splitlines() if line[:2] == "| "]
    files = [re.findall(r"`((?:gbid|tests)/[\w/.]+)`", row) for row in rows]
    assert [each for each in files if len(set(each)) < len(each)] == []


def test_reference_pages_name_what_there_is() -> None:
    """Sphinx warns of such names, but its pages are built by `make docs` alone."""
    named = re.compile(r"\.\. auto(?:class|function|data|module):: (\S+)\n(?:   :members: (\S.*)\n)?")
    missing = []
    for page in PAGES:
        for path, members in named.findall(page.read_text(encoding="utf-8")):
            try:
                value = resolve_name(path.replace("::", ":"))
                fields = getattr(value, "__dataclass_fields__", {})
                missing += [f"{path}.{m}" for m in re.findall(r"\w+", members) if not hasattr(value, m) | (m in fields)]
            except (AttributeError, ImportError):
                missing.append(path)
    assert missing == []
