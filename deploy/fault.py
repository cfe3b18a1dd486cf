"""`cofix fault`: inject faults by hand into a run of processes that goes on on this computer."""

from __future__ import annotations

import argparse
import json
import os
import socket
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from agent.config_file import ConfigError
from agent.fault_parts import FAULT_KINDS

SOCKET = "faults.sock"
TIMEOUT_S = 10.0
ALIASES = {"kill": "crash"}
IDS = ("sources", "destinations")
PLACES = {
    "loss": ("share",),
    "duplicate": ("share", "within_s"),
    "corrupt": ("share",),
    "burst_loss": ("good_s", "bad_s"),
    "delay": ("delay_s", "tail_s"),
    "rate_cap": ("bytes_per_s",),
    "isolate": ("robot",),
    "forge": ("claims",),
    "sensor_dropout": ("robot", "sensor"),
    "sensor_outliers": ("robot", "sensor"),
    "sensor_bias": ("robot", "sensor"),
    "sensor_delay": ("robot", "delay_s", "tail_s"),
    "autopilot_silence": ("robot",),
    "clock_step": ("robot", "offset_s"),
    "clock_drift": ("robot", "ppm"),
    "crash": ("robot",),
    "restart": ("robot",),
    "pause": ("robot",),
}
"""Keys whose values may be given without their names, in this order."""


def fault(options: argparse.Namespace) -> int:
    """Carry out `cofix fault`. Raises `ConfigError`."""
    directory, words = split(options.words)
    request = wanted(words, options.links, options.lasting)
    answer = ask(socket_of(directory), request)
    if "error" in answer:
        raise ConfigError(answer["error"])
    if options.json:
        print(json.dumps(answer))
    elif "faults" in answer:
        for name, on, text in answer["faults"]:
            print(f"{'on ' if on else '   '} {name}: {text}")
    else:
        print(answer["done"])
    return 0


def split(words: list[str]) -> tuple[Path | None, list[str]]:
    """(run directory if one is named, what to do). Raises `ConfigError`."""
    verbs = ("list", "end", *ALIASES, *FAULT_KINDS)
    if words[0] in verbs:
        return None, words
    if len(words) > 1 and words[1] in verbs:
        return Path(words[0]), words[1:]
    raise ConfigError(f"fault: '{words[min(1, len(words) - 1)]}' is none of {', '.join(verbs)}")


def wanted(words: list[str], links: str | None = None, lasting: float | None = None) -> dict[str, Any]:
    """The request for the launcher. Raises `ConfigError` if the words are not understood."""
    verb, rest = words[0], words[1:]
    if verb == "list" and not rest:
        return {"list": True}
    if verb == "end" and len(rest) == 1:
        return {"end": rest[0]}
    if verb in ("list", "end"):
        raise ConfigError("fault: it is 'list' alone, and 'end NAME'")
    kind = ALIASES.get(verb, verb)
    keys: dict[str, Any] = {"kind": kind}
    places = list(PLACES.get(kind, ()))
    for word in rest:
        name, equals, text = word.partition("=")
        if equals:
            keys[name] = text.split(",") if name in IDS else _value(text)
        elif kind == "partition":
            keys.setdefault("groups", []).append(word.split(","))
        elif places:
            keys[places.pop(0)] = _value(word)
        else:
            raise ConfigError(f"fault: what is '{word}'? write key=value")
    if links is not None:
        # Links among the robots that are named.
        keys |= dict.fromkeys(IDS, links.split(","))
    if lasting is not None:
        keys["for_s"] = lasting
    return {"inject": keys}


def _value(text: str) -> Any:
    """A value as TOML has it, or a plain word."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def socket_of(directory: Path | None) -> Path:
    """Where the launcher of a run listens; of the newest run if none is named. Raises `ConfigError`."""
    if directory is None:
        folder = Path(tempfile.gettempdir())
        there = [path for path in folder.glob(f"cofix-*/{SOCKET}") if path.stat().st_uid == os.getuid()]
        if not there:
            raise ConfigError("fault: no run of processes goes on; start one with 'cofix run --runtime processes'")
        return max(there, key=lambda path: path.stat().st_mtime_ns)
    for path in sorted((directory / "agents").glob("*.toml")):
        control = tomllib.loads(path.read_text()).get("control_socket")
        if control is not None:
            return Path(control).with_name(SOCKET)
    raise ConfigError(f"fault: {directory} is not the directory of a run of processes")


def ask(path: Path, request: dict[str, Any]) -> dict[str, Any]:
    """The launcher's answer. Raises `ConfigError` when nobody answers."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        line.settimeout(TIMEOUT_S)
        try:
            line.connect(str(path))
            line.sendall(json.dumps(request).encode() + b"\n")
            with line.makefile("rb") as file:
                answer: dict[str, Any] = json.loads(file.readline())
        except (OSError, ValueError):
            raise ConfigError("fault: the run does not answer; it is over or has not started yet") from None
    return answer
