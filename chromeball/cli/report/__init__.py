"""``chromeball report``: one HTML file on what was done, and how well, from records alone."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def report(
    scene_file: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("report.html"),
) -> None:
    """Write one self-contained HTML file about a scene: pictures, figures, times.

    Parameters
    ----------
    scene_file
        The scene.toml; what its stages recorded is read from beside it.
    output
        The file to write.

    """
    from chromeball.cli.report.page import write_report

    verdict = write_report(scene_file, output)
    print(f"{output}: {verdict}", file=sys.stderr)
