"""Page of `gbid open`: a folder of recordings becomes an experiment; each choice is a value of its YAML."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args

from markupsafe import Markup

from gbid.core.compiled import CompilerMissingError, find_compiler
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.files import atomic_path
from gbid.core.index import version_of
from gbid.core.units import SIGNALS
from gbid.core.yaml_file import read_yaml, text_with
from gbid.experiment.draft import QUESTIONS, DraftOptions, UnansweredError, draft_experiment, measured_files
from gbid.experiment.experiment import Experiment
from gbid.experiment.exporting import find_exports, write_exports
from gbid.experiment.load import check_experiment, load_experiment
from gbid.experiment.recordings import mapping_of
from gbid.experiment.schema import Kind
from gbid.export.targets import ExportRequest
from gbid.recording.importing import list_channels
from gbid.recording.readers import FileChannel
from gbid.report.page import environment, page_part
from gbid.serve.plots import plots_of
from gbid.serve.server import HTML, JSON, Live, Server, bench_script, own_part, result_pages

_PLOTS = 256  # of so many files and mappings the plots are kept: some 0.2 MB each
_SAID = 4000  # characters of the end of what a run prints


class Bench:
    """Folder of recordings and its experiment, as a page shows them; the experiment's YAML is the only state.

    Parameters
    ----------
    folder : pathlib.Path
        The recordings; they are never changed.
    target : pathlib.Path
        Folder of the experiment.
    announce : callable
        See `gbid.experiment.load.load_experiment`.

    Raises
    ------
    UsageError
        When there is no such folder.
    """

    def __init__(self, folder: Path, target: Path, announce: Callable[[str], None]) -> None:
        if not folder.is_dir():
            raise UsageError(f"no folder {folder}; name the folder of the measured files")
        self.folder, self.path, self._announce = folder, target / "experiment.yaml", announce
        self._reading, self._checking, self._running = threading.Lock(), threading.Lock(), threading.Lock()
        self._plots, self._channels = lru_cache(_PLOTS)(self._plots_of), lru_cache(_PLOTS)(self._channels_of)
        self._experiment = lru_cache(4)(self._load)
        self._live: Live | None = None
        self._run: subprocess.Popen[bytes] | None = None
        self._said: Any = None

    def pages(self) -> dict[str, Any]:
        """Return the answers to GET: the page, what is there now, and the pages of results."""
        return {
            "": (HTML, lambda _: self._page()),
            "now": (JSON, lambda _: json.dumps(self.now())),
            **result_pages(self._results),
        }

    def actions(self) -> dict[str, Callable[..., Any]]:
        """Return the answers to POST, from the keys of a document to a document."""
        names = ("plots", "draft", "change", "check", "save", "run", "cancel", "export")
        return {name: getattr(self, name) for name in names}

    def _page(self) -> str:
        return (
            environment(own_part)
            .get_template("bench.html.j2")
            .render(
                name=self.folder.resolve().name,
                path=self.path,
                about={
                    "kinds": get_args(Kind),
                    "questions": QUESTIONS,
                    "names": {name: known.long_name for name, known in SIGNALS.items()},
                },
                style=Markup(page_part("style.css") + own_part("bench.css")),
                script=bench_script(),
            )
        )

    def _results(self) -> Live:
        if self._live is None:
            self._live = Live(self.path, announce=self._announce)
        return self._live

    # ---- What is there.

    def now(self) -> dict[str, Any]:
        """Return the files with their versions, the YAML of the experiment with its digest, and the state of a run."""
        files = {}
        for path in measured_files(self.folder):
            with suppress(OSError):  # gone meanwhile
                files[path.name] = version_of(path)[1:]
        text = self._text()
        return {"files": files, "text": text, "saved": _digest(text), "run": self._progress()}

    def _text(self) -> str:
        try:
            return self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return ""
        except (OSError, ValueError) as error:
            raise DataError(f"{self.path}: cannot be read: {error}") from None

    def plots(self, file: str, text: str = "") -> dict[str, Any]:
        """Return the plots of a file by the mapping that a YAML text has for it; see `gbid.serve.plots.plots_of`."""
        path = self.folder / Path(file).name
        mapping, kind, why = None, "excited", ""
        if text:
            try:
                files = self._experiment(text, version_of(self.folder)).imports.files
                for entry in (entry for entry, _ in files if entry.file == path.name):
                    mapping, kind = mapping_of(entry), entry.kind
            except GbidError as error:
                why = str(error)
        try:
            version = version_of(path)
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
        with self._reading:  # one file at a time in memory
            shown = self._plots(path, version, json.dumps(mapping), kind)
        own = {"section": self._section(text, path.name), "machine": self._data(text).get("machine") or {}}
        return {**shown, **own, "fault": shown["fault"] or why}

    def _plots_of(self, path: Path, version: tuple[int, ...], mapping: str, kind: Kind) -> dict[str, Any]:
        return plots_of(path, self._channels(path, version), json.loads(mapping), kind)

    def _channels_of(self, path: Path, _version: tuple[int, ...]) -> list[FileChannel]:
        return list_channels(path)

    def _load(self, text: str, _version: tuple[int, ...]) -> Experiment:
        return load_experiment(self.path, text=text, form_only=True)

    def _sections(self, text: str) -> dict[tuple[str | int, ...], Any]:
        """Return the mappings of a YAML text by location."""
        section = self._data(text).get("import")
        section = section if isinstance(section, dict) else {}
        listed = section.get("recordings")
        found: dict[tuple[str | int, ...], Any] = {
            ("import", "recordings", i): each for i, each in enumerate(listed if isinstance(listed, list) else ())
        }
        return {**found, **{("import", key): section[key] for key in ("folder", "table") if section.get(key)}}

    def _section(self, text: str, file: str) -> dict[str, Any] | None:
        """Return the mapping of a file in a YAML text, with its location; None without one."""
        for location, section in self._sections(text).items():
            if isinstance(section, dict) and (location[1] != "recordings" or section.get("file") == file):
                return {"location": location, **section}
        return None

    def _data(self, text: str) -> dict[str, Any]:
        """Return the values of a YAML text; none for a text that is no YAML, which `check` tells."""
        with suppress(UsageError):
            return read_yaml(self.path, text).data if text else {}
        return {}

    # ---- Choices.

    def draft(self, answers: Sequence[tuple[str, str]], skip_broken: bool = False) -> dict[str, Any]:
        """Return the drafted YAML with its notes, or the open questions with their reasons, as `gbid init` does."""
        options = DraftOptions(self.folder, skip_broken=skip_broken, ask=True)
        for option, text in answers:
            if option not in (*QUESTIONS, "pattern", "controller"):
                raise UsageError(f"no question {option!r}; choose from {', '.join(QUESTIONS)}")
            options = options.answered(option, text)
        try:
            draft = draft_experiment(options, self.path.parent)
            self.path.parent.mkdir(parents=True, exist_ok=True)  # the data folder is relative to it
        except UnansweredError as error:
            return {"open": error.reasons, "columns": error.columns}
        return {"text": draft.text, "notes": draft.notes, "columns": draft.columns}

    def change(self, text: str, key: list[str | int], value: Any, file: str = "") -> dict[str, Any]:
        """Return a YAML text with one value changed: by its location, or by its key in the mapping of a file.

        Mappings of other files that have had the same value there get the new one, too.
        """
        read_yaml(self.path, text)  # refuses what is no YAML
        places: list[tuple[str | int, ...]] = [()]
        if file:
            sections, own = self._sections(text), self._section(text, file)
            if own is None:
                raise UsageError(f"{self.path}: no mapping for {file}; add the file to the section import")
            places = [at for at, each in sections.items() if _at(each, key) == _at(own, key)]
        return {"text": text_with(text, [((*place, *key), value) for place in places])}

    def check(self, text: str, quick: bool = False) -> dict[str, Any]:
        """Return what `gbid check` says of a YAML text."""
        try:
            experiment = load_experiment(self.path, text=text, announce=self._announce)
            with nullcontext() if quick else self._checking:  # the signals of one text at a time
                problems, code, _ = check_experiment(experiment, quick)
        except GbidError as error:
            return {"problems": str(error).splitlines(), "code": error.exit_code}
        counts = {"recordings": len(experiment.recordings), "fits": len(experiment.spec.fits)}
        return {"problems": problems, "code": code, **counts}

    def save(self, text: str, saved: str) -> dict[str, Any]:
        """Write a YAML text; refused where the file is not the one that the page has read.

        Raises
        ------
        UsageError
            When another page or program has changed the file.
        """
        if saved != _digest(self._text()):
            raise UsageError(f"{self.path}: changed since this page has read it; load it anew, or save over it")
        with atomic_path(self.path, overwrite=True) as part:
            part.write_text(text, encoding="utf-8")
        return {"saved": _digest(text)}

    # ---- Run and export.

    def run(self) -> dict[str, Any]:
        """Start `gbid run`; results that are there are kept, so that a second run goes on where the first one ended."""
        with self._running:
            if self._run is None or self._run.poll() is not None:
                self.close()
                self._said = tempfile.TemporaryFile()  # noqa: SIM115  a run outlives a killed server
                command = [sys.executable, "-m", "gbid", "run", str(self.path.resolve()), "--retry"]
                out = {"stdout": self._said, "stderr": subprocess.STDOUT}
                self._run = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True, **out)
        return self._progress()

    def cancel(self) -> dict[str, Any]:
        """Interrupt the run, as Ctrl-C does."""
        if self._run is not None and self._run.poll() is None:
            self._run.send_signal(signal.SIGINT)
        return self._progress()

    def _progress(self) -> dict[str, Any]:
        """Return whether a run of this server goes on, its exit code, and the end of what it has printed."""
        if self._run is None:
            return {"running": False, "code": None, "said": ""}
        code, size = self._run.poll(), os.fstat(self._said.fileno()).st_size
        said = os.pread(self._said.fileno(), _SAID, max(0, size - _SAID)).decode(errors="replace")
        return {"running": code is None, "code": code, "said": said}

    def close(self) -> None:
        """End the run, and wait for it."""
        self.cancel()
        if self._run is not None:
            self._run.wait()
            self._said.close()
            self._run = None

    def export(self) -> dict[str, Any]:
        """Write the controllers as C, as `gbid export` does, and compile and run their test if there is a compiler."""
        exports = find_exports(str(self.path), announce=self._announce)
        files = write_exports(exports, "c", ExportRequest(exports.folder, overwrite=True))
        said = [*exports.notes, *(f"left out: {text}" for text in exports.left_out)]
        for test in (path for path in files if path.name.endswith("_selftest.c")):
            said.append(_tried(test))
        return {"files": [str(path) for path in files], "said": said}


def _tried(test: Path) -> str:
    """Return what the compiled test of an exported controller says."""
    source = test.with_name(test.name.replace("_selftest", ""))
    try:
        compiler = find_compiler().command
    except CompilerMissingError as error:
        return f"{source.name}: not compiled: {error}"
    with tempfile.TemporaryDirectory() as folder:
        program, main = f"{folder}/selftest", f"-D{source.stem.upper()}_SELFTEST_MAIN"
        command = [*compiler, "-std=c99", main, str(test), str(source), "-lm", "-o", program]
        for step in (command, [program]):
            done = subprocess.run(step, capture_output=True, text=True, check=False)
            if done.returncode:
                return f"{source.name}: {' '.join(step[:1])} failed: {(done.stderr or done.stdout).strip()}"
    return f"{source.name}: compiled; its test says: {done.stdout.strip()}"


def _digest(text: str) -> str:
    return sha256(text.encode()).hexdigest()


def _at(section: Any, keys: list[str | int]) -> Any:
    """Return the value at a location; None where there is none."""
    for key in keys:
        section = section.get(key) if isinstance(section, dict) else None
    return section


def open_bench(folder: Path, target: Path, port: int, announce: Callable[[str], None]) -> tuple[Server, Bench]:
    """Return the server of the page for a folder, on this machine only, and what it shows.

    Raises
    ------
    UsageError
        When there is no such folder, or when the port is not free.
    """
    bench = Bench(folder, target, announce)
    return Server(port, bench.pages(), bench.actions()), bench
