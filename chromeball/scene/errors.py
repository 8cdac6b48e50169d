"""The errors a person can do something about.

A :class:`UserError` names the file, what is wrong and what to do. The command prints it on
one line and exits with its ``exit_code``; anything else that is raised is our own fault and
keeps its traceback.
"""

from __future__ import annotations

from os import PathLike


class UserError(Exception):
    """A mistake that the user can mend: one line, exit code 2.

    Parameters
    ----------
    what
        What is wrong and what to do, a sentence for a person on a film set at night.
    file
        The file it is about, put in front of the message.

    """

    exit_code = 2

    def __init__(self, what: str, *, file: str | PathLike[str] | None = None) -> None:
        self.what = what
        self.file = None if file is None else str(file)
        super().__init__(what if self.file is None else f"{self.file}: {what}")


class DeviceError(UserError):
    """A device that does not answer, or answers wrongly: exit code 1."""

    exit_code = 1


class QualityError(UserError):
    """A result that misses a quality gate the user has set: exit code 3."""

    exit_code = 3
