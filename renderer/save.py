"""Objects that were moved or made of something else, written back into the scene file.

Comments, order and everything that was not changed stay as they are (tomlkit).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Material, Object, parse_scene
from chromeball.scene.record import write_text

#: What an interactive session changes of an object.
FIELDS = ("position", "rotation", "scale", "material")


def edited(text: str, objects: Sequence[Object], path: str | os.PathLike[str]) -> str:
    """The text of a scene file with these `objects`, found by their names.

    Raises
    ------
    UserError
        When the file is no scene, or has no object of such a name any more; `path` names it.

    """
    import tomlkit

    scene = parse_scene(text, path)
    document: Any = tomlkit.parse(text)
    now = {entry.name: (k, entry) for k, entry in enumerate(scene.object)}
    for entry in objects:
        if entry.name not in now:
            raise UserError(f"has no [[object]] named {entry.name!r} any more", file=path)
        k, old = now[entry.name]
        table = document["object"][k]
        for name in FIELDS:
            value, before = getattr(entry, name), getattr(old, name)
            if value == before:
                continue
            if name == "material":
                _edit_material(table, value, before)
            else:
                table[name] = _plain(value)
    result = tomlkit.dumps(document)
    saved = {entry.name: entry for entry in parse_scene(result, path).object}
    if any(
        getattr(saved[o.name], name) != getattr(o, name) for o in objects for name in FIELDS
    ):
        raise RuntimeError("the edited scene file does not say what was to be saved")
    return result


def save(source: Path, target: Path, objects: Sequence[Object], *, overwrite: bool) -> None:
    """Write `source` with the `objects` changed to `target`, whole or not at all.

    Raises
    ------
    UserError
        When `target` is there and may not be overwritten, or cannot be written.

    """
    if target.exists() and not overwrite:
        raise UserError("is there already; confirm to overwrite it", file=target)
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"not a readable text file: {error}", file=source) from error
    write_text(target, edited(text, objects, source))


def _edit_material(table: Any, value: Material | None, before: Material | None) -> None:
    import tomlkit

    if value is None:
        table.pop("material")
        return
    if "material" not in table:
        table["material"] = tomlkit.inline_table()
    old = {} if before is None else msgspec.structs.asdict(before)
    for name, new in msgspec.structs.asdict(value).items():
        if before is not None and new == old[name]:
            continue
        if new is None:
            table["material"].pop(name, None)
        else:
            table["material"][name] = _plain(new)


def _plain(value: Any) -> Any:
    """A value that TOML has."""
    return [*value] if isinstance(value, tuple) else value
