"""Reading configuration files: TOML, strictly.

An unknown key is refused with the nearest valid name, a wrong type with what was expected; always in one line.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError

Id = Annotated[str, Field(pattern=r"^[a-z0-9-]{1,24}$")]
LandmarkId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,32}$")]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector2 = Annotated[list[Finite], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Point = Annotated[list[Finite], Field(min_length=2, max_length=3)]
"""x, y or x, y, z [m]."""


class ConfigError(ValueError):
    """A file or key the user has to change; the message is one line that says how."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class Part(BaseModel):
    """A table of a configuration file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


P = TypeVar("P", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as a dictionary. Raises `ConfigError` naming the file and what is wrong with it."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a folder, a TOML file is needed") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error.__class__.__name__})") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def validate(model: type[P], data: dict[str, Any], where: str) -> P:
    """`data` as a `model`. Raises `ConfigError` with the first offending key and the remedy."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{where}: {explain(model, data, error)}") from None


def explain(model: type[BaseModel], data: dict[str, Any], error: ValidationError) -> str:
    """One line for the first fault of a validation."""
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    path, value = _readable_path(data, first["loc"]), first.get("input")
    if first["type"] == "extra_forbidden":
        names = _valid_names(model, first["loc"][:-1])
        near = difflib.get_close_matches(str(first["loc"][-1]), names, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"valid keys: {', '.join(names)}"
        return f"unknown key '{path}': {hint}"
    if first["type"] in ("union_tag_invalid", "union_tag_not_found"):
        key, kinds = first["ctx"]["discriminator"].strip("'"), _tags(model, first["loc"])
        given = value.get(key) if isinstance(value, dict) else None
        if given is None:
            return f"key '{path}.{key}' is missing: one of {', '.join(kinds)}"
        near = difflib.get_close_matches(str(given), kinds, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"one of {', '.join(kinds)}"
        return f"key '{path}.{key}' = {given!r}: {hint}"
    if first["type"] == "missing":
        return f"key '{path}' is missing"
    message = first["msg"][0].lower() + first["msg"][1:]
    if first["type"] in ("model_type", "dict_type"):
        message = "a table is needed"
    shown = repr(value) if isinstance(value, (str, int, float, bool)) else type(value).__name__
    if isinstance(value, float) and math.isnan(value):
        shown = "nan"
    return f"key '{path}' = {shown}: {message}"


def _readable_path(data: Any, location: tuple[Any, ...]) -> str:
    """A dotted path in which entries of an array of tables go by their id."""
    parts, here = [], data
    for key in location:
        if isinstance(key, int):
            here = here[key] if isinstance(here, list) and key < len(here) else None
            parts.append(str(here.get("id", key)) if isinstance(here, dict) else str(key))
        else:
            # The tag of a union of tables is no key of the file.
            if isinstance(here, dict) and key not in here and here.get("kind") == key:
                continue
            here = here.get(key) if isinstance(here, dict) else None
            parts.append(str(key))
    return ".".join(parts)


def _valid_names(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """Field names of the table at `location` below `model`."""
    here = _type_at(model, location)
    return sorted(here.model_fields) if _is_table(here) else []


def _type_at(model: type[BaseModel], location: tuple[Any, ...]) -> Any:
    """The type of what is at `location` below `model`."""
    here: Any = model
    for key in location:
        kinds = _kinds(here)
        if key in kinds:
            here = kinds[str(key)]
        elif _is_table(here):
            field = here.model_fields.get(str(key))
            here = _required(field.annotation) if field is not None else None
        else:
            # An index or a name of free choice: on to the type of the entries.
            here = _required((get_args(here) or (None,))[-1])
    return here


def _tags(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """Kinds of table there may be at `location` below `model`."""
    return list(_kinds(_type_at(model, location)))


def _kinds(annotation: Any) -> dict[str, Any]:
    """Tables of a union by their `kind`; empty for anything else."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) is not UnionType:
        return {}
    found = {}
    for part in get_args(annotation):
        if _is_table(part) and "kind" in part.model_fields:
            found[str(get_args(part.model_fields["kind"].annotation)[0])] = part
    return found


def _is_table(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _required(annotation: Any) -> Any:
    """A type without its `| None`."""
    if get_origin(annotation) is UnionType and type(None) in get_args(annotation):
        return next(argument for argument in get_args(annotation) if argument is not type(None))
    return annotation
