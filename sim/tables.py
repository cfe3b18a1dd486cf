"""Tables of a summary."""

from __future__ import annotations

from typing import Any

from sim.error_plots import label
from sim.page import number, section, size, table, verdict

WIDE = 9
"""So many columns of extremes fit beside each other."""


def robots(summary: dict[str, Any]) -> str:
    """Figures of each robot, of the fleet and of the centralized filter."""
    velocity = any("velocity_rmse_mps" in entry for entry in summary["robots"].values())
    header = ["", "position RMSE [m]", "max [m]", "at the end [m]", "heading RMSE [rad]"]
    header += ["velocity RMSE [m/s]"] if velocity else []
    ended = summary["runtime"] != "virtual" or any(summary["exit"].values())
    header += ["ANEES", "inside 3σ", *(["exit"] if ended else [])]

    def row(name: str, entry: dict[str, Any], code: str) -> list[str]:
        cells = [name, number(entry.get("position_rmse_m"), 3), number(entry.get("position_error_max_m"), 2)]
        cells += [number(entry.get("final_position_error_m"), 2), number(entry.get("heading_rmse_rad"), 3)]
        cells += [number(entry.get("velocity_rmse_mps"), 3)] if velocity else []
        cells += [number(entry.get("anees"), 2), number(entry.get("containment_3sigma"), 3)]
        return [*cells, code] if ended else cells

    rows = [
        row(f"{index}|{name}", entry, str(summary["exit"].get(name, "–")))
        for index, (name, entry) in enumerate(summary["robots"].items())
    ]
    classes = [""] * len(rows)
    totals = [("fleet", "fleet", "total")]
    if summary["trials"] > 1:
        totals += [("fleet, median trial", "median", "aside")]
        totals += [("fleet, lost trials included", "all", "aside")] if summary["lost"] else []
    totals.append(("centralized filter", "bound", "aside"))
    for name, key, mark in totals:
        if summary.get(key):
            rows.append(row(name, summary[key], ""))
            classes.append(mark)
    return table(header, rows, classes)


def targets(summary: dict[str, Any]) -> str:
    """Figures of each track, and of the centralized filter's."""
    owned = [entry for owners in summary["targets"].values() for entry in owners.values()]
    optional = [
        (key, text)
        for key, text in (("heading_rmse_rad", "heading RMSE [rad]"), ("velocity_rmse_mps", "velocity RMSE [m/s]"))
        if any(key in entry for entry in owned)
    ]
    header = ["", "position RMSE [m]", *(text for _, text in optional), "ANEES", "inside 3σ"]
    names = list(summary["robots"])
    bound = (summary.get("bound") or {}).get("targets", {})
    rows, classes = [], []
    for target, owners in summary["targets"].items():
        lines = [(f"{names.index(name)}|{target} by {name}", entry, "") for name, entry in owners.items()]
        if target in bound:
            lines.append((f"{target} by the centralized filter", bound[target], "aside"))
        for name, entry, mark in lines:
            middle = [number(entry.get(key), 3) for key, _ in optional]
            ends = [number(entry["anees"], 2), number(entry["containment_3sigma"], 3)]
            rows.append([name, number(entry["position_rmse_m"], 3), *middle, *ends])
            classes.append(mark)
    return table(header, rows, classes)


def motion(summary: dict[str, Any]) -> str:
    """Where robots were in relation to each other; empty where nobody knows, and for a run from before it was kept."""
    found = summary.get("motion", {})
    if found.get("speed_mps") is None:
        return ""
    collisions = "collisions" if summary["trials"] == 1 else "collisions per trial"
    header = [collisions, "smallest distance [m]", "time connected", "robots that see a target", "mean speed [m/s]"]
    shares = [found["connected_share"], found["target_seen_share"]]
    row = [number(found["collisions"], 0 if summary["trials"] == 1 else 2), number(found["min_distance_m"], 2)]
    row += ["–" if share is None else f"{100.0 * share:.0f} %" for share in shares]
    if found.get("formation_error") is not None:
        header[4:4] = ["distance to the slot", "formation kept", "smallest distance to the target [m]"]
        row += [f"{100.0 * found[key]:.0f} %" for key in ("formation_error", "formation_kept_share")]
        row.append(number(found["target_min_distance_m"], 2))
    text = f"A collision: two robots come nearer than {found['collision_m']:g} m. Connected: all hear each other, "
    text += "if not directly then through others, as far as the radio reaches. Shares and speed are over the window."
    if len(header) > 5:
        text += " Distances to slots are shares of the formation's radius; it is kept while nobody is off by 25 %."
    return section("Motion", table(header, [[*row, number(found["speed_mps"], 2)]]), text)


