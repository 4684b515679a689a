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


def built(kind: Any, values: dict[str, Any], where: str = "") -> Any:
    """A Spec or Params from mappings; what is not named keeps its default.

    Raises:
        ValueError: If a name is unknown, or a value out of range.
    """
    named = kind._fields if hasattr(kind, "_fields") else tuple(f.name for f in dataclasses.fields(kind))
    unknown = sorted(set(values) - set(named))
    if unknown:
        raise ValueError(f"there is no {where}{unknown[0]}: choose from {', '.join(named)}.")
    kinds = typing.get_type_hints(kind)
    fields = {}
    for name, value in values.items():
        nested = dataclasses.is_dataclass(kinds[name]) or hasattr(kinds[name], "_fields")
        deeper = nested and isinstance(value, dict)
        fields[name] = built(kinds[name], value, f"{where}{name}.") if deeper else _tuples(value)
    return kind(**fields)
