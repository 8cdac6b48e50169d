"""What ``envmap probe`` does with shots once it knows what is asked for."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chromeball.cli.envmap.arguments import (
    check_panorama_width,
    clicked_shot,
    print_figures,
    read_camera,
    read_mask,
    write_panorama,
)
from chromeball.scene.errors import UserError
from chromeball.scene.vignette import check_once
from chromeball.scene.vignette_option import file_of, read_given

if TYPE_CHECKING:
    from chromeball.envmap.mapping import Mapping
    from chromeball.envmap.picture import Radiance
    from chromeball.envmap.probe import Shot
    from chromeball.scene.camera import CameraModel


@dataclass(frozen=True)
class Request:
    """What is to be done, however it was said; angles in degrees, one of each per shot.

    ``lenses`` are camera models or what says one for a picture's size; ``fill`` a photograph
    and its camera.
    """

    files: list[Path]
    yaw: list[float]
    pitch: list[float]
    roll: list[float]
    lenses: list[str | Path | None]
    balls: list[list[float] | None]
    masks: list[Path | None]
    vignetting: str | None
    photographer: float
    reflectance: list[float]
    trim: float
    refine: bool
    refine_lens: bool
    ground: list[float] | None
    fill: tuple[Path, Path] | None
    align: Path | None
    clicked: int | None
    width: int

    @property
    def inputs(self) -> list[Path]:
        """All files that it reads, each once."""
        cameras = [lens for lens in self.lenses if isinstance(lens, Path)]
        others = [*self.masks, self.align, *(self.fill or ()), *file_of(self.vignetting)]
        named = [*self.files, *cameras, *(path for path in others if path is not None)]
        return list(dict.fromkeys(named))


def make_map(request: Request, output: Path, as_json: bool) -> None:
    """Carry out what was asked for."""
    import numpy as np

    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.complete import Source
    from chromeball.envmap.mapping import LatLong
    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.probe import combine, refined, trimmed, world_from_shots
    from chromeball.envmap.refine_lens import refine_lenses
    from chromeball.scene.record import Stage, check_output

    check_panorama_width(request.width)
    files, clicked = request.files, request.clicked
    if clicked is not None and request.align is None:
        raise UserError(f"--clicked {clicked} is for --align")
    check_output(output, request.inputs, ".exr")
    settings = {"width": request.width, "vignetting": request.vignetting}
    with Stage("envmap probe", request.inputs, **settings) as stage:
        pictures = {file: read_radiance(file) for file in dict.fromkeys(files)}
        for note in _guessed_circles(request, pictures):
            print(f"note: {note}", file=sys.stderr)
        shots: list[Shot] = []
        clipped: list[float] = []
        for k, file in enumerate(files):
            shot, bound = _shot(request, k, pictures[file])
            shots.append(shot)
            clipped += [] if bound is None else [bound]
        index = 0
        if request.align is not None:
            pose, picture = read_alignment(request.align)
            index = clicked_shot([file.stem for file in files], clicked, picture, request.align)
            rotations = world_from_shots(shots, index, pose.rotation)
            origin = pose.translation
        else:
            rotations, origin = world_from_shots(shots), None
        if request.refine_lens:
            solved = refine_lenses(shots, rotations, index)
            shots, rotations = solved.shots, solved.rotations
            stage.figures["lens"] = {
                "fov_degrees": math.degrees(solved.fov),
                "fov_sigma_degrees": math.degrees(solved.fov_sigma),
                "centres": solved.centres,
                "centre_sigma": solved.centre_sigma,
                "correlation": solved.correlation,
                "as_option": " ".join(map(_lens_option, request.lenses, shots)),
            }
        elif request.refine and len(shots) > 1:
            rotations, found = refined(shots, rotations, index)
            stage.figures["refined"] = {
                "degrees": np.degrees(found.angles),
                "sigma_degrees": np.degrees(found.sigma),
                "correlation": found.correlation,
                "kept_as_given_because": found.reason or None,
            }
            if found.reason:
                print(f"directions kept as given: {found.reason}", file=sys.stderr)
        if request.trim:
            shots = [trimmed(shot, math.radians(request.trim)) for shot in shots]
        result = combine(shots, rotations, request.width)
        missing = result.alpha == 0
        if missing.all():
            raise UserError("no pixel of any shot can be used: check --lens, --ball and masks")
        completed, ratio = _complete(request, result.radiance, missing)
        solid = LatLong((request.width, request.width // 2)).solid_angles()
        energy = np.einsum("hwc,hw->hw", result.radiance, solid)
        share = float(energy[missing].sum() / max(float(energy.sum()), 1e-300))
        unseen = float((solid * (1 - result.alpha)).sum())
        stage.figures |= {
            "size": [request.width, request.width // 2],
            "shots": [file.stem for file in files],
            "origin": origin,
            "energy_error": result.energy_error,
            "hot_pixels": result.hot_pixels,
            "overlaps": [
                {
                    "shots": overlap.shots,
                    "median_ratio": overlap.ratio,
                    "spread": overlap.spread,
                    "solid_angle": overlap.solid_angle,
                }
                for overlap in result.overlaps
            ],
            "completed_solid_angle": unseen,
            "completed_share": share,
            "completed_from": {
                source.name.lower(): float(solid[completed == source].sum())
                for source in Source
                if source != Source.SEEN and (completed == source).any()
            },
            "seen_over_fill": ratio,
            "clipped_solid_angle": clipped or None,  # too bright for every exposure: a bound
        }
        kept = dict(pictures[files[0]].attributes)
        write_panorama(
            stage,
            output,
            result.radiance,
            result.alpha,
            kept,
            origin,
            completed,
            result.clipped,
            result.sigma,
        )
    if unseen > 0.01:
        print(
            f"{unseen:.2f} sr were seen by no shot and are completed "
            f"(alpha 0); {100 * share:.1f} % of the light lies there",
            file=sys.stderr,
        )
    print_figures(stage.figures, as_json, output)


def _shot(request: Request, k: int, image: Radiance) -> tuple[Shot, float | None]:
    """Shot k, ready to be placed, and the solid angle of what was clipped in it."""
    import numpy as np

    from chromeball.envmap.ball import ball_in_circle
    from chromeball.envmap.mapping import Lens, of_camera
    from chromeball.envmap.probe import Shot, without_vignetting
    from chromeball.scene.vignette import Vignette

    file, ball = request.files[k], request.balls[k]
    camera = _camera(request.lenses[k], image.size, file)
    rgb, valid, clipped, sigma = image.rgb, image.valid, image.clipped, image.sigma
    falloff = None if request.vignetting is None else read_given(request.vignetting)
    if falloff is not None:
        check_once(image.attributes, file)
    if isinstance(falloff, Vignette):  # of the whole picture, before a ball is cut out of it
        gain = np.float32(1) / falloff.picture(image.size)[..., None]
        rgb, sigma, falloff = rgb * gain, None if sigma is None else sigma * gain, None
    mask = request.masks[k]
    if mask is not None:
        allowed = read_mask(mask, image.size, file)
        valid = allowed if valid is None else valid & allowed
    if ball is not None:
        x, y, radius = ball
        try:
            seen, part = ball_in_circle(image.size, (x, y), radius, camera).cut_out()
        except UserError as error:
            raise UserError(error.what, file=file) from error
        reflectance = np.array(request.reflectance, np.float32)
        rgb = np.ascontiguousarray(rgb[part] / reflectance)
        sigma = None if sigma is None else np.ascontiguousarray(sigma[part] / reflectance)
        valid = None if valid is None else np.ascontiguousarray(valid[part])
        clipped = None if clipped is None else clipped[part]
        mapping: Mapping = Lens((rgb.shape[1], rgb.shape[0]), camera=seen)
    else:
        assert camera is not None
        mapping = of_camera(camera)
    a, b, c = (math.radians(float(v[k])) for v in (request.yaw, request.pitch, request.roll))
    if not 0 <= request.photographer < 120:
        raise UserError(f"--photographer {request.photographer:g}: from 0 to 120 degrees")
    back = math.radians(request.photographer) if ball is not None else 0.0
    shot = Shot(rgb, mapping, a, b, c, valid, back, clipped, sigma)
    try:
        if falloff is not None:
            shot = without_vignetting(shot, falloff)
    except UserError as error:
        raise UserError(error.what, file=file) from error
    bound = None if clipped is None else float(shot.mapping.solid_angles()[clipped].sum())
    return shot, bound


def _guessed_circles(request: Request, pictures: dict[Path, Radiance]) -> list[str]:
    """Where a lens's circle was not given, and the picture's shape does not tell it."""
    notes: list[str] = []
    for file, lens in dict(zip(request.files, request.lenses, strict=True)).items():
        width, height = pictures[file].size
        if isinstance(lens, str) and lens.count(":") < 2 and width != height:
            notes.append(
                f"{file.name}: the lens's circle is taken to be {min(width, height)} px wide, "
                "as the picture's short side; if the picture cuts it off, give "
                "--lens MODEL:FOV:cx,cy,radius"
            )
    return notes


def _lens_option(spec: str | Path | None, shot: Shot) -> str:
    """A solved lens as --lens takes it."""
    from chromeball.envmap.mapping import Radial

    lens = shot.mapping
    assert isinstance(lens, Radial)
    model = str(spec).split(":", 1)[0]
    (x, y), radius = lens.centre, lens.rim * lens.focal[0]
    return f"{model}:{2 * math.degrees(lens.max_angle):.4f}:{x:.2f},{y:.2f},{radius:.2f}"


def _camera(lens: str | Path | None, size: tuple[int, int], file: Path) -> CameraModel | None:
    from chromeball.envmap.mapping import parse_lens

    if isinstance(lens, Path):
        return read_camera(lens, size, file)
    return None if lens is None else parse_lens(lens, size)


def _complete(request: Request, radiance: Any, missing: Any) -> tuple[Any, float | None]:
    """Fill what is missing, best first; where from, and how well the photograph fits."""
    import numpy as np

    from chromeball.envmap.complete import Source, from_border, from_plate, ground
    from chromeball.envmap.mapping import of_camera
    from chromeball.envmap.picture import read_radiance

    completed = np.zeros(missing.shape, np.uint8)
    seen, left, ratio = ~missing, missing.copy(), None
    if request.fill is not None:
        plate = read_radiance(request.fill[0])
        model = read_camera(request.fill[1], plate.size, request.fill[0])
        mapping = of_camera(model).turned(model.world_from_camera.rotation)
        filled, ratio = from_plate(radiance, left, plate.rgb, mapping)
        completed[filled] = Source.PLATE
        left &= ~filled
    if request.ground is not None:
        filled = ground(radiance, left, np.array(request.ground), seen)
        completed[filled] = Source.GROUND
        left &= ~filled
    completed[from_border(radiance, left)] = Source.BORDER
    return completed, ratio
