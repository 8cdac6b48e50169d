"""``chromeball calibrate``: lenses and their fall-off, poses, undistorted pictures."""

from cyclopts import App

from chromeball.cli.calibrate.convert import convert
from chromeball.cli.calibrate.exif import exif
from chromeball.cli.calibrate.lens import lens
from chromeball.cli.calibrate.match import match
from chromeball.cli.calibrate.pose import pose
from chromeball.cli.calibrate.realign import realign
from chromeball.cli.calibrate.rig import rig
from chromeball.cli.calibrate.track import track
from chromeball.cli.calibrate.tracker import tracker
from chromeball.cli.calibrate.undistort import undistort
from chromeball.cli.calibrate.vignette import app as vignette
from chromeball.cli.calibrate.wand import wand

app = App(name="calibrate", help="Cameras and their poses.")
for _command in (
    convert,
    exif,
    lens,
    match,
    pose,
    realign,
    rig,
    track,
    tracker,
    undistort,
    wand,
):
    app.command(_command)
app.command(vignette)
