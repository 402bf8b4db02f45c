"""JSON schema of the experiment YAML, generated from the models that check it."""

from __future__ import annotations

import importlib
import inspect
import re
from typing import Any

from gbid.experiment.schema import ExperimentFile

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SEE = re.compile(r"see `(gbid\.[\w.]+)`")
_UNIT = re.compile(r"_(m|s|rad|hz)$")


def experiment_json_schema() -> dict[str, Any]:
    """Return the JSON schema of the experiment YAML, ready for ``json.dumps``.

    The description of a section is its docstring. When the docstring names the function or class of gbid that takes
    the keys ("see `gbid.fit`"), the description of a key is that of the argument with the same name.

    Returns
    -------
    dict
        JSON schema, draft 2020-12.
    """
    schema = ExperimentFile.model_json_schema(by_alias=True, mode="validation")
    for section in (schema, *schema.get("$defs", {}).values()):
        words = section.get("description", "")
        described = _described_arguments(words)
        section["title"] = section.get("title", "").removesuffix("Section")
        section["description"] = _plain(words)
        for key, value in section.get("properties", {}).items():
            value.pop("title", None)  # pydantic makes it from the key, which the reader sees already
            text = described.get(key) or described.get(_UNIT.sub("", key))
            if text:
                value.setdefault("description", text)
    for key, value in schema["properties"].items():
        schema["properties"][key] = _without_null(value)
    return {"$schema": DIALECT, **schema, "title": "gbid experiment"}


def _without_null(value: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of an optional section without null; the checks refuse an empty section."""
    kinds = [kind for kind in value.get("anyOf", []) if kind != {"type": "null"}]
    if len(kinds) != 1 or "$ref" not in kinds[0]:
        return value
    return {**kinds[0], **{key: word for key, word in value.items() if key not in ("anyOf", "default")}}


def _described_arguments(words: str) -> dict[str, str]:
    """Return the descriptions of the arguments of the function or class that a docstring names, by argument."""
    found = _SEE.search(words)
    if not found:
        return {}
    module, _, name = found[1].rpartition(".")
    text = inspect.getdoc(getattr(importlib.import_module(module), name)) or ""
    section = re.search(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", text, re.MULTILINE | re.DOTALL)
    described: dict[str, str] = {}
    for heading, body in re.findall(
        r"^(\S[^\n]*)\n((?:[ \t]+[^\n]*\n?|\n)+)", section[1] if section else "", re.MULTILINE
    ):
        for argument in heading.partition(" : ")[0].split(","):
            described[argument.strip().lstrip("*")] = _plain(body)
    return described


def _plain(words: str) -> str:
    """Return the text of a docstring without markup, one line per paragraph."""
    paragraphs = inspect.cleandoc(words).strip().split("\n\n")
    text = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    return re.sub(r"`+([^`]*)`+", r"\1", text)
