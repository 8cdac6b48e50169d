"""A row of the benchmark table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Point:
    """A row's place on a curve: ``seconds``, of `clock`, at so many (``at``) of `along`."""

    along: str
    at: float
    seconds: float
    clock: str = "CPU s"


@dataclass(frozen=True)
class Row:
    """One tool on one task: CPU seconds against error, and a point of a curve if it is one."""

    stage: str
    what: str
    tool: str
    cpu_seconds: float
    error: float
    unit: str
    note: str = ""
    point: Point | None = None
