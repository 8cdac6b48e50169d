"""A row of the benchmark table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One tool on one task: CPU seconds against error."""

    stage: str
    what: str
    tool: str
    cpu_seconds: float
    error: float
    unit: str
    note: str = ""
