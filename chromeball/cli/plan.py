"""``chromeball plan``: which stages a scene needs, which are up to date, and why."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from chromeball.cli.freshness import Verdict, judge
from chromeball.cli.makefile import write_pipeline
from chromeball.cli.stages import stages
from chromeball.scene.manifest import read_scene


def plan(scene_file: Path, /, *, makefile: bool = False, json: bool = False) -> None:
    """Print each stage of a scene: needed, skipped or up to date, and the reason.

    Parameters
    ----------
    scene_file
        The scene.toml.
    makefile
        Write the needed rules to pipeline.mk beside the scene file, for make.
    json
        Print the stages with their files and commands as JSON.

    """
    scene = read_scene(scene_file)
    planned = stages(scene, scene_file)
    verdicts = judge(planned, scene_file.parent, scene.folder)
    if makefile:
        written = write_pipeline(planned, scene, scene_file)
        count = sum(stage.needed for stage in planned)
        print(f"{written}: {count} stages, {len(planned) - count} skipped", file=sys.stderr)
    if json:
        print(as_json(verdicts))
    elif not makefile:
        print(as_text(verdicts))


def as_text(verdicts: Sequence[Verdict]) -> str:
    """A table of stage, state and reason."""
    width = max(len(verdict.stage.name) for verdict in verdicts)
    lines: list[str] = []
    for verdict in verdicts:
        reason = verdict.stage.reason
        if verdict.state != "skipped":
            reason += f" ({verdict.cause})"
        lines.append(f"{verdict.stage.name:{width}}  {verdict.state:10}  {reason}")
    return "\n".join(lines)


def as_json(verdicts: Sequence[Verdict]) -> str:
    """A list of stages, for programs."""
    return json.dumps(
        [
            {
                "name": verdict.stage.name,
                "state": verdict.state,
                "reason": verdict.stage.reason,
                "cause": verdict.cause,
                "inputs": verdict.stage.inputs,
                "outputs": verdict.stage.outputs,
                "command": verdict.stage.command,
            }
            for verdict in verdicts
        ],
        indent=1,
    )
