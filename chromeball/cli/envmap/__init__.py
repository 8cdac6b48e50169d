"""``chromeball envmap``: the light around a point."""

from cyclopts import App

from chromeball.cli.envmap.align import align
from chromeball.cli.envmap.at import at
from chromeball.cli.envmap.check import check
from chromeball.cli.envmap.daytime import daytime
from chromeball.cli.envmap.export import export
from chromeball.cli.envmap.harmonics import harmonics
from chromeball.cli.envmap.lights import lights
from chromeball.cli.envmap.nadir import nadir
from chromeball.cli.envmap.prefilter import prefilter
from chromeball.cli.envmap.probe import probe
from chromeball.cli.envmap.stitch import stitch
from chromeball.cli.envmap.sun import sun
from chromeball.cli.envmap.units import units
from chromeball.cli.envmap.update import update
from chromeball.cli.envmap.warp import warp

app = App(name="envmap", help="The light around a point.")
_MAPS = (warp, align, probe, stitch, nadir, sun, units, check)
_LATER = (update, daytime, at)
for _command in (*_MAPS, *_LATER, lights, harmonics, prefilter, export):
    app.command(_command)
