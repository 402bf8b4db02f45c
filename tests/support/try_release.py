"""Tries a built release: ``python try_release.py DIST``, or with ``--fresh`` with its dependencies from the index, too.

The wheel is installed into a new environment outside of the checkout. Without ``--fresh`` the dependencies are those of
the environment that runs this, so that only gbid itself is new.
"""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import tarfile
import tempfile
from pathlib import Path

IN_SOURCE = (
    *("README.md", "CHANGELOG.md", "LICENSE", "CONTRIBUTING.md", "SECURITY.md", "CITATION.cff", "Makefile"),
    *("constraints.txt", "docs/index.md", "docs/conf.py", "docs/first-hour.md", "tests/conftest.py", "gbid/py.typed"),
    *("models/theisen2016.yaml", "experiments/quickstart.yaml", "benchmarks/fit_speed.py"),
)
"""Files that the source archive must have."""

TRIED = """
from importlib.metadata import version
from pathlib import Path
import sys

import numpy as np
import gbid

assert Path(gbid.__file__).is_relative_to(sys.prefix), gbid.__file__
assert version("gbid") == gbid.__version__ == sys.argv[1], (version("gbid"), gbid.__version__)
machine = gbid.load_model("theisen2016")
u = np.random.default_rng(1).choice([-1e-6, 1e-6], 4000)[:, None].repeat(2, axis=1)
u[:, 1] = np.roll(u[:, 1], 7)
bearing = machine.at(6.0, 0.0)
recording = gbid.Recording({"u": u, "p": bearing.simulate(u, 2e-4, intersample="foh")}, 2e-4)
result = gbid.fit(gbid.RotorBearing(), recording)
assert abs(result.model.modes()[0][0] - bearing.modes()[0][0]) < 0.5, result
assert result.plot().shape == (4, 2)
print("fit:", result.status)
"""


def run(*command: object, cwd: Path) -> str:
    """Run a command; end with what it said when it fails."""
    done = subprocess.run([str(c) for c in command], cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def try_release(dist: Path, fresh: bool) -> None:
    """Check the source archive, install the wheel, and use it."""
    (wheel,), (archive,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    version = wheel.name.split("-")[1]
    with tarfile.open(archive) as source:
        held = {name.partition("/")[2] for name in source.getnames()}
    missing = [name for name in IN_SOURCE if name not in held]
    if missing:
        raise SystemExit(f"{archive.name} lacks {', '.join(missing)}")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        run(sys.executable, "-m", "venv", place / "env", cwd=place)
        python = place / "env" / "bin" / "python"
        if not fresh:
            packages = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=place))
            (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
        run(python, "-m", "pip", "install", "--quiet", *([] if fresh else ["--no-deps"]), wheel.resolve(), cwd=place)
        print(run(python, "-I", "-c", TRIED, version, cwd=place))
        gbid = place / "env" / "bin" / "gbid"
        assert version in run(gbid, "--version", cwd=place)
        run(gbid, "new", place / "first", cwd=place)
        (experiment,) = (place / "first").glob("*.yaml")
        run(gbid, "check", experiment, cwd=place)
    print(f"{wheel.name}: installed and tried; {archive.name}: {len(held)} files")


if __name__ == "__main__":
    try_release(Path(sys.argv[1]), "--fresh" in sys.argv)
