"""Specs and Params to and from plain mappings, as JSON and YAML hold them."""

import dataclasses
import typing
from typing import Any


def plain(value: Any) -> Any:
    """A Spec as mappings, lists and numbers, as JSON and YAML hold it."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {name: plain(v) for name, v in value._asdict().items()}  # pyright: ignore[reportAttributeAccessIssue]
    return [plain(v) for v in value] if isinstance(value, list | tuple) else value


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", tuple: "a list"}


def _fits(kind: type, value: Any) -> bool:
    """Whether a value may stand where the default is of a kind; a whole number is a number, true and false are none."""
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, list | tuple) if kind is tuple else type(value) is kind


def _default(kind: Any, name: str) -> Any:
    if hasattr(kind, "_fields"):
        return kind._field_defaults.get(name)
    field = next(f for f in dataclasses.fields(kind) if f.name == name)
    return None if field.default is dataclasses.MISSING else field.default


def built(kind: Any, values: dict[str, Any], where: str = "") -> Any:
    """A Spec or Params from mappings; what is not named keeps its default.

    Raises:
        ValueError: If a name is unknown, or a value of another kind than the default, or out of range.
    """
    named = kind._fields if hasattr(kind, "_fields") else tuple(f.name for f in dataclasses.fields(kind))
    unknown = sorted(set(values) - set(named))
    if unknown:
        raise ValueError(f"there is no {where}{unknown[0]}: choose from {', '.join(named)}.")
    kinds = typing.get_type_hints(kind)
    fields = {}
    for name, value in values.items():
        nested = dataclasses.is_dataclass(kinds[name]) or hasattr(kinds[name], "_fields")
        if nested:
            if not isinstance(value, dict):
                raise ValueError(f"{where}{name} must be a mapping of settings, got {value!r}.")
            fields[name] = built(kinds[name], value, f"{where}{name}.")
            continue
        usual = type(_default(kind, name))
        if usual in _WORDS and not _fits(usual, value):
            raise ValueError(f"{where}{name} must be {_WORDS[usual]}, got {value!r}.")
        fields[name] = float(value) if usual is float else _tuples(value)
    return kind(**fields)
