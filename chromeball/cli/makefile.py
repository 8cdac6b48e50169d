"""``pipeline.mk``: the needed stages of a scene as plain rules of make, and their slices."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

from chromeball.cli.stages import StagePlan, patterns
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Scene
from chromeball.scene.record import write_text

PIPELINE = "pipeline.mk"


def pipeline(plan: Sequence[StagePlan], scene: Scene, path: Path) -> str:
    """The text of ``pipeline.mk`` for a plan of the scene file `path`.

    Raises
    ------
    UserError
        For a file name that make cannot be told.

    """
    try:
        rules = [_rule(stage, scene.folder) for stage in plan if stage.needed]
        watched = sorted({_folder_of_pattern(name) for name in patterns(scene)})
        folders = [_name(folder) for folder in watched if _is_quiet(folder, plan)]
    except UserError as error:
        raise UserError(error.what, file=path) from error
    skipped = [_comment(f"  {s.name}: {s.reason}") for s in plan if not s.needed]
    header = [
        _comment(f"Written by `chromeball plan {path.name} --makefile`; not to be edited."),
        *(["# Skipped:", *skipped] if skipped else []),
        ".PHONY: all",
        _wrap("all:", [_name(o) for s in plan[-1:] for o in s.outputs]),
    ]
    if folders:
        # a picture that is added or taken away changes its folder
        header += ["", f"{PIPELINE}: $(wildcard {' '.join(folders)})"]
    return "\n".join(header) + "\n\n" + "\n\n".join(rules) + "\n"


def write_pipeline(plan: Sequence[StagePlan], scene: Scene, path: Path) -> Path:
    """Write ``pipeline.mk`` and the slices beside the scene file; returns the former's path.

    A slice is written only when its content changes, so that its time is that of the change.
    """
    text = pipeline(plan, scene, path)
    for stage in plan:
        if stage.needed:
            kept, content = path.parent / stage.slice_file(scene.folder), stage.slice_text()
            if not (kept.exists() and kept.read_text(encoding="utf-8") == content):
                write_text(kept, content)
    write_text(path.parent / PIPELINE, text)
    return path.parent / PIPELINE


def _rule(stage: StagePlan, folder: str) -> str:
    # One run makes all outputs. The others follow from the first and are only made by
    # themselves where they were deleted; with grouped targets make -n (4.3) forgets what
    # depends on them.
    target, *others = map(_target, stage.outputs)
    needs = [*stage.inputs, stage.slice_file(folder)]
    after = ["|", *map(_name, stage.after)] if stage.after else []
    command = shlex.join(stage.command)
    if re.search(r"[\x00-\x1f\x7f]", command):
        raise UserError(f"{stage.name}: a value holds a control character; rename the file")
    recipe = command.replace("$", "$$")
    rules = [
        _wrap(f"{target}:", [*map(_name, needs), *after]) + f"\n\t{recipe}",
        *(f"{other}: {target}\n\t@[ -e '$@' ] || {recipe}" for other in others),
    ]
    return "\n".join([_comment(f"{stage.name}: {stage.reason}"), *rules])


def _comment(text: str) -> str:
    """One line of comment; a backslash would continue it."""
    return "# " + re.sub(r"[\x00-\x1f\x7f\\]", "?", text)


def _wrap(head: str, names: Iterable[str]) -> str:
    """One line, or one name a line where they are many."""
    line = " ".join([head, *names])
    return line if len(line) <= 96 else " \\\n  ".join([head, *names])


def _name(name: str) -> str:
    """A file as make writes a prerequisite, odd characters escaped."""
    bad = re.search(r"[;=\\\x00-\x1f\x7f]|^~", name)
    if bad:
        raise UserError(
            f"make cannot be told the file name {name!r}, for its {bad[0]!r}: rename the file"
        )
    return re.sub(r"([ #:|*?\[\]])", r"\\\1", name).replace("$", "$$")


def _target(name: str) -> str:
    bad = re.search(r"[^\w./+,@-]", name)
    if bad:
        raise UserError(f"{name!r}, which a stage makes, holds {bad[0]!r}: rename it")
    return name


def _folder_of_pattern(pattern: str) -> str:
    parts = Path(pattern).parts
    plain: list[str] = []
    for part in parts[:-1]:
        if re.search(r"[*?\[]", part):
            break
        plain.append(part)
    return str(Path(*plain)) if plain else "."


def _is_quiet(folder: str, plan: Sequence[StagePlan]) -> bool:
    """Whether no stage writes into `folder`, so that its time is that of the photographs."""
    here = {str(Path(output).parent) for stage in plan for output in stage.outputs}
    busy = any(character in folder for character in " \t#$%")  # $(wildcard) cannot say these
    return folder != "." and folder not in here and not busy
