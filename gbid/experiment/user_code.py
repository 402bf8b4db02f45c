"""Python files that an experiment names: executed once per process, with a notice about new contents."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from gbid.core.compiled import cache_folder, why_not_trusted
from gbid.core.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import file_digest
from gbid.experiment.schema import ExperimentFile
from gbid.structure import LinearModel
from gbid.structure.kinds import AnyStructure
from gbid.structure.user import execute_file, not_a_model, python_file, structure_in

T = TypeVar("T")

_made: dict[tuple[str, ...], Any] = {}  # modules by path and digest, structures by name as well; or their errors


def file_of(reference: str) -> str:
    """Return the file in ``file.py:name``; empty for other texts."""
    return reference.rpartition(":")[0]


def user_structure_or_model(reference: str, folder: Path) -> AnyStructure | LinearModel:
    """Return the structure or model named as ``file.py:name``; each file content is executed once.

    Raises
    ------
    UsageError
        As `load_structure_or_model`.
    """
    path, name = python_file(reference, folder)
    try:
        key = str(path.absolute()), file_digest(path)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from None
    return _once((*key, name), lambda: structure_in(_once(key, partial(execute_file, path)), path, name))


def user_structure(reference: str, folder: Path) -> AnyStructure:
    """Return the structure named as ``file.py:name``; see `user_structure_or_model`."""
    return not_a_model(user_structure_or_model(reference, folder), *python_file(reference, folder))


def forget_failures() -> None:
    """Allow files whose execution failed to be executed again, for imports that exist now."""
    for key in [key for key, made in _made.items() if isinstance(made, UsageError)]:
        del _made[key]


def _once(key: tuple[str, ...], make: Callable[[], T]) -> T:
    if key not in _made:
        try:
            _made[key] = make()
        except UsageError as error:
            _made[key] = error
    if isinstance(made := _made[key], UsageError):
        raise made.with_traceback(None)
    found: T = made
    return found


_SEEN = "seen-code"


def new_code(experiment: Experiment) -> Iterator[str]:
    """Yield a text for each Python file whose contents are new to this user, and remember the contents.

    The cache folder of the user remembers: a results folder may come from the same stranger as the file. A folder that
    others may write to is not believed.
    """
    folder = cache_folder() / _SEEN
    for path in sorted(_python_files(experiment)):
        try:
            digest = file_digest(path)
        except OSError:
            continue  # it is not executed either
        with suppress(OSError):  # without a memory it is said each time
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not why_not_trusted(folder):
                if (folder / digest).exists():
                    continue
                (folder / digest).touch()
        yield f"{path}: this Python file is executed with your rights (said once for sha256 {digest[:12]}...)"


def _python_files(experiment: Experiment) -> set[Path]:
    """Return the existing Python files that an experiment names."""
    files = set()
    for reference in _references(experiment.spec):
        with suppress(UsageError):  # the check of its section reports it
            files.add(python_file(reference, experiment.folder_of(file_of(reference)))[0])
    return files


def _references(spec: ExperimentFile) -> Iterator[str]:
    """Yield the texts of a YAML that name an object in a Python file."""
    pending: list[Any] = [spec.model_dump()]
    while pending:
        value = pending.pop()
        if isinstance(value, dict):
            pending += value.values()
        elif isinstance(value, list | tuple):
            pending += value
        elif isinstance(value, str) and ".py:" in value:
            yield value
