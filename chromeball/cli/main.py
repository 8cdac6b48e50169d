"""The ``chromeball`` command: groups are imported when they are used, errors are one line."""

from __future__ import annotations

import sys

from cyclopts import App

from chromeball.scene.errors import UserError

#: group -> (module that holds its `app`, one line of help)
GROUPS = {
    "acquire": ("chromeball.cli.acquire", "Devices and folders of photographs to takes."),
    "emulate": ("chromeball.cli.emulate", "A device on a pseudo-terminal."),
    "hdr": ("chromeball.cli.hdr", "Response curves and radiance maps."),
    "calibrate": ("chromeball.cli.calibrate", "Cameras and their poses."),
    "envmap": ("chromeball.cli.envmap", "The light around a point."),
    "stand-in": ("chromeball.cli.stand_in", "The geometry of the set."),
}
#: commands of the root itself: name -> "module:function"
COMMANDS = {
    "new": "chromeball.cli.new:new",
    "demo": "chromeball.cli.new:demo",
    "plan": "chromeball.cli.plan:plan",
    "render": "chromeball.cli.render:render",
    "report": "chromeball.cli.report:report",
    "bench": "chromeball.cli.bench:bench",
}


def build_app() -> App:
    """The root application, with every group lazy: only the module in use is imported."""
    app = App(
        name="chromeball",
        help="Capture light, calibrate cameras and insert synthetic objects into real places.",
    )
    for name, target in COMMANDS.items():
        app.command(target, name=name)
    for name, (module, summary) in GROUPS.items():
        app.command(f"{module}:app", name=name, help=summary)
    return app


def main() -> None:
    """Run the command line; exit 2 on a user's mistake, 1 or 3 where the error says so."""
    try:
        build_app()()
    except UserError as error:
        print(f"chromeball: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
