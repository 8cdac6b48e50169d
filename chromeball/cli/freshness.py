"""What of a plan is up to date, by make's own rule: outputs newer than inputs and slice."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from chromeball.cli.stages import StagePlan


@dataclass(frozen=True)
class Verdict:
    """Whether a stage is skipped, up to date or to be run, and why."""

    stage: StagePlan
    state: Literal["needed", "skipped", "up to date"]
    cause: str


def judge(plan: Sequence[StagePlan], root: Path, folder: str) -> list[Verdict]:
    """Apply make's rule to every stage: an output that is gone, or older than an input.

    `root` is the folder of the scene file, `folder` its ``scene.folder``.
    """
    verdicts: list[Verdict] = []
    rerun: dict[str, str] = {}
    made = {output for stage in plan for output in stage.outputs}
    for stage in plan:
        if not stage.needed:
            verdicts.append(Verdict(stage, "skipped", stage.reason))
            continue
        cause = _cause(stage, root, folder, rerun, made)
        if cause:
            rerun |= dict.fromkeys(stage.outputs, stage.name)
        verdicts.append(
            Verdict(stage, "needed" if cause else "up to date", cause or "nothing changed")
        )
    return verdicts


def _cause(
    stage: StagePlan, root: Path, folder: str, rerun: dict[str, str], made: set[str]
) -> str | None:
    gone = [name for name in stage.inputs if name not in made and not (root / name).exists()]
    waits = f"; waits for {gone[0]}, which no stage makes" if gone else ""
    missing = [name for name in stage.outputs if not (root / name).exists()]
    if missing:
        return f"{missing[0]} is not there yet{waits}"
    for name in stage.inputs:
        if name in rerun:
            return f"{rerun[name]} runs before it{waits}"
    if gone:
        return f"{gone[0]} is gone and no stage makes it"
    kept = root / stage.slice_file(folder)
    if not kept.exists():
        return "never made by this plan"
    if kept.read_text(encoding="utf-8") != stage.slice_text():
        return f"{_difference(kept, stage)} changed"
    oldest = min((root / name).stat().st_mtime_ns for name in stage.outputs)
    if kept.stat().st_mtime_ns > oldest:
        return "its part of the scene file changed"
    for name in stage.inputs:
        if (root / name).stat().st_mtime_ns > oldest:
            return f"{name} is newer"
    return None


def _difference(kept: Path, stage: StagePlan) -> str:
    """Name the first key of the slice that differs from the one kept on disk."""
    try:
        old: Any = json.loads(kept.read_text(encoding="utf-8"))
    except json.JSONDecodeError:
        return "its slice"
    new: Any = json.loads(stage.slice_text())
    for part in ("scene", "command"):
        place = _first_difference(old.get(part), new[part], "")
        if place is not None:
            return "its command" if part == "command" else (place or "its part of the scene")
    return "its slice"


def _first_difference(old: Any, new: Any, place: str) -> str | None:
    if old == new:
        return None
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):  # pyright: ignore[reportUnknownArgumentType]
            found = _first_difference(old.get(key), new.get(key), f"{place}.{key}".lstrip("."))
            if found is not None:
                return found
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):  # pyright: ignore[reportUnknownArgumentType]
        for index, (a, b) in enumerate(zip(old, new, strict=True)):  # pyright: ignore[reportUnknownArgumentType]
            named = b.get("name", index) if isinstance(b, dict) else index  # pyright: ignore
            found = _first_difference(a, b, f"{place}[{named}]")
            # a list of plain numbers is named as a whole
            if found is not None:
                return found if isinstance(b, dict) else place
    return place
