"""Write requirements.txt: the newest versions, with the digests of all their files, of what gbid and its tests need.

`python tests/support/pins.py [--upgrade]` keeps the versions of the present list where it can. Above `TOOLS` stands
what `make run` installs, below it what the tests and pages need besides.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from places import ROOT

LIST = ROOT / "requirements.txt"
TOOLS = "# ---- tests and docs"
HEAD = """\
# All versions that gbid is developed with, and the digests of their files, for all systems; `make pins` writes it.
# `make run` installs the first part, `make test` and `make docs` all of it, with pip's --require-hashes --no-deps.
"""
EDITABLE = "editables"
"""What hatchling asks for to install gbid from its folder."""
NOT_INSTALLED = "google-generativeai ; python_version < '3'\n"
"""Clients of a service that a dependency of ROSS asks for, and no test or page needs."""


def canonical(name: str) -> str:
    """Return the name of a package as an index writes it."""
    return re.sub("[-_.]+", "-", name).lower()


def compiled(*what: str, keep: str) -> dict[str, str]:
    """Return the lines of each package that resolves some requirements and extras of the project."""
    with tempfile.TemporaryDirectory() as where:
        override, output = Path(where) / "overrides.txt", Path(where) / "requirements.txt"
        override.write_text(NOT_INSTALLED, encoding="utf-8")
        output.write_text(keep, encoding="utf-8")
        build = Path(where) / "build.in"
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
        build.write_text("\n".join([*project["build-system"]["requires"], EDITABLE]), encoding="utf-8")
        command = ["uv", "pip", "compile", "pyproject.toml", str(build), *what, "--quiet", "--no-header"]
        command += ["--universal", "--generate-hashes", "--python-version", "3.11", "--no-annotate"]
        subprocess.run([*command, "--override", str(override), "--output-file", str(output)], cwd=ROOT, check=True)
        text = output.read_text(encoding="utf-8")
    return {re.split("[ =]", block, maxsplit=1)[0]: block for block in re.findall(r"^\w.*\n(?: .*\n)*", text, re.M)}


def main() -> None:
    keep = "" if "--upgrade" in sys.argv else LIST.read_text(encoding="utf-8")
    everything = compiled("--extra", "test", "--extra", "docs", keep=keep)
    needed = compiled(keep="".join(everything.values()))
    tools = "".join(block for name, block in everything.items() if name not in needed)
    LIST.write_text(f"{HEAD}{''.join(needed.values())}{TOOLS}\n{tools}", encoding="utf-8")


if __name__ == "__main__":
    main()
