"""The ``chromeball`` command: groups are imported when they are used, errors are one line."""

from __future__ import annotations

import difflib
import math
import os
import sys
from typing import TYPE_CHECKING

from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from cyclopts import App

#: group -> (module that holds its `app`, one line of help)
GROUPS = {
    "acquire": ("chromeball.cli.acquire", "Devices and folders of photographs to takes."),
    "emulate": ("chromeball.cli.emulate", "A device on a pseudo-terminal."),
    "hdr": ("chromeball.cli.hdr", "Response curves and radiance maps."),
    "calibrate": ("chromeball.cli.calibrate", "Cameras and their poses."),
    "envmap": ("chromeball.cli.envmap", "The light around a point."),
    "stand-in": ("chromeball.cli.stand_in", "The geometry of the set."),
}
#: commands of the root itself: name -> ("module:function", one line of help)
COMMANDS = {
    "new": ("chromeball.cli.new:new", "A scene folder with scene.toml and Makefile."),
    "demo": ("chromeball.cli.new:demo", "Photograph the virtual set and run every stage."),
    "plan": ("chromeball.cli.plan:plan", "What a scene needs, what is up to date, and why."),
    "render": ("chromeball.cli.render:render", "Synthetic objects into a photograph."),
    "view": ("chromeball.cli.view:view", "A scene in the browser, to move and to change."),
    "report": ("chromeball.cli.report:report", "One HTML file on what was done, and how well."),
    "export": ("chromeball.cli.export:export", "Cameras as other programs read them."),
    "bench": ("chromeball.cli.bench:bench", "Run time against error, beside the peers."),
}
SUMMARY = "Capture light, calibrate cameras and insert synthetic objects into real places."


def build_app() -> App:
    """The root application, with every group lazy: only the module in use is imported."""
    from cyclopts import App, Parameter

    app = App(
        name="chromeball",
        help=SUMMARY,
        help_format="plaintext",
        default_parameter=Parameter(validator=_finite),
    )
    for name, (target, _) in COMMANDS.items():
        app.command(target, name=name)  # its docstring is its help
    for name, (module, summary) in GROUPS.items():
        app.command(f"{module}:app", name=name, help=summary)
    return app


def _finite(_: object, value: object) -> None:
    """No option of any command takes NaN or infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("the number must be finite")


def overview() -> str:
    """The root's help, known without importing the parser of command lines."""
    commands = {**COMMANDS, **GROUPS}
    lines = [f"  {name:10} {summary}" for name, (_, summary) in commands.items()]
    return "\n".join(
        [
            "Usage: chromeball COMMAND ...\n",
            f"{SUMMARY}\n",
            *lines,
            "\n`chromeball COMMAND --help` says more; --version prints the version.",
        ]
    )


def main() -> None:
    """Run the command line; exit 2 on a user's mistake, 1 or 3 where the error says so.

    What is our own fault keeps its traceback and exits 1.
    """
    try:
        match sys.argv[1:]:
            case [] | ["--help" | "-h"]:
                print(overview())
            case ["--version"]:
                from importlib.metadata import version

                print(version("chromeball"))
            case [name, *_] if not name.startswith("-") and name not in {**COMMANDS, **GROUPS}:
                close = difflib.get_close_matches(name, [*COMMANDS, *GROUPS], n=1)
                near = f"; did you mean {close[0]!r}?" if close else "; see chromeball --help"
                raise UserError(f"there is no command {name!r}{near}")
            case arguments:
                _run(arguments)
        sys.stdout.flush()
    except UserError as error:
        _complain(str(error))
        sys.exit(error.exit_code)
    except MemoryError as error:
        _complain(f"not enough memory: {error}")
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # the reader of our output has gone; nothing more can be said to it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)


def _run(arguments: list[str]) -> None:
    from cyclopts import CycloptsError

    try:
        build_app()(arguments, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        _complain(str(error))
        sys.exit(2)


def _complain(message: str) -> None:
    print("chromeball:", " ".join(message.split()), file=sys.stderr)
