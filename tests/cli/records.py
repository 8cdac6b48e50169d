"""Records as the stages write them, with invented figures, for tests of the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from chromeball.cli.stages import stages
from chromeball.scene.manifest import read_scene
from chromeball.scene.record import Stage, write_json

FIGURES: dict[str, dict[str, Any]] = {
    "take": {"frames": 2, "shortest_s": 0.001, "longest_s": 0.25, "size": [640, 480]},
    "hdr response": {
        "pixels": 41000,
        "rms_ln_exposure": 0.00731,
        "condition_number": 3.2e7,
        "plot": "response.png",
    },
    "hdr merge": {"clipped_pixels": 12, "dark_pixels": 0, "range_stops": 17.3},
    "calibrate lens": {
        "verdict": "good to 0.3 px over 60 % of the picture",
        "good": False,
        "advice": ["take 2 views with the board at the left edge"],
        "rms_px": 0.183,
        "views": [{"file": f"board_{i}.jpg", "rms": 0.1 + i / 50} for i in range(9)],
        "plots": {"residuals": "residuals.png"},
    },
    "envmap align": {"tilt_deg": 0.12, "residual_rad": 0.0004, "converged": True},
    "envmap probe": {"energy_error_percent": 0.02, "preview": "env.png"},
    "render": {"spp": 64, "mean_radiance": [0.2, 0.3, 0.4], "noise": None},
}


def plot(path: Path, width: int = 140, height: int = 80) -> None:
    """A picture with something in it."""
    y, x = np.mgrid[0:height, 0:width]
    rgb = np.stack([x % 256, y % 256, (x + y) // 8 % 256], axis=2).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb)


def record_all(root: Path, leave_out: tuple[str, ...] = ()) -> None:
    """Write every output of the scene in `root`, its record and the pictures it names."""
    path = root / "scene.toml"
    scene = read_scene(path)
    for stage in stages(scene, path):
        if not stage.needed or stage.name == "report" or stage.name in leave_out:
            continue
        found = next((f for name, f in FIGURES.items() if stage.name.startswith(name)), {})
        with Stage(stage.name, inputs=[root / name for name in stage.inputs]) as run:
            run.figures |= found
            for output in stage.outputs:
                with run.output(root / output) as temporary:
                    if output.endswith(".png"):
                        plot(temporary, 192, 120)
                    else:
                        temporary.write_text(stage.name)
        for name in ("response.png", "residuals.png", "env.png"):
            plot(root / scene.folder / name)


def record_truth(root: Path, errors: list[dict[str, Any]]) -> None:
    """What the comparison with a truth leaves."""
    plot(root / "build/truth.png")
    with Stage("truth") as run:
        run.figures |= {"errors": errors, "picture": "truth.png"}
        with run.output(root / "build/truth.json") as temporary:
            write_json(temporary, run.figures)
