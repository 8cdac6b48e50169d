"""Cameras by a moving light beside pycolmap's incremental mapper, virtual and real sets."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.calibrate.virtual_wand import path, room, watch
from chromeball.calibrate.wand import solve_wand
from chromeball.calibrate.wand_files import read_lens, read_points
from chromeball.calibrate.wand_result import Tracks
from chromeball.calibrate.wand_world import similarity
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

DATA = Path(__file__).resolve().parents[1].parent / (
    "shared/data/calibrate/multicamselfcal/strawlab/test-data"
)
FRAMES = 800
CAMERAS = 6
#: COLMAP's pixels have their centres at halves.
HALF = 0.5


def rows(quick: bool) -> list[Row]:
    """Camera centres of virtual rooms, the similarity taken out, and residuals of real sets."""
    seeds = 2 if quick else 5
    found: list[Row] = []
    for lenses, outliers in (("given", 0.0), ("given", 0.03), ("given", 0.4), ("blind", 0.03)):
        found.extend(_virtual(seeds, lenses, outliers))
    found.extend(_two_lights(1 if quick else 3))
    return [*found, *(_real() if DATA.is_dir() else [])]


def _virtual(seeds: int, lenses: str, outliers: float) -> list[Row]:
    errors: dict[str, list[float]] = {"chromeball": [], "pycolmap": []}
    seconds = dict.fromkeys(errors, np.inf)
    for seed in range(seeds):
        cameras, tracks = _room(seed, outliers)
        given = tuple(cameras) if lenses == "given" else None
        for tool, solve in (("chromeball", _ours), ("pycolmap", _pycolmap)):
            start = time.process_time()
            centres = solve(tracks, given)
            seconds[tool] = min(seconds[tool], time.process_time() - start)
            errors[tool].append(_miss(centres, cameras))
    what = (
        f"{CAMERAS} cameras round a room, {FRAMES} lights, noise 0.3 px, "
        f"{outliers:.0%} outliers, lenses {lenses}, centres"
    )
    return [
        Row("calibrate", what, tool, seconds[tool], float(np.median(miss)), "mm",
            f"median of {seeds}, worst {np.max(miss):.2f} mm")
        for tool, miss in errors.items()
    ]  # fmt: skip


def _two_lights(seeds: int) -> list[Row]:
    """A wand of known length, nothing else: the scale is its own, too."""
    miss: list[float] = []
    seconds = np.inf
    for seed in range(seeds):
        cameras = room(CAMERAS, radius=3.5, distortion=(-0.2, 0.05), seed=seed)
        points = path(FRAMES // 2, extent=1.4, lights=2, length=0.5, seed=seed)
        tracks = watch(cameras, points, outliers=0.03, seed=seed)
        start = time.process_time()
        rig = solve_wand(tracks, lengths=((0, 1, 0.5),))
        seconds = min(seconds, time.process_time() - start)
        first = cameras[0].world_from_camera.inverse()
        truth = np.array([first.apply(c.world_from_camera.translation) for c in cameras])
        rotation, shift, _ = similarity(rig.centres, truth, scaled=False)
        left = rig.centres @ rotation.T + shift - truth
        miss.append(1000 * float(np.linalg.norm(left, axis=1).mean()))
    what = (
        f"{CAMERAS} cameras, {FRAMES // 2} frames of a wand of two, 3% outliers, lenses blind"
    )
    return [
        Row("calibrate", what, "chromeball", seconds, float(np.median(miss)), "mm",
            f"rigid, scale by the wand; median of {seeds}, worst {np.max(miss):.2f} mm")
    ]  # fmt: skip


def _room(seed: int, outliers: float) -> tuple[list[CameraModel], Tracks]:
    cameras = room(CAMERAS, radius=3.5, distortion=(-0.2, 0.05), seed=seed)
    points = path(FRAMES, extent=1.4, seed=seed)
    return cameras, watch(cameras, points, outliers=outliers, seed=seed)


def _miss(centres: NDArray[np.float64] | None, cameras: list[CameraModel]) -> float:
    """Mean distance of centres from the truth, mm; infinite where a camera is missing."""
    if centres is None:
        return np.inf
    truth = np.array([c.world_from_camera.translation for c in cameras])
    rotation, shift, factor = similarity(centres, truth)
    left = factor * centres @ rotation.T + shift - truth
    return 1000 * float(np.linalg.norm(left, axis=1).mean())


def _ours(
    tracks: Tracks, cameras: tuple[CameraModel, ...] | None
) -> NDArray[np.float64] | None:
    try:
        return solve_wand(tracks, cameras).centres
    except UserError:
        return None


def _pycolmap(
    tracks: Tracks, cameras: tuple[CameraModel, ...] | None
) -> NDArray[np.float64] | None:
    model = _mapped(tracks, cameras)
    if model is None:
        return None
    images = {image.name: image for image in model.images.values()}
    if len(images) < len(tracks.names):
        return None
    return np.array([images[name].projection_center() for name in tracks.names])


def _mapped(tracks: Tracks, cameras: tuple[CameraModel, ...] | None) -> Any:
    """Its largest reconstruction, the tracks as keypoints of one picture a camera, or None."""
    import pycolmap

    pycolmap.logging.minloglevel = 3
    seen = tracks.seen()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tracks.db"
        database = pycolmap.Database.open(file)
        order: list[NDArray[np.intp]] = []
        for c, (name, (width, height)) in enumerate(
            zip(tracks.names, tracks.sizes, strict=True)
        ):
            if cameras is None:
                f = 1.2 * max(width, height)
                params = [f, f, width / 2, height / 2, 0, 0, 0, 0]
            else:
                params = cameras[c].intrinsics.tolist()
                params[2:4] = [params[2] + HALF, params[3] + HALF]
            camera = pycolmap.Camera(
                model="OPENCV", width=width, height=height, params=params, camera_id=c + 1,
                has_prior_focal_length=cameras is not None,
            )  # fmt: skip
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=c + 1)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
            image = pycolmap.Image(name=name, camera_id=c + 1, image_id=c + 1)
            image.frame_id = c + 1
            frame = pycolmap.Frame(frame_id=c + 1, rig_id=c + 1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_image(image, use_image_id=True)
            order.append(np.flatnonzero(seen[c]))
            pixels = tracks.pixels[c, order[c], 0] + HALF
            database.write_keypoints(c + 1, pixels.astype(np.float32))
        for i in range(len(order)):
            for j in range(i):
                _, first, second = np.intersect1d(order[j], order[i], return_indices=True)
                matches = np.stack([first, second], axis=1).astype(np.uint32)
                database.write_matches(j + 1, i + 1, matches)
        database.close()
        pycolmap.geometric_verification(file)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        options.min_model_size = 2
        blind = cameras is None
        options.ba_refine_focal_length = blind
        options.ba_refine_extra_params = blind
        options.ba_refine_principal_point = False
        options.extract_colors = False
        maps = pycolmap.incremental_mapping(file, folder, folder, options)
    return max(maps.values(), key=lambda m: m.num_reg_images(), default=None)


def _real() -> list[Row]:
    """RMS per light of what each tool keeps, and how much that is."""
    folder = DATA / "caldata20130726_122220"
    others = {"3 cameras x 890": "DATA20090709_111010", "4 x 1125": "DATA20100906_134124"}
    tracks = read_points(folder)
    lenses = tuple(
        read_lens(folder / f"basename{i + 1}.rad", size) for i, size in enumerate(tracks.sizes)
    )
    tasks: list[tuple[str, Tracks, tuple[CameraModel, ...] | None]] = [
        ("4 x 464, lenses given", tracks, lenses),
        ("4 x 464, lenses blind", tracks, None),
        *(
            (f"{what}, lenses blind", read_points(DATA / name), None)
            for what, name in others.items()
        ),
    ]
    found: list[Row] = []
    for what, seen, given in tasks:
        total = int(seen.seen().sum())
        start = time.process_time()
        rig = solve_wand(seen, given)
        seconds = time.process_time() - start
        kept = int(np.isfinite(rig.residuals[..., 0]).sum())
        mean = float(np.nanmean(np.linalg.norm(rig.residuals, axis=-1)))
        start = time.process_time()
        model = _mapped(seen, given)
        theirs = time.process_time() - start
        what = f"MultiCamSelfCal's LED set, {what}, mean residual"
        found.append(
            Row("calibrate", what, "chromeball", seconds, mean, "px",
                f"{kept} of {total} sightings kept")
        )  # fmt: skip
        error = np.nan if model is None else float(model.compute_mean_reprojection_error())
        note = (
            "none"
            if model is None
            else (
                f"{model.compute_num_observations()} of {total} sightings kept, "
                f"{model.num_reg_images()} cameras"
            )
        )
        found.append(Row("calibrate", what, "pycolmap", theirs, error, "px", note))
    return found
