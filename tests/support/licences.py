"""Licences of the packages that gbid needs or may use, from their metadata: `make licences` writes them down."""

import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution

from places import DOCS, ROOT

PAGE = DOCS / "install.md"
_DEVELOPERS = ("test", "docs")
_HEADING = "| package | installed by | licence |\n|---|---|---|\n"


def extras() -> dict[str, str]:
    """The packages that a user may get, each with the extra that brings it; empty for what gbid always needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = {name: wanted for name, wanted in project["optional-dependencies"].items() if name not in _DEVELOPERS}
    lists = {"": project["dependencies"], **optional}
    return {re.split(r"[<>=!~;\[ ]", wanted)[0]: extra for extra, all_wanted in lists.items() for wanted in all_wanted}


def licence(package: str) -> str | None:
    """The licence that the metadata of an installed package state; None when it is not installed."""
    try:
        result = distribution(package)
    except PackageNotFoundError:
        return None
    classifiers = [c.split(" :: ")[-1] for c in result.metadata.get_all("Classifier") or () if "License ::" in c]
    named = [c for c in classifiers if c != "OSI Approved"]
    written = (result.metadata.get("License") or "").strip().splitlines()
    words = [result.metadata.get("License-Expression"), *named, *written[:1]]
    texts = [file for file in result.files or () if re.search(r"dist-info/.*LICEN[CS]E", str(file))]
    words += ["see its file " + texts[0].name] if texts else []
    return next(word for word in [*words, "none stated"] if word)


def rows() -> list[str]:
    """The rows of the table; what is not installed keeps its row."""
    kept = dict(re.findall(r"^\| `([^`]+)` \|[^|]*\| ([^|]+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    results = {package: licence(package) or kept.get(package, "not known") for package in extras()}
    by = {package: f"`{extra}`" if extra else "always" for package, extra in extras().items()}
    return [f"| `{package}` | {by[package]} | {words} |" for package, words in results.items()]


def write() -> None:
    """Write the table into the page."""
    before, _, after = PAGE.read_text(encoding="utf-8").partition(_HEADING)
    following = after.partition("\n\n")[2]
    PAGE.write_text(before + _HEADING + "\n".join(rows()) + "\n\n" + following, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(write())
