"""Environment maps: all that this room measures."""

from __future__ import annotations

from bench.envmap_align import rows as align_rows
from bench.envmap_lights import rows as lights_rows
from bench.envmap_probe import rows as probe_rows
from bench.envmap_stitch import rows as stitch_rows
from bench.envmap_update import rows as update_rows
from bench.envmap_warp import rows as warp_rows
from bench.row import Row


def rows(quick: bool) -> list[Row]:
    """Conversion, probes, lights, stitching, alignment, changing light."""
    parts = (warp_rows, align_rows, update_rows, probe_rows, lights_rows, stitch_rows)
    return [row for part in parts for row in part(quick)]
