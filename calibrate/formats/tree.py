"""YAML, JSON and XML as plain lists, mappings and strings; nothing in them is carried out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from chromeball.scene.errors import UserError

#: Deeper nesting than this is no camera file.
DEEPEST = 32
#: Nor is a longer file, bytes: calibrations that keep all their corners have some 10 MB.
LONGEST = 200_000_000


def read_text(path: Path) -> str:
    """The text of a file, UTF-8."""
    try:
        if path.stat().st_size > LONGEST:
            raise UserError("too long for a camera file", file=path)
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise UserError("no such file", file=path) from error
    except (OSError, ValueError) as error:
        raise UserError(
            f"not a readable text file ({type(error).__name__})", file=path
        ) from error


def read_tree(path: Path) -> dict[str, Any]:
    """As :func:`read_root`, where the root is a mapping.

    Raises
    ------
    UserError
        The file is missing, broken, or holds something else.

    """
    tree = read_root(path)
    if not isinstance(tree, dict):
        raise UserError("not a camera file: it holds no names", file=path)
    return tree


def read_root(path: Path) -> Any:
    """What stands at the root of a YAML, JSON or XML file, by its first character.

    Scalars of YAML and XML stay strings, tags are passed over, matrices of OpenCV are mappings
    with ``rows``, ``cols`` and ``data``.

    Raises
    ------
    UserError
        The file is missing or broken.

    """
    text = read_text(path)
    start = text.lstrip()[:1]
    try:
        return {"{": _json, "[": _json, "<": _xml}.get(start, _yaml)(text)
    except RecursionError as error:
        raise UserError("nested too deep for a camera file", file=path) from error
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"not a readable camera file ({reason})", file=path) from error


def _json(text: str) -> Any:
    return json.loads(text)


def _yaml(text: str) -> Any:
    import yaml

    first, _, rest = text.partition("\n")
    if first.startswith("%YAML:"):  # OpenCV's spelling of %YAML 1.0
        text = rest
    depth = 0
    try:
        # libyaml's loader recurses without a limit, its events do not.
        for event in yaml.parse(text, yaml.CBaseLoader):
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            if depth > DEEPEST:
                raise ValueError("nested too deep")
        return yaml.load(text, yaml.CBaseLoader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


def _xml(text: str) -> Any:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(str(error)) from error
    return _element(root, 0)


def _element(element: ElementTree.Element, depth: int) -> Any:
    """A mapping of an element's children, a list of unnamed ones (``<_>``), or its words."""
    if depth > DEEPEST:
        raise ValueError("nested too deep")
    if not len(element):
        words = (element.text or "").split()
        return words[0] if len(words) == 1 else words
    if all(child.tag == "_" for child in element):
        return [_element(child, depth + 1) for child in element]
    return {child.tag: _element(child, depth + 1) for child in element}
