"""Pictures that arrive while the verdict is told: whole ones, once, until it is enough."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from chromeball.calibrate.search import detect_files
from chromeball.calibrate.target import Charuco
from chromeball.calibrate.virtual import board_poses, photograph
from chromeball.calibrate.watch import Progress, watch_lens
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import write_picture

TARGET = Charuco(9, 6, 0.04, 0.03, "4X4_50")
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([330.0, 332, 208, 152, -0.2, 0.06, 0.0005, -0.0006]),
    (420, 300),
)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("pictures")
    files: list[Path] = []
    for i, pose in enumerate(board_poses(TARGET, CAMERA, 5, seed=2, size=0.75)):
        files.append(folder / f"{i}.png")
        write_picture(files[-1], photograph(TARGET, CAMERA, pose, seed=i))
    return files


def test_a_folder_that_fills(tmp_path: Path, pictures: list[Path]) -> None:
    """Slow writers, a repeat, another size, a file that is none, a hidden one."""

    def fill() -> None:
        (tmp_path / ".hidden.png").write_bytes(pictures[0].read_bytes())
        (tmp_path / "broken.png").write_bytes(b"no picture")
        write_picture(tmp_path / "small.png", np.full((100, 140), 80, np.uint8))
        (tmp_path / "again.png").write_bytes(pictures[0].read_bytes())
        for i, picture in enumerate(pictures):
            data = picture.read_bytes()
            with (tmp_path / f"{i}.png").open("wb") as file:
                for part in np.array_split(np.frombuffer(data, np.uint8), 3):
                    file.write(part.tobytes())
                    file.flush()
                    time.sleep(0.08)

    (tmp_path / "0.png").write_bytes(pictures[0].read_bytes())
    writer = threading.Thread(target=fill)
    told: list[Progress] = []

    def tell(progress: Progress) -> None:
        if not told:
            writer.start()
        told.append(progress)

    found = watch_lens(tmp_path, TARGET, "opencv4", tell, enough=5, pause=0.05, patience=0.5)
    writer.join()
    names = [p.detection.file.name for p in told]
    assert ".hidden.png" not in names
    assert sorted({*names} - {"broken.png"}) == [
        "0.png", "1.png", "2.png", "3.png", "4.png", "again.png", "small.png",
    ]  # fmt: skip
    by_name = {p.detection.file.name: p for p in told}
    assert "140x100, not 420x300" in by_name["small.png"].detection.verdict
    assert told[0].verdict is None
    assert "a lens needs 3 views" in told[0].reason
    assert told[-1].views == 5
    assert told[-1].verdict is not None
    assert "5 views are few" in told[-1].verdict.sentence
    assert told[-1].verdict.advice
    # What was seen while it arrived is what the whole files show.
    last = {d.file.name: d for d in found}
    for name, detection in last.items():
        if name != "small.png":
            np.testing.assert_array_equal(
                detection.corners, detect_files([tmp_path / name], TARGET)[0].corners
            )


def test_broken_files_are_told_and_ctrl_c_ends(tmp_path: Path, pictures: list[Path]) -> None:
    (tmp_path / "a.png").write_bytes(pictures[0].read_bytes())
    (tmp_path / "half.png").write_bytes(pictures[1].read_bytes()[:3000])
    told: list[str] = []

    def tell(progress: Progress) -> None:
        told.append(progress.detection.file.name)
        if len(told) == 2:
            (tmp_path / "half.png").write_bytes(pictures[1].read_bytes())
        if len(told) == 3:
            raise KeyboardInterrupt

    found = watch_lens(tmp_path, TARGET, "opencv4", tell, pause=0.05, patience=0.2)
    assert told == ["a.png", "half.png", "half.png"]
    assert [d.file.name for d in found if d.usable] == ["a.png", "half.png"]


def test_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        watch_lens(tmp_path / "none", TARGET, "opencv4", print)
