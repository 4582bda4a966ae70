"""Reference of the keys of TOML files, generated from the structures that read these files."""

import inspect
import math
import re
import tomllib
import types
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import msgspec
import tomli_w

from ertis_numba.base.units import unit_of
from ertis_numba.geometry.layout_files import LayoutFile
from ertis_numba.settings import Settings
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits
from ertis_numba.simulation.scene import Scene

__all__ = ["DOCUMENTS", "KeyReference", "TableReference", "reference"]

DOCUMENTS: Final[dict[str, type[TomlTable]]] = {
    "settings": Settings,
    "scene": Scene,
    "layout": LayoutFile,
    "mounting": Scene,
}
"""Structure of each kind of file; a mounting is a scene of which only the poses of sensors are used."""

_POSE_KEYS: Final = ("name", "position_m", "yaw_deg", "pitch_deg", "roll_deg")
_TYPES: Final = {str: "text", int: "whole number", float: "number", bool: "true or false"}
_OF_SETTINGS: Final = {type(value) for value in msgspec.structs.astuple(Settings())}
_ENTRY: Final = re.compile(r"^(?P<names>\w+(?:, \w+)*)(?: : (?P<type>.*))?$")
_PARTS: Final = re.compile(r"\(.*\)|\{.*\}")


@dataclass(frozen=True, slots=True)
class KeyReference:
    """Description of one key."""

    name: str
    about: str  # meaning
    shape: str  # type of the value in words
    unit: str  # empty if the value has none
    default: str  # as TOML, "required", or "none" for no value
    example: str  # line of TOML; empty if the file of examples has none


@dataclass(frozen=True, slots=True)
class TableReference:
    """Keys of one table."""

    header: str  # such as [array] or [[points]]; empty for keys before any table
    about: str
    keys: tuple[KeyReference, ...]


def reference(document: str) -> tuple[TableReference, ...]:
    """Return the tables of a kind of file, a name in `DOCUMENTS`."""
    examples = _read(f"every_{document}_key.toml")
    if document == "settings":  # A call has an own waveform or the other keys, so no file holds all of them.
        examples["call"] = _read("own_waveform.toml")["call"] | examples["call"]
    if document == "layout":  # Positions are in millimetres or have a unit of their own.
        examples |= _read("layout_in_metres.toml")
    if document == "scene":  # Its sensors move by themselves, or a platform moves them.
        examples["platform"] = _read("scenes/moving_platform.toml", "ertis_examples.synthetic")["platform"]
    sections = [section for section in _ReferenceBuilder(examples).sections(DOCUMENTS[document]) if section.keys]
    if document != "mounting":
        return tuple(sections)
    poses = next(section for section in sections if section.header == "[[sensors]]")
    return (TableReference(poses.header, poses.about, tuple(key for key in poses.keys if key.name in _POSE_KEYS)),)


def _read(name: str, package: str = "ertis_examples") -> dict[str, Any]:
    return tomllib.loads(resources.files(package).joinpath(name).read_text("utf-8"))


class _ReferenceBuilder:
    """Reader of structures and of a file that has an example of each key."""

    def __init__(self, examples: dict[str, Any]) -> None:
        self._examples = examples

    def sections(self, kind: type[TomlTable], path: str = "", header: str = "") -> Iterator[TableReference]:
        """Yield the section of a table, then those of the tables in it."""
        texts, tables, keys = _texts(kind), [], []
        for field in msgspec.structs.fields(kind):
            inner = _table_in(field.type)
            if inner is None:
                keys.append(
                    _key(
                        field, _default(kind, field), *texts.get(field.name, ("", "")), self._example(path, field.name)
                    )
                )
            elif kind is Settings or inner not in _OF_SETTINGS:  # which the reference of settings has
                tables.append((field, inner))
        yield TableReference(header, _summary(kind), tuple(keys))
        for field, inner in tables:
            within = f"{path}.{field.name}".lstrip(".")
            yield from self.sections(
                inner, within, f"[[{within}]]" if get_origin(field.type) is tuple else f"[{within}]"
            )

    def _example(self, path: str, name: str) -> Any:
        """Return the value of a key in its table, or else in any table."""
        values = dict(reversed([*_values(self._examples)]))
        anywhere = (value for (_, key), value in values.items() if key == name)
        return values.get((path, name), next(anywhere, None))


