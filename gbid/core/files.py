"""Files: atomic writing, leftovers of killed processes, checksums, errors of libraries, folder of shared files."""

from __future__ import annotations

import contextlib
import errno
import filecmp
import hashlib
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gbid.core.errors import DataError, GbidError, NoSpaceError, UsageError, origins
from gbid.core.names import one_line

_ENDING = ".part"
_DAY = 86400.0
_OURS = re.compile(r"\.(?P<host>[A-Za-z0-9-]*)~(?P<process>\d+)(-(?P<begun>\d+))?\.[^.]*\.part$")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)  # of the drive, and no item's own fault
_IN_WORDS = re.compile(rf"errno = ({'|'.join(map(str, _FULL))})\b")  # HDF5 tells it in words


@contextlib.contextmanager
def atomic_path(path: Path, overwrite: bool) -> Iterator[Path]:
    """Return a context with a temporary path beside `path`, which replaces `path` when the block succeeds.

    What was written is on the disk before it takes the place: a power cut leaves the old file or the new one, complete.
    A temporary path given by this function is written to as it is.

    Raises
    ------
    UsageError
        When `path` exists and `overwrite` is not set; nothing is touched then.
    NoSpaceError
        When the disk or the quota is full.
    DataError
        When the folder or the file cannot be written for another reason.
    """
    try:
        exists = path.exists()
    except OSError as error:  # a name too long, a folder that may not be entered
        raise _cannot_write(path, error) from None
    if exists and not overwrite:
        raise UsageError(f"{path} exists already; choose another name or ask for overwriting")
    if exists and _OURS.search(path.name):
        yield path
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=_prefix(path.name), suffix=_ENDING)
        os.close(handle)
    except OSError as error:
        raise _cannot_write(path, error) from None
    part = Path(name)
    try:
        yield part
        _let_others_read(part, 0o666)
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.replace(path)  # a power cut may undo this: then the old file is there, and the work is done again
    except OSError as error:
        raise _cannot_write(path, error) from None
    except Exception as error:  # HDF5 may find the disk full only when it closes the file, matplotlib fails after it
        if _no_space(error) is None:
            raise
        raise _cannot_write(path, error) from None
    finally:
        with contextlib.suppress(OSError):  # already moved, or on a failing disk: `remove_stale_parts` removes it later
            part.unlink()


def refuse_links(folder: Path) -> None:
    """Refuse a folder that contains a symbolic link, at any level: writing through a link changes other files.

    The folder itself may be a link.

    Raises
    ------
    DataError
        When there is a link; the text names it.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink():
                raise DataError(
                    f"{entry.path}: is a link, and gbid follows none in a results folder; remove it, or use --results "
                    "to write elsewhere"
                )
            if entry.is_dir():
                refuse_links(Path(entry.path))


@contextlib.contextmanager
def scratch_folder(beside: Path) -> Iterator[Path]:
    """Return a context with a temporary folder beside a path; `remove_stale_parts` finds it if the process is killed.

    Raises
    ------
    DataError
        When the folder cannot be made.
    """
    try:
        beside.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=beside.parent, prefix=_prefix("scratch"), suffix=_ENDING))
    except OSError as error:
        raise _cannot_write(beside.parent, error) from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def atomic_set(folder: Path, overwrite: bool) -> Iterator[Path]:
    """Return a context with a temporary folder whose files all move to `folder` when the block succeeds.

    A new folder appears by one rename. In a folder that is there, the files are renamed one after another, after all of
    them have been written. A process killed in between leaves some of them: the same command writes the others, because
    a file with the bytes to be written is never in the way.

    Raises
    ------
    UsageError
        When a file of the set exists with other bytes and `overwrite` is not set; no file is touched then.
    NoSpaceError, DataError
        As `atomic_path`.
    """
    for place, pattern in ((folder, f".*{_ENDING}"), (folder.absolute().parent, f".scratch.*{_ENDING}")):
        remove_stale_parts(place, pattern)
    with scratch_folder(folder / "new" if folder.is_dir() else folder) as stage:
        try:
            yield stage
        except GbidError as error:  # the user knows the folder, not the one beside it
            raise type(error)(str(error).replace(str(stage), str(folder))) from None
        try:
            _take_places(stage, folder, overwrite)
        except OSError as error:
            raise _cannot_write(folder, error) from None


def _take_places(stage: Path, folder: Path, overwrite: bool) -> None:
    _let_others_read(stage, 0o777)
    if not folder.exists():
        stage.rename(folder)
        return
    changed = [file for file in sorted(stage.iterdir()) if not _same(file, folder / file.name)]
    for file in changed:
        if (folder / file.name).exists() and not overwrite:
            raise UsageError(f"{folder / file.name} exists already; choose another name or ask for overwriting")
    for file in changed:
        file.replace(folder / file.name)


def _let_others_read(path: Path, mode: int) -> None:
    """Give a private temporary file or folder the mode of a new file or folder of this session."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(mode & ~mask)


