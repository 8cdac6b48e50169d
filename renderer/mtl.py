"""Material libraries of OBJ files (MTL) as text, and the files they name."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

#: Options of a map, and how many numbers follow at most.
_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3,
    "-texres": 1, "-clamp": 1, "-bm": 1, "-imfchan": 1, "-type": 1, "-colorspace": 1,
}  # fmt: skip


def named_files(path: Path) -> list[Path]:
    """The material libraries and images that an OBJ file needs, as far as they are there."""
    found: list[Path] = []
    for library in _named(path, b"mtllib"):
        for file in library_files(path, library):
            found.append(file)
            for line in file.read_text("utf-8", "surrogateescape").splitlines():
                key, *rest = line.split(maxsplit=1) or [""]
                if rest and (key.startswith("map_") or key in ("norm", "bump")):
                    name = parse_map(rest[0]).name
                    found += [f for f in (beside(file, name),) if f.is_file()]
    return found


def _named(path: Path, word: bytes) -> list[str]:
    """What follows `word` in the lines that begin with it, near the file's beginning."""
    with path.open("rb") as file:
        lines = file.read(1 << 20).splitlines()
    found = (line.split(maxsplit=1) for line in lines if line.startswith(word))
    return [os.fsdecode(words[1].strip()) for words in found if len(words) == 2]


def beside(file: Path, name: str) -> Path:
    """A file that `file` names."""
    return file.parent / name.replace("\\", "/")


def library_files(path: Path, library: str) -> list[Path]:
    """One name with blanks in it, or several names."""
    for names in ([library], library.split()):
        paths = [beside(path, name) for name in names]
        if "\0" not in library and all(p.is_file() for p in paths):
            return paths
    return []


@dataclass
class Map:
    """A map: its file, and what its options say."""

    name: str
    clamp: bool = False
    strength: float = 1.0
    left_out: list[str] = field(default_factory=list[str])


def parse_map(text: str) -> Map:
    """A map's options and, after them, its file."""
    words = text.split()
    result = Map("")
    i = 0
    while i < len(words) and words[i] in _OPTIONS:
        option, most = words[i], _OPTIONS[words[i]]
        values: list[str] = []
        i += 1
        while i < len(words) and len(values) < most and (most == 1 or is_number(words[i])):
            values.append(words[i])
            i += 1
        if option == "-clamp":
            result.clamp = values == ["on"]
        elif option == "-bm" and values and is_number(values[0]):
            result.strength = float(values[0])
        else:
            result.left_out.append(option)
    result.name = " ".join(words[i:])
    return result


def is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def blocks(file: Path) -> dict[str, dict[str, str]]:
    """The lines of each material, by their key."""
    blocks: dict[str, dict[str, str]] = {}
    block: dict[str, str] = {}
    for line in file.read_text("utf-8", "surrogateescape").splitlines():
        words = line.partition("#")[0].split(maxsplit=1)
        if len(words) == 2 and words[0] == "newmtl":
            block = blocks.setdefault(words[1].strip(), {})
        elif len(words) == 2:
            block[words[0]] = words[1].strip()
    return blocks
