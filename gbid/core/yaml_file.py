"""YAML files: reading with file, line and column of each value for error messages, changing, writing."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq, TaggedScalar
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

from gbid.core.errors import UsageError
from gbid.core.files import in_one_line, is_changed, with_text_checksum
from gbid.core.notes import DataNote

CHANGED = "changed after gbid wrote it: its checksum does not match its lines"

_LARGEST = 4 << 20  # bytes
_DEEPEST = 50
_BITS = 1024  # of a whole number: a larger one has no float, and Python prints no number of 4300 digits
_ALIASED = 50_000
_VALUES = 50_000  # the parser takes 0.1 to 0.3 ms for each
_COMMENT = re.compile(rb"^[ \t]*#[^'\"\r\n\xc2\xe2]*\n", re.MULTILINE)  # no value, even in a text over several lines
_MERGED = 2_000_000
_BRACKETS = 500
_KEPT = 100_000  # characters of the longest text whose tree is kept


@dataclass(frozen=True)
class YamlFile:
    """Contents of a YAML file, and the position of each value.

    Attributes
    ----------
    path : pathlib.Path
    data : dict
        Plain Python values.
    notes : tuple of str
        Says when the file was changed after gbid wrote it.
    """

    path: Path
    data: dict[str, Any]
    _tree: CommentedMap
    notes: tuple[str, ...] = ()

    def position(self, location: Sequence[str | int]) -> str:
        """Return ``file:line:col`` of a value by its keys; of the closest parent when the value is missing."""
        node: Any = self._tree
        line, column = 0, 0
        for key in location:
            try:
                if isinstance(node, CommentedMap):
                    line, column = node.lc.key(key)
                elif isinstance(node, CommentedSeq) and isinstance(key, int):
                    line, column = node.lc.item(key)
                else:
                    break
                node = node[key]
            except (KeyError, IndexError, TypeError):
                break
        return f"{self.path}:{line + 1}:{column + 1}"


def read_yaml(path: Path, text: str | None = None) -> YamlFile:
    """Read a YAML file whose top level is a mapping, or a text in place of its content.

    Raises
    ------
    UsageError
        When the file is missing, cannot be read, is no YAML (with line and column), or holds something else
        than a mapping.
    """
    try:
        if path.exists() and not path.is_file():
            raise UsageError(f"{path}: is not a file; give the name of one")
        content = path.read_bytes() if text is None else text.encode()
        if len(content) > _LARGEST:
            raise UsageError(f"{path}: larger than {_LARGEST >> 20} MB; put signals and tables into separate files")
        if _open_brackets(content) > _BRACKETS:
            raise UsageError(f"{path}: more than {_BRACKETS} brackets are opened and not closed; close them")
        if (count := sum(map(_COMMENT.sub(b"", content).count, (b"\n", b",", b": ")))) > _VALUES:
            raise UsageError(f"{path}: some {count} values, more than {_VALUES}; put tables into files of their own")
        if content.count(b"<<") * count > _MERGED:
            raise UsageError(
                f"{path}: its merge keys (<<) repeat too many values; write the values where they are needed"
            )
        text = content.decode()
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; check its name and folder") from None
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not a text file in UTF-8: {error.reason}; save it as UTF-8") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}; give a readable file") from None
    try:
        tree = _kept_tree(text) if len(text) < _KEPT else _tree(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        problem = " ".join(str(error.problem or error.context or "not YAML")[:300].split())  # it may repeat values
        raise UsageError(f"{where}: not valid YAML: {problem}; correct it here or on the line before") from None
    except (YAMLError, ValueError) as error:
        raise UsageError(f"{path}: not valid YAML: {' '.join(str(error).split())}; correct it") from None
    except Exception as error:  # the library on values and tags that no file of ours has
        raise UsageError(f"{path}: not valid YAML: {in_one_line(error)}; correct it") from None
    _check_size(path, tree)
    if not isinstance(tree, CommentedMap):
        kind = "nothing" if tree is None else type(plain(tree)).__name__
        raise UsageError(f"{path}:1:1: expected keys with values, found {kind}; write lines as `name: value`")
    notes = (DataNote.CHANGED_BY_HAND(f"{path}: {CHANGED}"),) if is_changed(content) else ()
    return YamlFile(path, plain(tree), tree, notes)


def with_changes(file: YamlFile, changes: Sequence[str]) -> YamlFile:
    """Return the contents of a file with some values replaced (given as YAML text); the file is not changed.

    Parameters
    ----------
    file : YamlFile
        The file.
    changes : sequence of str
        ``KEY=VALUE``, the keys on the way to the value with dots between them, and numbers from 0 for entries of lists.

    Raises
    ------
    UsageError
        When a change is not of this form, its value is no YAML, or its key leads through a value or beyond a list.
    """
    data = plain(file.data)
    for change in changes:
        keys, equals, text = change.partition("=")
        if not keys or not equals:
            raise UsageError(f"--set {change}: expected KEY=VALUE, such as --set controller.feedback.structure=biquad")
        try:
            value = plain(_tree(text))
        except YAMLError:
            raise UsageError(f"--set {change}: the value is not valid YAML; write it as in the file") from None
        _change(data, keys, value)
    return replace(file, data=data)


def text_with(text: str, changes: Sequence[tuple[Sequence[str | int], Any]]) -> str:
    """Return a YAML text with some values replaced; comments, order and quotes of all others stay.

    Parameters
    ----------
    text : str
        A YAML text that `read_yaml` accepts.
    changes : sequence of (location, value)
        Keys on the way to each value, and the value; None removes the key. Missing sections are created.

    Raises
    ------
    UsageError
        When a location leads through a value.
    """
    yaml = YAML(typ="rt")
    yaml.width, yaml.preserve_quotes = 4096, True
    yaml.indent(mapping=2, sequence=4, offset=2)
    tree, written = yaml.load(text), StringIO()
    for location, value in changes:
        try:
            _set(tree, location, value)
        except (KeyError, IndexError, TypeError, AttributeError):
            raise UsageError(f"{'.'.join(map(str, location))}: leads through a value, not a section") from None
    yaml.dump(tree, written)
    return written.getvalue()


def _set(node: Any, location: Sequence[str | int], value: Any) -> None:
    for key in location[:-1]:
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = CommentedMap()
            node[key].fa.set_flow_style()
        node = node[key]
    key = location[-1]
    if value is None:
        node.pop(key, None)
    elif key in node or not node:
        node[key] = _styled(value)
    else:  # before the last key, which holds the empty lines and comments after the section
        node.insert(len(node) - 1, key, _styled(value))


def _change(data: Any, keys: str, value: Any) -> None:
    """Set one value by its keys; missing sections are created."""
    node, rest = data, keys
    while True:
        if isinstance(node, list):
            word, _, rest = rest.partition(".")
            if not word.isdecimal() or int(word) >= len(node):
                raise UsageError(f"--set {keys}: {word!r} is no entry of a list of {len(node)}; count from 0")
            key: Any = int(word)
        elif isinstance(node, dict):  # a name may contain dots
            known = [str(k) for k in node if rest == str(k) or rest.startswith(f"{k}.")]
            key = max(known, key=len, default=rest.partition(".")[0])
            rest = rest[len(key) + 1 :]
            key = next((k for k in node if str(k) == key), key)
        else:
            raise UsageError(f"--set {keys}: {rest!r} is a key within a value; name a key of the file")
        if not rest:
            node[key] = value
            return
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        node = node[key]


def _tree(text: str) -> Any:
    return YAML(typ="rt").load(text)


_kept_tree = lru_cache(maxsize=32)(_tree)  # nobody changes it; a run reads its files often, and the parser is slow


def _open_brackets(content: bytes) -> int:
    """Return the largest number of open brackets: the time of the parser grows with its square."""
    steps = np.zeros(len(content) + 1)
    characters = np.frombuffer(content, np.uint8)
    steps[1:] += (characters == ord("[")) | (characters == ord("{"))
    steps[1:] -= (characters == ord("]")) | (characters == ord("}"))
    return int(np.cumsum(steps).max())


def _check_size(path: Path, tree: Any) -> None:
    """Refuse recursive trees, nested aliases that make a huge tree, and keys that are lists."""
    sizes: dict[int, int] = {}

    def size(node: Any, depth: int) -> int:
        if not isinstance(node, dict | list | tuple | set):
            if isinstance(node, int) and node.bit_length() > _BITS:
                raise UsageError(f"{path}: a whole number beyond 1.8e308; correct it")
            return 1
        if depth > _DEEPEST or sizes.get(id(node)) == 0:
            raise UsageError(f"{path}: values are nested more than {_DEEPEST} deep, or in themselves; write them flat")
        if id(node) not in sizes:
            sizes[id(node)] = 0
            if isinstance(node, dict) and any(isinstance(key, dict | list | tuple | set) for key in node):
                raise UsageError(f"{path}: a key is a list or a mapping; give names as keys")
            total = 1
            for each in (*node, *node.values()) if isinstance(node, dict) else node:
                total += size(each, depth + 1)
            sizes[id(node)] = total
        return sizes[id(node)]

    if size(tree, 0) > _ALIASED + 2 * _VALUES:
        raise UsageError(f"{path}: its aliases repeat too many values; write the values where they are needed")


def plain(value: Any) -> Any:
    """Return ruamel's annotated values as plain dicts, lists, numbers and text; an unknown tag becomes text."""
    if isinstance(value, dict):
        return dict(zip(map(plain, value), map(plain, value.values()), strict=True))
    if isinstance(value, list | tuple):
        return [*map(plain, value)]
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return value.value if isinstance(value, TaggedScalar) else value


def write_yaml(data: dict[str, Any], path: Path) -> None:
    """Write plain values: lists of numbers and pairs on one line, floats with all digits."""
    yaml = YAML(typ="rt")
    yaml.width = 4096
    yaml.indent(mapping=2, sequence=4, offset=2)
    text = StringIO()
    yaml.dump(_styled(data), text)
    path.write_bytes(with_text_checksum(text.getvalue(), ".yaml").encode())


def _styled(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _styled(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        items = CommentedSeq(_styled(v) for v in value)
        if not any(isinstance(v, dict) for v in value):
            items.fa.set_flow_style()
        return items
    if isinstance(value, float) and not math.isfinite(value):
        raise UsageError(f"{value} cannot be written to a model file; give finite numbers")
    if isinstance(value, str) and value.startswith("?"):  # ruamel writes it in a list as it could not read it
        return DoubleQuotedScalarString(value)
    return value
