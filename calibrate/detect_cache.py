"""Detections kept by content: a picture that was searched for a board is not searched again.

The name of an entry is the hash of the picture's bytes, of the target and of the detector's own
source, so that no entry is ever out of date.
"""

from __future__ import annotations

import functools
import hashlib
import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from chromeball.calibrate.detection import Detection
from chromeball.calibrate.printed import Printed
from chromeball.calibrate.target import Charuco, Target, parse_target
from chromeball.scene.record import atomic_output, content_hash

#: What a detection depends on.
SOURCES = (
    "aprilgrid", "circles", "coded", "detect", "detection", "grow", "markers", "patch",
    "printed", "target",
)  # fmt: skip


def default_folder() -> Path:
    """$CHROMEBALL_CACHE, else chromeball in the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("CHROMEBALL_CACHE") or Path(base) / "chromeball") / "detections"


def entry(folder: Path, file: Path, target: Target, frame: int | None = None) -> Path:
    """Where the detection of `target` in `file`, or a `frame` of that video, is kept."""
    number = "" if frame is None else f" frame {frame}"
    text = f"{_version()} {_content(file)} {target!r} {file.suffix.lower()}{number}"
    return folder / f"{hashlib.blake2b(text.encode(), digest_size=16).hexdigest()}.npz"


def load(path: Path, file: Path) -> Detection | None:
    """The detection kept at `path`, for `file`; None where there is none, or it is damaged."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as kept:
            facts = json.loads(str(kept["facts"]))
            target = parse_target(facts["spec"])
            if isinstance(target, Charuco):
                target = replace(target, legacy=facts["legacy"])
            width, height = facts["size"]
            return Detection(
                file=file,
                size=(width, height),
                corners=kept["corners"],
                sigma=kept["sigma"],
                blur=float(kept["blur"]),
                usable=facts["usable"],
                verdict=facts["verdict"],
                printed=Printed(target, facts["inverted"]),
            )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None  # damaged: it is made and written again


def store(path: Path, detection: Detection) -> None:
    """Keep a detection, whole or not at all."""
    target = detection.printed.target
    facts: dict[str, Any] = {
        "spec": target.spec,
        "legacy": isinstance(target, Charuco) and target.legacy,
        "inverted": detection.printed.inverted,
        "size": detection.size,
        "usable": detection.usable,
        "verdict": detection.verdict,
    }
    with atomic_output(path) as temporary, temporary.open("wb") as out:
        np.savez(
            out,
            corners=detection.corners,
            sigma=detection.sigma,
            blur=np.float64(detection.blur),
            facts=np.array(json.dumps(facts)),
        )


def _content(file: Path) -> str:
    state = file.stat()
    return _hash(file, state.st_size, state.st_mtime_ns)


@functools.lru_cache
def _hash(file: Path, _size: int, _changed: int) -> str:
    """Of a file as it now is: a video is not read again for each of its frames."""
    return content_hash(file)


@functools.cache
def _version() -> str:
    """Of the detector: its source and OpenCV's version."""
    digest = hashlib.blake2b(cv2.__version__.encode(), digest_size=16)
    for name in SOURCES:
        digest.update(Path(__file__).with_name(f"{name}.py").read_bytes())
    return digest.hexdigest()
