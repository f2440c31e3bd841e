"""Derives kuberay.json from KubeRay's definitions: `python derive.py rayclusters.yaml rayjobs.yaml > kuberay.json`.

Of each definition, the OpenAPI schema of version v1 is kept, without `status` and without the keywords that JSON Schema
does not have. An object may have only the keys that the schema names, as in `kubectl --validate=strict`. Equal parts
are written once. See README.md for the source.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

SHORT = 60
"""Longest JSON text of a part that is repeated rather than defined once."""
VERSION = "v1"


def closed(schema: dict[str, Any]) -> dict[str, Any]:
    """A schema as JSON Schema, in which an object has no other keys than those named."""
    is_open = schema.get("x-kubernetes-preserve-unknown-fields", False)
    kept = {key: value for key, value in schema.items() if not key.startswith("x-kubernetes-") and key != "description"}
    if "properties" in kept:
        kept["properties"] = {name: closed(value) for name, value in kept["properties"].items()}
        if not is_open:
            kept.setdefault("additionalProperties", False)
    for key in ("items", "additionalProperties"):
        if isinstance(kept.get(key), dict):
            kept[key] = closed(kept[key])
    return kept


def of_definition(definition: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Kind and JSON Schema of version v1 of a custom resource."""
    spec = definition["spec"]
    (version,) = [version for version in spec["versions"] if version["name"] == VERSION]
    schema = closed(version["schema"]["openAPIV3Schema"])
    del schema["properties"]["status"]
    kind = spec["names"]["kind"]
    schema["properties"] |= {"apiVersion": {"const": f"{spec['group']}/{VERSION}"}, "kind": {"const": kind}}
    schema["required"] = ["apiVersion", "kind", "metadata", "spec"]
    return kind, schema


def shared(schemas: dict[str, Any]) -> dict[str, Any]:
    """The schemas with parts that occur more than once under `definitions`."""
    seen: Counter[str] = Counter()
    definitions: dict[str, Any] = {}
    names: dict[str, str] = {}

    def count(schema: Any) -> None:
        for part in parts(schema):
            seen[json.dumps(part, sort_keys=True)] += 1
            if seen[json.dumps(part, sort_keys=True)] == 1:
                count(part)

    def parts(schema: dict[str, Any]) -> list[dict[str, Any]]:
        found = [*schema.get("properties", {}).values()]
        return found + [schema[key] for key in ("items", "additionalProperties") if isinstance(schema.get(key), dict)]

    def refer(name: str, schema: dict[str, Any]) -> dict[str, Any]:
        text = json.dumps(schema, sort_keys=True)
        if seen[text] < 2 or len(text) <= SHORT:
            return replaced(name, schema)
        if text not in names:
            number = sum(known.partition(".")[0] == name for known in definitions)
            names[text] = f"{name}.{number}" if number else name
            definitions[names[text]] = {}  # takes the name before its parts do
            definitions[names[text]] = replaced(name, schema)
        return {"$ref": f"#/definitions/{names[text]}"}

    def replaced(name: str, schema: dict[str, Any]) -> dict[str, Any]:
        kept = dict(schema)
        if "properties" in kept:
            kept["properties"] = {key: refer(key, value) for key, value in kept["properties"].items()}
        for key in ("items", "additionalProperties"):
            if isinstance(kept.get(key), dict):
                kept[key] = refer(name, kept[key])
        return kept

    for schema in schemas.values():
        count(schema)
    kinds = {kind: replaced(kind, schema) for kind, schema in schemas.items()}
    return kinds | {"definitions": definitions}


def main(paths: list[str]) -> None:
    """Print the derived schemas, one definition a line."""
    result = shared(dict(of_definition(yaml.safe_load(Path(path).read_text())) for path in paths))
    definitions = result.pop("definitions")
    lines = [f'"{kind}": {json.dumps(schema)},' for kind, schema in result.items()]
    lines += [
        '"definitions": {',
        ",\n".join(f'"{name}": {json.dumps(part)}' for name, part in definitions.items()),
        "}",
    ]
    print("\n".join(["{", *lines, "}"]))


if __name__ == "__main__":
    main(sys.argv[1:])
