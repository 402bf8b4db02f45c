"""Tries a built release as users get it: ``python try_release.py DIST [--here] [--offline]``.

The wheel goes into fresh environments without constraints: each Python from 3.11 up that this machine has, once with
the newest and once with the lowest dependencies that ``pyproject.toml`` allows (uv's ``lowest-direct``). In each, a
newcomer's way is gone with the C compiler of the machine and without any, and once with that of the extra ``compiler``.
With ``--here`` that is the Python that runs this, with the compiler of the machine, as after each change.
With ``--offline`` the dependencies are those of the environment that runs this, so that only gbid itself is new.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

IN_SOURCE = (
    *("README.md", "CHANGELOG.md", "LICENSE", "CONTRIBUTING.md", "SECURITY.md", "CITATION.cff", "Makefile"),
    *("requirements.txt", "docs/index.md", "docs/conf.py", "docs/import.md", "tests/conftest.py", "gbid/py.typed"),
    *("models/theisen2016.yaml", "experiments/quickstart.yaml", "tests/benchmarks/fit_speed.py"),
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
gbid.save(result, "fit.h5")
assert gbid.load("fit.h5").parameters == result.parameters
assert result.plot().shape == (4, 2)
gains = gbid.tune(machine, operating_points=[(6.0, 0.0)])
assert gains.success, gains
gbid.save_controller("controller.yaml", gains, sample_time=2e-4, plant="theisen2016")
print("fit:", result.status, "tune:", gains.status)
"""

COMPILER = """
from gbid.core.compiled import CompilerMissingError, find_compiler
try:
    print(find_compiler().version.splitlines()[0])
except CompilerMissingError:
    print("none")
"""


