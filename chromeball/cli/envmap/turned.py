"""A finished panorama into the scene's axes and width."""

from __future__ import annotations

from pathlib import Path

from chromeball.cli.envmap.arguments import (
    check_panorama_width,
    print_figures,
    write_panorama,
)
from chromeball.scene.errors import UserError


def turn_panorama(
    file: Path, aligned: Path | None, width: int, output: Path, as_json: bool
) -> None:
    """A finished panorama into world axes (seeds.md F15)."""
    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.complete import Source, from_border
    from chromeball.envmap.mapping import LatLong, make_mapping
    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.resample import carry
    from chromeball.envmap.resample import warp as resample
    from chromeball.scene.record import Stage, check_output

    check_panorama_width(width)
    check_output(output, [file], ".exr")
    with Stage("envmap probe", [file, *([aligned] if aligned else [])], width=width) as stage:
        image = read_radiance(file)
        kept = dict(image.attributes)
        try:
            source = make_mapping("latlong", image.size)
        except UserError as error:
            raise UserError(error.what, file=file) from error
        origin = kept.get("origin")
        if aligned is not None:
            pose, _ = read_alignment(aligned)
            source, origin = source.turned(pose.rotation), pose.translation
        target = LatLong((width, width // 2))
        result = resample(image.rgb, source, target, valid=image.valid, sigma=image.sigma)
        clipped = None
        if image.clipped is not None and image.clipped.any():
            clipped = carry(image.clipped, source, target, valid=image.valid)
        completed = from_border(result.radiance, result.coverage == 0) * float(Source.BORDER)
        stage.figures |= {
            "size": target.size,
            "origin": origin,
            "energy_error": [float(result.energy.sum() / result.source_energy.sum() - 1)],
            "hot_pixels": result.hot_pixels,
            "completed_solid_angle": float(
                (target.solid_angles() * (1 - result.coverage)).sum()
            ),
        }
        write_panorama(
            stage,
            output,
            result.radiance,
            result.coverage,
            kept,
            origin,
            completed,
            clipped,
            result.sigma,
        )
    print_figures(stage.figures, as_json, output)
