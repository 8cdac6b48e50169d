"""Each stage's error against the truth of an example: ``build/truth.json`` for the report.

Nothing else reads the truth folder. It holds ``truth.json`` (the sensor's response, the carpet,
the plate's exposure times), ``front.cameramodel``, ``view.cameramodel``, ``env.exr``,
``changed.png`` and ``objects_N.png``, the photographs with the real objects; the radiance
before the probe is ``set/front.exr``.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.cli.report.figures import TruthError
from chromeball.hdr.merge import merge_frames
from chromeball.hdr.response_file import Response, read_response
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import read_image, read_rgb, to_display, write_picture
from chromeball.scene.manifest import Scene
from chromeball.scene.record import Stage, read_json, write_json


def compare(scene: Scene, folder: Path) -> None:
    """Compare what the stages made in `folder` / `scene.folder` with the truth."""
    assert scene.truth is not None
    truth, build = folder / scene.truth.folder, folder / scene.folder
    known = read_json(truth / "truth.json")
    view = next(view for view in scene.view if view.bracket)
    inputs = [
        build / "response.json",
        build / "front.exr",
        build / "lens.cameramodel",
        build / "align.json",
        build / "env.exr",
        build / f"{view.name}.cameramodel",
        build / f"{view.name}.exr",
    ]
    middle = float(known["middle"])
    with Stage("truth", inputs=[*inputs, truth / "truth.json"]) as stage:
        log_exposure = np.array(known["log_exposure"])
        errors = [
            *response_errors(read_response(inputs[0]), log_exposure),
            *radiance_errors(read_rgb(inputs[1]), read_rgb(folder / "set/front.exr") / middle),
            *lens_errors(
                CameraModel.read(inputs[2]), CameraModel.read(truth / "view.cameramodel")
            ),
            *align_errors(
                read_json(inputs[3]),
                CameraModel.read(truth / "front.cameramodel"),
                float(known["carpet"][1]),
            ),
            *irradiance_errors(read_rgb(inputs[4]), read_rgb(truth / "env.exr") / middle),
            *pose_errors(
                CameraModel.read(inputs[5]), CameraModel.read(truth / "view.cameramodel")
            ),
        ]
        frames = [
            read_image(truth / f"objects_{i}.png").pixels for i in range(len(known["times"]))
        ]
        photograph = merge_frames(
            frames, np.array(known["times"]), Response.from_log_exposure(log_exposure)
        ).radiance
        changed = read_image(truth / "changed.png").pixels[..., 0] > 127
        composite = read_rgb(inputs[6])
        errors += composite_errors(composite, photograph, changed)
        stage.figures["errors"] = [asdict(error) | {"kept": error.kept} for error in errors]
        stage.figures["kept"] = sum(error.kept for error in errors)
        stage.figures["picture"] = "truth.png"
        with stage.output(build / "truth.png") as temporary:
            write_picture(temporary, side_by_side(composite, photograph, changed))
        with stage.output(build / "truth.json") as temporary:
            write_json(temporary, stage.figures)


def response_errors(found: Response, log_exposure: NDArray[np.float64]) -> list[TruthError]:
    """RMS of ln exposure over the codes 10 .. 245 of all channels."""
    codes = slice(10, 246)
    difference = found.log_exposure[:, codes] - log_exposure[:, codes]
    rms = float(np.sqrt(np.mean(difference**2)))
    return [
        TruthError("response", "curve, RMS of ln exposure, codes 10-245", 100 * rms, "%", 3.0)
    ]


def radiance_errors(
    merged: NDArray[np.float32], radiance: NDArray[np.float32]
) -> list[TruthError]:
    """Relative error of the merged fisheye frame, pixel by pixel, inside the lens circle."""
    seen = radiance.min(axis=2) > 0
    error = merged[seen] / radiance[seen] - 1
    return [
        TruthError(
            "radiance", "merged frame, median", 100 * float(np.median(abs(error))), "%", 2.0
        ),
        TruthError(
            "radiance", "merged frame, bias", 100 * abs(float(np.median(error))), "%", 1.0
        ),
    ]


def lens_errors(found: CameraModel, true: CameraModel) -> list[TruthError]:
    """RMS pixel difference over the picture after the best rotation between the two lenses."""
    width, height = true.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    a, b = found.unproject(pixels), true.unproject(pixels)
    u, _, vt = np.linalg.svd(b.T @ a)  # Wahba's problem: b = R a
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    difference = true.project(a @ rotation.T) - pixels
    rms = float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
    return [TruthError("camera", "lens, RMS over the picture", rms, "px", 0.5)]


def pose_errors(found: CameraModel, true: CameraModel) -> list[TruthError]:
    """Place and direction of the view camera."""
    a, b = found.world_from_camera, true.world_from_camera
    offset = float(np.linalg.norm(a.translation - b.translation))
    turn = math.degrees(float(np.linalg.norm((a.inverse() @ b).rotation_vector())))
    return [
        TruthError("camera", "place in the room", 1000 * offset, "mm", 30.0),
        TruthError("camera", "direction", turn, "deg", 0.5),
    ]


def align_errors(align: dict[str, object], true: CameraModel, depth: float) -> list[TruthError]:
    """Floor plane, heading, place of the probe and the rectangle's other side."""
    found = np.array(align["world_from_camera"], float)
    pose = true.world_from_camera
    between = found[:3, :3] @ pose.rotation.T  # world as found from the true world
    tilt = math.degrees(math.acos(float(np.clip(between[1, 1], -1, 1))))
    yaw = math.degrees(abs(math.atan2(between[0, 2], between[2, 2])))
    offset = float(np.linalg.norm(found[:3, 3] - pose.translation))
    derived = abs(float(np.asarray(align["depth"])) / depth - 1)
    return [
        TruthError("alignment", "tilt of the floor", tilt, "deg", 0.5),
        TruthError("alignment", "heading", yaw, "deg", 0.5),
        TruthError("alignment", "place of the probe", 1000 * offset, "mm", 25.0),
        TruthError("alignment", "scale, by the carpet's other side", 100 * derived, "%", 2.0),
    ]


