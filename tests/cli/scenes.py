"""Scene files for the tests of plan, make and report."""

from __future__ import annotations

from pathlib import Path

FULL = """
name = "full"
[[bracket]]
name = "front"
device = "visca:/dev/ttyUSB0"
video = "v4l2:/dev/video0"
times = ["1/4", 0.001]
[[bracket]]
name = "back"
device = "visca:/dev/ttyUSB0"
video = "v4l2:/dev/video0"
times = ["1/4", 0.001]
[probe]
lens = { model = "equisolid", fov = 190 }
shot = [{ bracket = "front" }, { bracket = "back", yaw = -180 }]
[[bracket]]
name = "plate"
frames = ["photos/p1.jpg", "photos/p2.jpg"]
times = [0.1, 0.2]
[calibrate]
images = ["photos/board_*.jpg"]
target = "chessboard:9x6:0.025"
[align]
picture = "front"
points = [[1, 2], [3, 4], [5.5, 6], [7, 8]]
width = 0.45
[[stand_in]]
name = "floor"
kind = "plane"
size = [2, 2]
[[object]]
name = "ball"
mesh = "sphere"
material = { kind = "diffuse", color = [0.1, 0.2, 0.3] }
[[view]]
name = "main"
bracket = "plate"
points = [[1, 2], [3, 4], [5.5, 6], [7, 8]]
[[view]]
name = "wide"
model = "equisolid"
[render]
spp = 64
"""

PHOTOS = ("p1.jpg", "p2.jpg", "board_1.jpg", "board_2.jpg")

#: what `make` runs for FULL, as the fake chromeball logs it
ALL = {
    "acquire bracket --device",
    "acquire import photos/p1.jpg",
    "hdr response takes/front",
    "hdr merge takes/front",
    "hdr merge takes/back",
    "hdr merge takes/plate",
    "calibrate lens photos/board_1.jpg",
    "envmap align scene.toml",
    "envmap probe build/front.exr",
    "envmap lights build/env.exr",
    "calibrate pose --camera",
    "stand-in build scene.toml",
    "stand-in depth build/stand_in.ply",
    "render scene.toml --view",
    "report scene.toml -o",
}


def photograph(folder: Path, names: tuple[str, ...] = PHOTOS) -> None:
    """Files for the names of FULL; nothing opens them."""
    (folder / "photos").mkdir(exist_ok=True)
    for name in names:
        (folder / "photos" / name).write_bytes(b"jpeg")
