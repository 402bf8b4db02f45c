"""Licences of the packages that gbid needs or may use: `make licences` writes the table and the list of components."""

import csv
import json
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution

from places import DOCS, ROOT

TABLE, COMPONENTS = DOCS / "licences.csv", DOCS / "sbom.cdx.json"
_DEVELOPERS = ("test", "docs")
_HEADING = ("package", "installed by", "licence")


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


def listed() -> dict[str, str]:
    """The licences of the packages in the table of the page."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {row["package"]: row["licence"] for row in csv.DictReader(file)}


def rows() -> list[tuple[str, str, str]]:
    """The rows of the table; what is not installed keeps its row."""
    kept = listed()
    results = {package: licence(package) or kept.get(package, "not known") for package in extras()}
    return [(package, extras()[package] or "always", words) for package, words in results.items()]


def pinned() -> dict[str, str]:
    """The versions of the packages that `make run` installs."""
    text = (ROOT / "requirements.txt").read_text(encoding="utf-8").partition("# ---- tests and docs")[0]
    return dict(re.findall(r"^([A-Za-z0-9._-]+)==([^ ;\\]+)", text, re.MULTILINE))


def components() -> dict[str, object]:
    """The list of components (CycloneDX): the pinned packages that gbid needs, with their licences."""
    kept = json.loads(COMPONENTS.read_text(encoding="utf-8")) if COMPONENTS.exists() else {"components": []}
    known = {each["name"]: each["licenses"][0]["license"]["name"] for each in kept["components"]}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": {"type": "library", "name": "gbid"}},
        "components": [
            {
                "type": "library",
                "name": name,
                "version": number,
                "purl": f"pkg:pypi/{name}@{number}",
                "licenses": [{"license": {"name": licence(name) or known.get(name, "not known")}}],
            }
            for name, number in pinned().items()
        ],
    }


def write() -> None:
    """Write the table of the page, and the list of components beside it."""
    COMPONENTS.write_text(json.dumps(components(), indent=1) + "\n", encoding="utf-8")
    table = rows()
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([_HEADING, *table])


if __name__ == "__main__":
    sys.exit(write())