def _same(one: Path, other: Path) -> bool:
    return other.is_file() and filecmp.cmp(one, other, shallow=False)


def _no_space(error: BaseException) -> BaseException | None:
    """Return the error for a full or failing disk, a full quota or a file above ``ulimit -f``; None for other errors.

    It is the error or what that came from, because a library may fail again on its way out.
    """
    full = (e for e in origins(error) if getattr(e, "errno", None) in _FULL or _IN_WORDS.search(str(e)))
    return next(full, None)


def remove_stale_parts(folder: Path, pattern: str = f"**/.*{_ENDING}") -> list[Path]:
    """Remove temporary files and folders that killed processes left in a folder and below it.

    Only those of gbid, and only those whose process is gone; a file of a process on another host stays for a day.

    Parameters
    ----------
    folder : pathlib.Path
        The folder.
    pattern : str
        Paths to look at.

    Returns
    -------
    list of pathlib.Path
        What was removed.
    """
    removed = find_stale_parts(folder, pattern)
    for path in removed:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):  # gone meanwhile, or on a disk for reading only
                path.unlink()
    return removed


def find_stale_parts(folder: Path, pattern: str = f"**/.*{_ENDING}") -> list[Path]:
    """Return the temporary files and folders of killed processes in a folder and below it."""
    matched = [(path, _OURS.search(path.name)) for path in folder.glob(pattern)]
    return [path for path, m in matched if m and _is_stale(path, m["host"], int(m["process"]), m["begun"])]


def _prefix(name: str) -> str:
    """Return the start of the name of a temporary file, which contains the number of its process."""
    start = _begun(os.getpid())
    return f".{name}.{_host()}~{os.getpid()}{f'-{start}' if start else ''}."


def _begun(process: int) -> str:
    """Return the start time of a process, in ticks since the start of the machine; empty where it is unknown.

    Numbers of processes are given again, and clocks are set. Of a process that has ended, and that its parent has not
    noticed yet (state Z), the answer is empty, too.
    """
    try:
        state, *fields = Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except (OSError, ValueError):
        return ""
    return fields[18] if state != "Z" and len(fields) > 18 else ""


def _is_stale(path: Path, host: str, process: int, start: str | None) -> bool:
    if host == _host() and not (_is_alive(process) and start in (None, "", _begun(process))):
        return True
    try:
        return time.time() - path.stat().st_mtime > _DAY
    except OSError:  # gone meanwhile
        return False


def _is_alive(process: int) -> bool:
    if os.name != "posix":  # where the call below would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:32]


def _cannot_write(path: Path, error: Exception) -> DataError:
    if full := _no_space(error):
        said = _IN_WORDS.search(str(full))
        number = int(said[1]) if said else getattr(full, "errno", None)
        if number in (errno.EIO, errno.EROFS):
            text = "repair or mount the drive and run again, what is complete is kept"
            return NoSpaceError(f"{path}: cannot be written: {os.strerror(number)}; {text}")
        if number == errno.EFBIG:
            text = "the file would be larger than this process may write (ulimit -f)"
            return NoSpaceError(f"{path}: cannot be written: {text}; raise the limit and run again")
        return NoSpaceError(
            f"{path}: cannot be written: No space left in {path.parent}; make room and run again, "
            "what is complete is kept"
        )
    return DataError(f"{path}: cannot be written: {one_line(str(getattr(error, 'strerror', None) or error))}")


# ---- Checksums: SHA-256 of a file as its last line, or of a text file in a comment.
#
# It covers every byte, so it is checked before the HDF5 library sees the file: this library may crash or never return
# on damaged bytes. HDF5 readers ignore what follows the end that a file states.

_LABEL = b"\ngbid sha256 "
_LENGTH = len(_LABEL) + 64 + 1
_END = 100


def with_checksum(content: bytes) -> bytes:
    """Return the bytes of a file followed by their checksum."""
    return b"".join((content, _LABEL, hashlib.sha256(content).hexdigest().encode(), b"\n"))


def has_valid_checksum(path: Path) -> bool:
    """Return whether a file ends with its checksum; raises the errors of `checked_end`."""
    return checked_end(path) is not None


