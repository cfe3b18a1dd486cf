"""What differs between the settings of several runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

ABSENT = "–"


def differing(trees: Sequence[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """(dotted key, its value in each tree) of all keys that are not the same in all, in the order of the first tree.

    Entries of arrays of tables go by their id, and which there are is a key of its own. A key that has one value for
    all robots of a tree, in every tree, is told once as `robots.*.key`; one of a robot that only some trees have is not
    told.
    """
    flat = [dict(_leaves(tree)) for tree in trees]
    found: dict[str, list[str]] = {}
    for key in dict.fromkeys(key for leaves in flat for key in leaves):
        whole = _for_all(key)
        if whole is not None:
            together = _common(flat, whole)
            if together is not None:
                found.setdefault(whole, together)
                continue
            group, name, _ = key.split(".", 2)
            if not all(name in leaves.get(group, "").split(", ") for leaves in flat):
                continue
        found[key] = [leaves.get(key, ABSENT) for leaves in flat]
    return [(key, values) for key, values in found.items() if len(set(values)) > 1]


def _leaves(value: Any, path: str = "") -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    if isinstance(value, dict):
        items = value
    elif isinstance(value, list) and value and all(isinstance(item, dict) and "id" in item for item in value):
        items = {str(item["id"]): {key: below for key, below in item.items() if key != "id"} for item in value}
        found.append((path, ", ".join(items)))
    else:
        return [(path, value if isinstance(value, str) else json.dumps(value))]
    for key, below in items.items():
        found += _leaves(below, f"{path}.{key}" if path else str(key))
    return found


def _for_all(key: str) -> str | None:
    parts = key.split(".", 2)
    return f"{parts[0]}.*.{parts[2]}" if parts[0] in ("robots", "targets") and len(parts) == 3 else None


def _common(flat: Sequence[dict[str, str]], whole: str) -> list[str] | None:
    """The value of `robots.*.rest` in each tree; None if some tree has several, or one for some robots only."""
    group, _, rest = whole.partition(".*.")
    found = []
    for leaves in flat:
        ids = dict.fromkeys(key.split(".", 2)[1] for key in leaves if key.startswith(f"{group}."))
        values = {leaves.get(f"{group}.{name}.{rest}", ABSENT) for name in ids}
        if len(values) > 1:
            return None
        found.append(values.pop() if values else ABSENT)
    return found
