"""Tables of all keys of the experiment YAML, in Markdown, from its JSON schema."""

import json

from gbid.experiment.load import experiment_json_schema

schema = experiment_json_schema()
sections = schema["$defs"]
UNITS = {
    "kg_m2": "kg m²",
    "m": "m",
    "s": "s",
    "hz": "Hz",
    "bar": "bar",
    "rpm": "rpm",
    "kg": "kg",
    "n": "N",
    "rad": "rad",
    "percent": "%",
}


def parts(value):
    """A value with what it may contain: alternatives, entries of lists, values by name."""
    inner = [
        *value.get("anyOf", []),
        value.get("items"),
        value.get("additionalProperties"),
        *value.get("patternProperties", {}).values(),
    ]
    return [value, *(each for part in inner if isinstance(part, dict) for each in parts(part))]


def target(value):
    """Name of the section that a value has, alone or in a list or by name; None for a plain value."""
    names = [inner["$ref"].rpartition("/")[2] for inner in parts(value) if "$ref" in inner]
    return names[0] if names else None


def kind(value):
    """Type of a value in words."""
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        return f"[section](#keys-{name.lower()})"
    if "anyOf" in value or "oneOf" in value:
        kinds = [kind(inner) for inner in value.get("anyOf", value.get("oneOf"))]
        return " or ".join(dict.fromkeys(word for word in kinds if word != "null"))
    if "enum" in value:
        return ", ".join(f"`{word}`" for word in value["enum"])
    if "const" in value:
        return f"`{value['const']}`"
    if value.get("type") == "array":
        if "prefixItems" in value:
            return "list: " + ", ".join(kind(inner) for inner in value["prefixItems"])
        return "list of " + kind(value.get("items", {}))
    if value.get("type") == "object":
        inner = value.get("additionalProperties") or next(iter(value.get("patternProperties", {}).values()), None)
        return "by name: " + kind(inner) if isinstance(inner, dict) and inner else "section"
    if "items" in value:
        return "list"
    return {
        "integer": "integer",
        "number": "number",
        "string": "text",
        "boolean": "`true`, `false`",
        "null": "null",
    }.get(value.get("type"), "value")


def unit(key):
    return next((word for end, word in UNITS.items() if key.endswith("_" + end) and key != "k_s"), "")


def default(value):
    if "default" not in value:
        return ""
    word = value["default"]
    if word is None:
        return "none"
    text = json.dumps(word)
    return "its defaults" if isinstance(word, dict) and word else f"`{text}`" if len(text) < 40 else "see `gbid schema`"


def line(value):
    """First sentence of a description."""
    text = value.get("description", "").split("\n")[0].replace("|", "\\|").replace("$", "\\$")
    ends = [
        i
        for i in range(len(text))
        if text[i] == "."
        and text[i + 1 : i + 2] in ("", " ")
        and text[: i + 1].split()[-1] not in ("e.g.", "i.e.", "Eq.", "Sec.", "Eqs.", "Fig.")
    ]
    text = text[: ends[0]] if ends else text
    return text.replace("<", "&lt;").replace("[", "\\[").replace("_", "\\_").replace("*", "\\*") + ("." if text else "")


def table(section, skip=()):
    rows = ["| key | type | unit | default | meaning |", "|---|---|---|---|---|"]
    required = section.get("required", [])
    for key, value in section.get("properties", {}).items():
        if key not in skip:
            given = "" if key in required else default(value) or "none"
            rows.append(f"| `{key}` | {kind(value)} | {unit(key)} | {given} | {line(value)} |")
    return rows


text, seen = ["## The file", "", *table(schema), ""], set()


def walk(section, path):
    """Sections in the order in which the file has them, each with the tables of its parts."""
    for key, value in section.get("properties", {}).items():
        name = target(value)
        goals = [
            each["$ref"].rpartition("/")[2] for part in parts(value) for each in part.get("oneOf", []) if "$ref" in each
        ]
        new = [part for part in goals or [name] if part and part not in seen]
        seen.update(new)
        for part in new:
            title = f"{path} {key}:".strip() if key != "goals" else f"goal: {part.removesuffix('Section')}"
            level = "##" if not path else "###"
            text.extend([f"(keys-{part.lower()})=", f"{level} `{title}`", "", *table(sections[part], ("goal",)), ""])
        for part in new:
            walk(sections[part], f"{path} {key}:".strip())


walk(schema, "")
