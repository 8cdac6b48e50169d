"""What the commands of several probes and of changing light need of the set's geometry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from chromeball.envmap.several import Cast, ProbeMap
    from chromeball.stand_in.ply import StandInMesh

#: Rays that Embree gets at a time.
_RAYS = 1 << 18


def caster(mesh: StandInMesh) -> Cast:
    """Rays against the stand-in, by Embree."""
    import numpy as np

    from chromeball.renderer.mesh import Mesh
    from chromeball.renderer.world import world

    about = mesh.vertices.astype(float).mean(axis=0)
    built = world([Mesh.of(mesh.vertices, mesh.faces, 0.0)], about=about)

    def cast(
        origins: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        distance, normal = np.empty(len(origins)), np.empty((len(origins), 3))
        for start in range(0, len(origins), _RAYS):
            part = np.s_[start : start + _RAYS]
            o = np.ascontiguousarray(origins[part] - about, np.float32)
            d = np.ascontiguousarray(directions[part], np.float32)
            found = built.hits(o, d).reshape(-1, 15)
            distance[part] = found[:, 0]
            n = found[:, 4:7].astype(float)
            normal[part] = np.where((n * d).sum(axis=1, keepdims=True) > 0, -n, n)
        return distance, normal

    return cast


def read_probe(path: Path) -> ProbeMap:
    """A lat-long map with its attribute `origin`."""
    import numpy as np

    from chromeball.envmap.picture import read_latlong
    from chromeball.envmap.several import ProbeMap

    image = read_latlong(path)
    value = image.attributes.get("origin")
    place = np.zeros(0) if value is None else np.ravel(np.asarray(value, float))
    if place.shape != (3,) or not np.isfinite(place).all():
        raise UserError(
            "no attribute `origin` (x, y, z of the light probe in metres): make the map with "
            "`envmap probe --align`",
            file=path,
        )
    return ProbeMap(image.rgb, place, image.valid)
