"""The same code on one thread and on two."""

from __future__ import annotations

import os
import subprocess
import sys


def printed_by_threads(code: str) -> set[str]:
    """What Python `code` prints on one processor and on all; one string if it is the same."""
    pin = (
        "import os, sys\n"
        "if sys.argv[1] == '1': os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    )
    return {
        subprocess.run(
            [sys.executable, "-c", pin + code, threads],
            check=True,
            capture_output=True,
            text=True,
            env=os.environ,
        ).stdout
        for threads in "12"
    }