def run(*command: object, cwd: Path, env: Mapping[str, str] | None = None) -> str:
    """Run a command; end with what it said when it fails."""
    done = subprocess.run([str(c) for c in command], cwd=cwd, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def plain_environment(place: Path) -> dict[str, str]:
    """Return the environment variables of a user: no constraints, no packages from elsewhere, an empty kernel cache."""
    ours = ("PIP_CONSTRAINT", "UV_CONSTRAINT", "PYTHONPATH", "CC")
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    return {**kept, "GBID_CACHE_DIR": str(place / "kernels"), "MPLBACKEND": "agg", "COLUMNS": "80"}


def found_pythons() -> dict[tuple[int, int], str]:
    """Return an interpreter of each Python from 3.11 up, by its version: on the path, or one of pyenv."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [sys.executable, *(path for minor in range(11, 20) if (path := shutil.which(f"python3.{minor}")))]
    candidates += map(str, sorted(versions.glob("3.*/bin/python")))
    results: dict[tuple[int, int], str] = {}
    for path in candidates:
        # A shim of pyenv for a version that is not chosen ends with an error.
        said = subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout
        if number := re.match(r"Python (\d+)\.(\d+)\.\d+$", said.strip()):
            version = (int(number[1]), int(number[2]))
            if version >= (3, 11):
                results.setdefault(version, path)
    return dict(sorted(results.items()))


def check_source(archive: Path) -> int:
    """Return the number of files in the source archive; end when one is missing."""
    with tarfile.open(archive) as source:
        held = {name.partition("/")[2] for name in source.getnames()}
    missing = [name for name in IN_SOURCE if name not in held]
    if missing:
        raise SystemExit(f"{archive.name} lacks {', '.join(missing)}")
    return len(held)


def go_the_way(environment: Path, version: str, env: dict[str, str], compiler: str) -> str:
    """Go a newcomer's way with the compiler of the "machine", "none", or that of the "extra"; return what was told."""
    folder = Path(tempfile.mkdtemp(dir=environment))
    python, gbid = environment / "bin" / "python", environment / "bin" / "gbid"
    if compiler != "machine":
        env = {**env, "PATH": "/nonexistent"}
    told = [run(python, "-I", "-c", COMPILER, cwd=folder, env=env)]
    assert compiler == "machine" or (told == ["none"]) == (compiler == "none"), (compiler, told)
    told.append(run(python, "-I", "-c", TRIED, version, cwd=folder, env=env))
    assert version in run(gbid, "--version", cwd=folder, env=env)
    run(gbid, "new", "first", cwd=folder, env=env)
    run(gbid, "check", "first/experiment.yaml", cwd=folder, env=env)
    run(gbid, "run", "first/experiment.yaml", cwd=folder, env=env)
    assert (folder / "first" / "results" / "quickstart" / "report.html").is_file()
    run(gbid, "export", "controller.yaml", "--to", "c", "--output", "c", cwd=folder, env=env)
    sources = list((folder / "c").glob("*.c"))
    assert sources
    if compiler == "machine" and (cc := shutil.which("cc")):
        for source in sources:
            run(cc, "-std=c99", "-Wall", "-Werror", "-c", source.resolve(), cwd=folder / "c", env=env)
    return ", ".join(told)


def try_installed(
    place: Path, wheel: Path, python: str, lowest: bool, compilers: Sequence[str] = ("machine", "none")
) -> None:
    """Install the wheel into a fresh environment with the newest or the lowest dependencies, and use it there."""
    extra = "[compiler]" if "extra" in compilers else ""
    version, env = wheel.name.split("-")[1], plain_environment(place)
    environment = place / "env"
    run(python, "-m", "venv", environment, cwd=place, env=env)
    inside = environment / "bin" / "python"
    wanted = f"{wheel.resolve()}{extra}"
    if lowest:  # pip has no such choice; with wheels only, since the lowest of a new Python are those built for it
        uv = shutil.which("uv") or Path(sysconfig.get_path("scripts")) / "uv"
        lowest_direct = ("--resolution", "lowest-direct", "--only-binary", ":all:")
        with zipfile.ZipFile(wheel) as archive:  # to uv, what a wheel needs is not direct: it is said by name
            (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
            lines = archive.read(metadata).decode().splitlines()
        needed = [
            line.partition(": ")[2] for line in lines if line.startswith("Requires-Dist:") and "extra ==" not in line
        ]
        run(uv, "pip", "install", "--quiet", "--python", inside, *lowest_direct, wanted, *needed, cwd=place, env=env)
    else:
        run(inside, "-m", "pip", "install", "--quiet", "--only-binary", ":all:", wanted, cwd=place, env=env)
    numpy = run(inside, "-c", "import numpy; print(numpy.__version__)", cwd=place, env=env)
    name = f"{run(inside, '--version', cwd=place)}, {'lowest' if lowest else 'newest'} (numpy {numpy}){extra}"
    for compiler in compilers:
        print(f"{name}: {go_the_way(environment, version, env, compiler)}", flush=True)
    shutil.rmtree(environment)


def try_offline(place: Path, wheel: Path) -> None:
    """Install the wheel alone, beside the dependencies of the environment that runs this, and use it."""
    environment = place / "env"
    run(sys.executable, "-m", "venv", environment, cwd=place)
    inside = environment / "bin" / "python"
    packages = Path(run(inside, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=place))
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    run(inside, "-m", "pip", "install", "--quiet", "--no-deps", wheel.resolve(), cwd=place)
    print(go_the_way(environment, wheel.name.split("-")[1], plain_environment(place), compiler="machine"))


def try_release(dist: Path, options: Sequence[str]) -> None:
    """Check the source archive, install the wheel, and use it."""
    (wheel,), (archive,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    held = check_source(archive)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        if "--offline" in options:
            try_offline(place, wheel)
        elif "--here" in options:
            for lowest in (False, True):
                try_installed(place, wheel, sys.executable, lowest, ["machine"])
        else:
            for python in found_pythons().values():
                for lowest in (False, True):
                    try_installed(place, wheel, python, lowest)
            try_installed(place, wheel, sys.executable, False, ["extra"])
    print(f"{wheel.name}: installed and tried; {archive.name}: {held} files")


if __name__ == "__main__":
    try_release(Path(sys.argv[1]), sys.argv[2:])