def sha256_of(path: Path) -> str:
    """Return the SHA-256 checksum of a file."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def checked_end(path: Path) -> bytes | None:
    """Return up to 100 bytes before the checksum of a file; None when the file does not end with a checksum.

    Raises
    ------
    DataError
        When the checksum is not that of the bytes.
    OSError
        When the file cannot be read.
    """
    size = path.stat().st_size - _LENGTH
    if size < 0:
        return None
    with path.open("rb") as file:
        file.seek(max(0, size - _END))
        end, last = (end := file.read())[:-_LENGTH], end[-_LENGTH:]
        if not last.startswith(_LABEL):
            return None
        file.seek(0)
        digest = hashlib.sha256()
        while size > 0:
            block = file.read(min(size, 1 << 20))
            if not block:
                break
            digest.update(block)
            size -= len(block)
    if last[len(_LABEL) : -1] != digest.hexdigest().encode():
        raise DataError(
            f"{path}: damaged, or changed by another program: its checksum does not match its bytes; "
            "take a copy of it from a backup, or make it again"
        )
    return end


# A text file may be edited by hand, so a checksum that does not match is no error here: the reader reports it.
# The end of lines does not count, because editors and version control change it.

_COMMENTS = {
    ".yaml": ("# ", ""),
    ".csv": ("# ", ""),
    ".md": ("<!-- ", " -->"),
    ".c": ("/* ", " */"),
    ".h": ("/* ", " */"),
    ".m": ("% ", ""),
    ".mk": ("# ", ""),
}
_BELOW_HELP = ".m"  # MATLAB shows the first comment as the help of the function
_LINE = re.compile(
    rb"^(?:# |% |/\* |<!-- )gbid sha256 ([0-9a-f]{64}) of the other lines(?:| \*/| -->)(?:\n|\Z)", re.MULTILINE
)
_TRACE = re.compile(rb"gbid sha256|[0-9a-f]{31} of the other")  # of a damaged checksum


def with_text_checksum(text: str, ending: str) -> str:
    """Return the text of a file with a new checksum line; a previous checksum line is replaced.

    Parameters
    ----------
    text : str
        The text.
    ending : str
        Ending of the name of the file, as ``".yaml"``. It decides the form of the comment.
    """
    before, after = _COMMENTS[ending]
    text = _LINE.sub(b"", text.encode()).decode()
    line = f"{before}gbid sha256 {_digest(text.encode())} of the other lines{after}\n"
    help_text, gap, code = text.partition("\n\n") if ending == _BELOW_HELP else ("", "", text)
    return f"{help_text}{gap}{line}{code}"


def add_text_checksum(path: Path, ending: str) -> None:
    """Write the checksum into a text file; files whose format has no comments stay unchanged."""
    if ending in _COMMENTS:
        text = path.read_bytes().decode()
        path.write_bytes(with_text_checksum(text, ending).encode())


def is_changed(content: bytes) -> bool:
    """Return whether the checksum in a text file differs from the checksum of its other lines.

    False also for a text without checksum, as people write it.
    """
    content = _plain(content)
    checksum = _LINE.search(content)
    if checksum is None:
        return bool(_TRACE.search(content))
    return checksum[1].decode() != _digest(content[: checksum.start()] + content[checksum.end() :])


def _digest(content: bytes) -> str:
    return hashlib.sha256(_plain(content)).hexdigest()


def _plain(content: bytes) -> bytes:
    return content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").rstrip()


# ---- Errors of libraries about damaged files, turned into an error that names the file.


@contextmanager
def library_errors(path: Path, remedy: str = "save it again") -> Iterator[None]:
    """Return a context in which any error of a library about a file becomes a DataError with the name of the file.

    Errors of gbid and of the system (`OSError`) come out as they are.

    Parameters
    ----------
    path : path
        The file.
    remedy : str
        What the user can do.
    """
    try:
        yield
    except (GbidError, OSError):
        raise
    except MemoryError:
        raise DataError(
            f"{path}: its reader needs more memory than the file can contain or this process may use; {remedy}"
        ) from None
    except Exception as error:
        text = in_one_line(error)
        raise DataError(f"{path}: cannot be read, damaged or of another format ({text}); {remedy}") from None


def refuse_special(path: Path) -> None:
    """Refuse a path that exists but is no regular file: a pipe, a device, a terminal or a folder.

    Raises
    ------
    DataError
        When the path is that of such a thing.
    """
    with contextlib.suppress(OSError):  # opening it tells
        if path.is_file() or not path.exists():
            return
        raise DataError(f"{path}: is not a file, but a directory, a pipe or a device; give the name of a file")


def in_one_line(error: BaseException) -> str:
    """Return type and text of an error on one line; a long text is cut."""
    lines = f"{type(error).__name__}: {error}".splitlines()
    return lines[0][:_LONGEST]


_LONGEST = 300


def share_folder(kind: str) -> Path:
    """Return the folder of the model and experiment files that come with gbid.

    Parameters
    ----------
    kind : str
        ``"models"`` or ``"experiments"``.

    Returns
    -------
    pathlib.Path
        A folder inside the package when gbid was installed from a wheel, the top-level folder in a checkout.

    Raises
    ------
    UsageError
        When neither folder exists.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "_share" / kind, package.parent / kind):
        if folder.is_dir():
            return folder
    raise UsageError(f"the {kind} that come with gbid are missing beside {package}; reinstall gbid")