# --- extremes ----------------------------------------------------------------------------------------------


def extreme(entry: dict[str, Any], name: str, trials: int) -> str:
    """Smallest and largest error of a component; over trials the median and the worst of the largest."""
    first, last = ("error_max", "error_worst") if trials > 1 else ("error_min", "error_max")
    values = [(entry.get(key) or {}).get(name) for key in (first, last)]
    return "–" if values == [None, None] else " / ".join(number(value, 2) for value in values)


def extremes(summary: dict[str, Any]) -> str:
    """Extremes of each component: a row per robot, its own state and its track of each target beside each other.

    If that is too wide, a table per target. A section of its own, empty for a run from before they were kept.
    """
    own = summary["robots"]
    if not all("error_min" in entry for entry in own.values()):
        return ""
    parts = [("own state", own), *((f"track of {target}", owners) for target, owners in summary["targets"].items())]
    widths = [len(_components(items)) for _, items in parts]
    together = [parts] if sum(widths) <= WIDE else [[part] for part in parts]
    what = "smallest / largest in the window" if summary["trials"] == 1 else "median / worst over trials of the largest"
    tables = []
    for some in together:
        groups = [("", 1), *((name, len(_components(items))) for name, items in some)]
        header = ["", *(label(name) for _, items in some for name in _components(items))]
        rows = [
            [
                f"{index}|{robot}",
                *(
                    extreme(items.get(robot, {}), name, summary["trials"])
                    for _, items in some
                    for name in _components(items)
                ),
            ]
            for index, robot in enumerate(own)
        ]
        tables.append(table(header, rows, groups=groups))
    return section("Extremes", "".join(tables), f"Absolute error of each component, {what}.")


def _components(items: dict[str, dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for entry in items.values() for name in entry.get("error_max", {})))


# --- measurements and messages -----------------------------------------------------------------------------


def innovations(summary: dict[str, Any]) -> str:
    """Mean normalized innovation squared per robot and kind of measurement. A section of its own."""
    nis = {name: entry.get("nis", {}) for name, entry in summary["robots"].items()}
    kinds = sorted({kind for own in nis.values() for kind in own})
    if not kinds:
        return ""
    rows = [
        [f"{place}|{name}", *(_marked(own.get(kind)) for kind in kinds)]
        for place, (name, own) in enumerate(nis.items())
    ]
    rows.append(["ideal", *("1" for _ in kinds)])
    text = (
        "Mean normalized innovation squared per degree of freedom: how far measurements lie from what was expected of "
        "them. Far above 1, in colour, the filter is too sure of itself or the sensor worse than configured; far below "
        "1 it expects worse than what comes, as it must where correlations are unknown."
    )
    header = ["", *(kind.replace("_", " ").replace("+", " + ") for kind in kinds)]
    return section("Innovations by sensor", table(header, rows, [*("" for _ in nis), "aside"]), text)


def _marked(value: Any) -> str:
    word, mark = verdict(value)
    text = number(value, 2)
    return f"{mark}|{text} ▲" if mark == "warn" else f"{text} ▽" if word == "cautious" else text


def network(summary: dict[str, Any]) -> str:
    """Messages and bytes, in all and per robot and second, and what the pair exchange came to."""
    found, pair = summary["network"], summary["network"]["pair"]
    seconds = summary["simulated_s"] * summary["trials"] * len(summary["robots"])

    def each(count: float) -> str:
        return number(count / seconds, 3) if seconds else "–"

    rows = [
        ["messages sent", f"{found['sent']:,}", each(found["sent"])],
        ["delivered, per receiver", f"{found['delivered']:,}", each(found["delivered"])],
        ["lost or out of range, per receiver", f"{found['lost']:,}", each(found["lost"])],
        ["bytes sent", " ".join(size(found["bytes"])), " ".join(size(found["bytes_per_robot_s"]))],
        ["contacts opened", f"{pair['started']:,}", each(pair["started"])],
        ["contacts used by both sides", f"{pair['completed']:,}", each(pair["completed"])],
        ["contacts used by one side", f"{pair['one_sided']:,}", each(pair["one_sided"])],
        ["contacts with unknown correlation", f"{pair['fallback']:,}", each(pair["fallback"])],
        ["contacts too old to answer", f"{pair['too_old']:,}", each(pair["too_old"])],
    ]
    return table(["", "count", "per robot and second"], rows)


def rejected(summary: dict[str, Any]) -> str:
    """What was refused, by reason."""
    if not summary["rejected"]:
        return "<p>No message was refused.</p>"
    return table(["reason", "count"], [[name, f"{count:,}"] for name, count in summary["rejected"].items()])
