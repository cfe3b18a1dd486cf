"""Faults in words, for people."""

from __future__ import annotations

from agent.fault_parts import AnyFaultPart, RestartPart


def told(name: str, fault: AnyFaultPart) -> str:
    """A fault in words, for people."""
    keys = fault.model_dump(exclude_defaults=True, exclude={"id", "kind", "at_s", "for_s"})
    values = ", ".join(f"{key} {_plain(value)}" for key, value in keys.items())
    until = "to the end" if fault.for_s is None else f"for {fault.for_s:g} s"
    if isinstance(fault, RestartPart) and fault.for_s is None:
        until = "once"
    title = fault.kind if name.startswith(fault.kind) else f"{name} ({fault.kind})"
    return f"{title} at {fault.at_s:g} s {until}" + (f": {values}" if values else "")


def _plain(value: object) -> str:
    if isinstance(value, list):
        return "+".join(_plain(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
