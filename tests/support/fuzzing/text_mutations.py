"""Mutations of text and of the tree in a YAML file: lines, words, numbers, keys and values."""

from __future__ import annotations

import json
import re
from random import Random
from typing import Any

from ruamel.yaml import YAML

from fuzzing.byte_mutations import mutate_bytes

ODD = (
    "", "nan", ".nan", ".inf", "-.inf", "1e999", "-1e999", "1e-999", "-0.0", "0", "-1", "1e308", "5e-324", "9" * 5000,
    "0x1F", "0b101", "0o17", "1_000", "1:30:00", "2001-13-45", "2001-01-01T25:00:00Z", "<<", "=", "~", "null", "true",
    "!!python/object/apply:os.system ['true']", "!!binary xx", "!!float abc", "!!int x", "!!set {a, b}", "!!omap []",
    "!!timestamp 99", "&a [*a]", "*none", "&a", "{", "}", "[", "]", "[[[[", "'", '"', "|", ">", "%YAML 9.9", "---",
    "...", "@", "`", "\t", "- - -", "? [a]", "!", "!!", "{a: 1, a: 2}", "[" * 3000, "{a: " * 2000, "'\x1b[31m'",
    '"\\x1b[2J"', '"\\0"', '"\\uD800"', "\x00", "\x07", "\x85", "\u2028", "\ufeff", "\u202e", "é", "🌀", "a" * 20000,
    "/etc/passwd", "../../x", "/dev/zero", "CON", "a: b: c", "1e5", "1.0e+500", "1" * 400 + ".0", "0.1", "kappa_x",
    "{k: 6,0e4}", "[6,0e4]", "0x" + "f" * 5000, "a" * 300, "{float: {float: 1}}",
    "1000000000", "10000000", "-1000000000", "1e15", "1e-15", '"1"', "[1, 2]", "{x: 1}", "[]", "{}",
)  # fmt: skip
_WORD = re.compile(r"[^\s,:;\[\]{}#\"']+")
_BOMB = "\n".join(f"b{i}: &b{i} [{', '.join([f'*b{i - 1}'] * 9)}]" if i else "b0: &b0 [x, x]" for i in range(12))


def mutate_text(random: Random, content: bytes) -> bytes:
    """Return a text with one to three mutations."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        content = random.choice(TEXT_MUTATIONS)(random, content or b"a")
    return content


def mutate_tree(random: Random, content: bytes) -> bytes:
    """Return a YAML file whose tree was changed, without its checksum; two thirds of them change as text."""
    if random.randrange(3):
        return mutate_text(random, content)
    tree = _tree(content)
    for _ in range(random.choice((1, 1, 2))):
        _change(random, tree)
    text = json.dumps(tree, indent=random.choice((None, 1)))
    return text.replace('"@odd', "").replace('odd@"', "").encode(errors="surrogatepass")


_TREES: dict[bytes, Any] = {}


def _tree(content: bytes) -> Any:
    if content not in _TREES:
        _TREES[content] = YAML(typ="safe", pure=True).load(content.decode())
    return json.loads(json.dumps(_TREES[content]))


def _change(random: Random, tree: Any) -> None:
    """Change one entry of nested dicts and lists."""
    place = tree
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            return
        key = random.choice(keys)
        if isinstance(place[key], dict | list) and place[key] and random.randrange(4):
            place = place[key]
            continue
        break
    what = random.randrange(6)
    if what == 0:
        del place[key]
    elif what == 1 and isinstance(place, dict):
        place[random.choice(("x", "", "name", "\x1b[31m", "a" * 300, "<<", "value"))] = place[key]
    elif what == 1 and isinstance(place, list):
        place.extend(place[key : key + 1] * random.choice((1, 50)))
    elif what == 2:
        place[key] = random.choice(
            (None, True, [], {}, [None], "", -1, 0, 1, 10**400, 1e308, -1e-320, "x" * 999, [[]], {"": 1})
        )
    elif what == 3 and isinstance(place[key], int | float) and not isinstance(place[key], bool):
        place[key] = place[key] * random.choice((-1, 0, 1.0000001, 1e9, 1e-9, 10**7))
    else:
        odd = random.choice(ODD)
        place[key] = f"@odd{odd}odd@" if odd.isprintable() and len(odd) < 100 and '"' not in odd else odd


def _replace_word(random: Random, content: bytes) -> bytes:
    text = content.decode(errors="surrogateescape")
    words = list(_WORD.finditer(text[:200_000]))
    if not words:
        return content + b"a"
    old = random.choice(words)
    new = random.choice(ODD) if random.randrange(2) else random.choice(words)[0]
    return (text[: old.start()] + new + text[old.end() :]).encode(errors="surrogatepass")


def _change_digit(random: Random, content: bytes) -> bytes:
    places = [i for i, byte in enumerate(content[:100_000]) if 48 <= byte <= 57]
    if not places:
        return content + b"1"
    place = random.choice(places)
    return content[:place] + str(random.randrange(10)).encode() + content[place + 1 :]


def _change_lines(random: Random, content: bytes) -> bytes:
    lines = content.split(b"\n")
    i, j = random.randrange(len(lines)), random.randrange(len(lines))
    what = random.randrange(5)
    if what == 0:
        del lines[i]
    elif what == 1:
        lines.insert(i, lines[j])
    elif what == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif what == 3:
        lines[i] = random.choice((b" ", b"  ", b"\t", b"- ", b"")) + lines[i].lstrip()
    else:
        lines = lines[:i]
    return b"\n".join(lines)


def _encode(random: Random, content: bytes) -> bytes:
    text = content.decode(errors="replace")
    how = random.randrange(5)
    if how == 0:
        return text.encode("utf-16")
    if how == 1:
        return text.replace("e", "é").encode("latin-1", "replace")
    if how == 2:
        return b"\xef\xbb\xbf" + content
    return content.replace(b"\n", random.choice((b"\r\n", b"\r", b"\n\n", b"\0")))


def _add_bomb(random: Random, content: bytes) -> bytes:
    return content + b"\n" + random.choice((_BOMB, "x: [" * 500, "x: " + "a" * 100_000)).encode() + b"\n"


TEXT_MUTATIONS = (
    *(_replace_word, _replace_word, _replace_word, _change_digit, _change_digit, _change_lines, _change_lines),
    *(_encode, mutate_bytes, mutate_bytes),
    *((_add_bomb,)),
)
