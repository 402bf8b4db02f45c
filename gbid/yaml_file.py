"""Reading YAML so that every complaint can name file, line and column."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

from gbid.errors import UsageError
from gbid.files.text_checksum import is_changed, with_text_checksum

CHANGED = "changed after gbid wrote it: its checksum is not that of its lines"


@dataclass(frozen=True)
class YamlFile:
    """Contents of a YAML file and where each of its values stands.

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
        """Return ``file:line:col`` of a value by its keys; of the nearest one above when it is not there."""
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


def read_yaml(path: Path) -> YamlFile:
    """Read a YAML file whose top level is a mapping.

    Raises
    ------
    UsageError
        When the file is missing, cannot be read, is no YAML (with line and column), or holds something else
        than a mapping.
    """
    try:
        content = path.read_bytes()
        text = content.decode()
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; check its name and folder") from None
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not a text file in UTF-8: {error.reason}; save it as UTF-8") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}; give a file that can") from None
    try:
        tree = YAML(typ="rt").load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        problem = " ".join(str(error.problem or error.context or "not YAML").split())
        raise UsageError(f"{where}: not valid YAML: {problem}; correct it here or on the line before") from None
    except (YAMLError, ValueError) as error:
        raise UsageError(f"{path}: not valid YAML: {' '.join(str(error).split())}; correct it") from None
    if not isinstance(tree, CommentedMap):
        found = "nothing" if tree is None else type(plain(tree)).__name__
        raise UsageError(f"{path}:1:1: expected keys with values, found {found}; write lines as `name: value`")
    notes = (f"{path}: {CHANGED}",) if is_changed(content) else ()
    return YamlFile(path, plain(tree), tree, notes)


def plain(value: Any) -> Any:
    """Return plain dicts, lists, numbers and text from ruamel's annotated ones."""
    if isinstance(value, dict):
        return {plain(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return value


def write_yaml(data: dict[str, Any], path: Path, comment: str = "") -> None:
    """Write plain values, and a comment above them; lists of numbers and pairs on one line, floats with all digits."""
    yaml = YAML(typ="rt")
    yaml.width = 4096
    yaml.indent(mapping=2, sequence=4, offset=2)
    text = StringIO()
    text.write(f"# {comment}\n" if comment else "")
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
