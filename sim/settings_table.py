"""What differs between the settings of several runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

ABSENT = "–"


def differing(trees: Sequence[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """(dotted key, its value in each tree) of all keys that are not the same in all, in the order of the first tree.

    Entries of arrays of tables go by their id. A key that has one value for all robots of a tree, in every tree, is
    told once as `robots.*.key`.
    """
    flat = [dict(_leaves(tree)) for tree in trees]
    keys = list(dict.fromkeys(key for leaves in flat for key in leaves))
    found: dict[str, list[str]] = {}
    for key in keys:
        values = [leaves.get(key, ABSENT) for leaves in flat]
        if len(set(values)) == 1:
            continue
        whole = _for_all(key)
        together = None if whole is None else _common(flat, whole)
        if whole is not None and together is not None:
            found.setdefault(whole, together)
        else:
            found[key] = values
    return list(found.items())


def _leaves(value: Any, path: str = "") -> list[tuple[str, str]]:
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list) and value and all(isinstance(item, dict) and "id" in item for item in value):
        items = {str(item["id"]): item for item in value}.items()
    else:
        return [(path, value if isinstance(value, str) else json.dumps(value))]
    return [leaf for key, below in items for leaf in _leaves(below, f"{path}.{key}" if path else str(key))]


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