def _values(table: dict[str, Any], path: str = "") -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield the values of a file by table and key."""
    for name, value in table.items():
        yield (path, name), value
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, dict):
                yield from _values(inner, f"{path}.{name}".lstrip("."))


def _table_in(kind: Any) -> type[TomlTable] | None:
    """Return the table that a field holds once or several times."""
    tables = (part for part in (kind, *get_args(kind)) if inspect.isclass(part) and issubclass(part, TomlTable))
    return next(tables, None)


def _default(kind: type[TomlTable], field: msgspec.structs.FieldInfo) -> Any:
    """Return the value of a key that is left out; NODEFAULT if it must not be."""
    if field.required:
        return msgspec.NODEFAULT
    if kind in _OF_SETTINGS:
        return getattr(kind(), field.name)  # A structure may complete its defaults when it is created.
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


def _key(field: msgspec.structs.FieldInfo, default: Any, kind: str, about: str, example: Any) -> KeyReference:
    kind = kind.partition(", default")[0]
    parts = None if "Literal" in str(field.type) else _PARTS.search(kind)
    return KeyReference(
        name=field.name,
        about=about,
        shape=" ".join(filter(None, (_shape(field.type), parts and parts[0], _range(field.type)))),
        unit=unit_of(field.name)[1],
        default="required" if default is msgspec.NODEFAULT else "none" if default is None else _toml(default),
        example="" if example is None else f"{field.name} = {_toml(example)}",
    )


def _toml(value: Any) -> str:
    """Return a value as TOML, on one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_toml(item)}" for name, item in value.items()) + " }" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return tomli_w.dumps({"key": value}).strip().removeprefix("key = ")


def _shape(kind: Any) -> str:
    """Return a type in words."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    origin, parts = get_origin(kind), get_args(kind)
    if origin in {Union, types.UnionType}:
        return " or ".join(_shape(part) for part in parts if part is not type(None))
    if origin is Literal:
        return " or ".join(f'"{part}"' for part in parts)
    if origin is dict:
        return f"table of {_shape(parts[1])}"
    if origin in {tuple, list}:
        if len(parts) == 1 or parts[-1] is ...:
            return f"list of {_plural(_shape(parts[0]))}"
        return f"list of {len(parts)} {_plural(_shape(parts[0]))}"
    return _TYPES[kind]


def _range(kind: Any) -> str:
    """Return the limits in a type in words, each once; nothing if a part, such as the time of a pose, has none."""
    found = list(_limits(kind))
    return "" if any(math.isinf(each.low) for each in found) else " and ".join(dict.fromkeys(map(str, found)))


def _limits(kind: Any) -> Iterator[Limits]:
    for part in get_args(kind):
        yield from [part] if isinstance(part, Limits) else _limits(part)


def _plural(shape: str) -> str:
    """Return the plural of a type in words."""
    if shape.startswith("list of "):
        return f"lists of {shape.removeprefix('list of ')}"
    return {"true or false": "true or false", "text": "texts"}.get(shape, f"{shape}s")


def _summary(kind: type[TomlTable]) -> str:
    return (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("\n", " ").rstrip(":")


def _texts(kind: type[TomlTable]) -> dict[str, tuple[str, str]]:
    """Return type and meaning of each key by the docstrings of a structure and of its bases."""
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        section = inspect.cleandoc(base.__doc__ or "").partition("Attributes\n----------\n")[2]
        names: list[str] = []
        for line in section.splitlines():
            entry = None if line.startswith(" ") else _ENTRY.match(line)
            if entry is not None:
                names = entry["names"].split(", ")
                found |= dict.fromkeys(names, (entry["type"] or "", ""))
            else:
                found |= {name: (found[name][0], f"{found[name][1]} {line.strip()}".strip()) for name in names}
    return found