def irradiance_errors(
    found: NDArray[np.float32], true: NDArray[np.float32]
) -> list[TruthError]:
    """Relative error of the irradiance on surfaces facing the six axes, all channels."""
    difference = irradiance(found) / irradiance(true) - 1
    return [
        TruthError(
            "environment", "irradiance up", 100 * abs(float(difference[2].mean())), "%", 1.5
        ),
        TruthError(
            "environment",
            "irradiance, worst of 6 normals",
            100 * float(abs(difference).max()),
            "%",
            3.0,
        ),
    ]


def irradiance(env: NDArray[np.float32]) -> NDArray[np.float64]:
    """Irradiance (6, 3) on +X -X +Y -Y +Z -Z from a lat-long map in world axes."""
    height, width, _ = env.shape
    camera = CameraModel.latlong((width, height))
    direction = camera.rays(camera.pixel_grid())
    edges = np.cos(np.linspace(0, math.pi, height + 1))
    solid_angle = (edges[:-1] - edges[1:]) * (2 * math.pi / width)
    normals = np.repeat(np.eye(3), 2, axis=0) * np.tile([[1.0], [-1.0]], (3, 1))
    cosine = np.maximum(direction @ normals.T, 0) * solid_angle[:, None, None]
    return np.einsum("yxn,yxc->nc", cosine, env.astype(float))


def composite_errors(
    composite: NDArray[np.float32], photograph: NDArray[np.float32], changed: NDArray[np.bool_]
) -> list[TruthError]:
    """Relative error over the pixels that the objects change, all channels."""
    error = abs(composite[changed] / np.maximum(photograph[changed], 1e-6) - 1)
    return [
        TruthError(
            "composite", "changed pixels, median", 100 * float(np.median(error)), "%", 3.0
        ),
        TruthError(
            "composite",
            "changed pixels, 90 % of them",
            100 * float(np.quantile(error, 0.9)),
            "%",
            15.0,
        ),
    ]


def side_by_side(
    composite: NDArray[np.float32], photograph: NDArray[np.float32], changed: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Composite, photograph, and their relative difference (white is 20 %) where changed."""
    exposure = 0.6 / float(np.quantile(photograph, 0.9))
    error = abs(composite / np.maximum(photograph, 1e-6) - 1).mean(axis=2) * changed
    grey = np.repeat((255 * np.clip(error / 0.2, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)
    return np.concatenate(
        [to_display(composite, exposure), to_display(photograph, exposure), grey], axis=1
    )
