"""What a scene needs: every stage with its reason, files, command and slice of the scene file.

Whether a needed stage is up to date is another question: see `freshness`.
"""

from __future__ import annotations

import glob
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from chromeball.renderer.inputs import scene_inputs
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import (
    Align,
    Bracket,
    Lens,
    Meter,
    Object,
    Probe,
    Quad,
    Scene,
    View,
)
from chromeball.scene.sequence import at, frames_of, moves
from chromeball.scene.vignette_option import file_of

# the suffixes of `chromeball.scene.image`, which is too heavy to import for a plan
RAW_SUFFIXES = frozenset(
    {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"}
)
LINEAR_SUFFIXES = frozenset({".exr", ".hdr", ".pfm"}) | RAW_SUFFIXES
REPORT = "report.html"


@dataclass(frozen=True)
class StagePlan:
    """One stage of a scene; all paths are relative to the scene file's folder.

    ``name`` is the record's stage, followed by the bracket or view where there are several.
    ``reason`` says why the scene needs it, or why not. ``slice`` holds just what of the scene
    file and of the command line the stage depends on. A stage that is not needed has no
    files and no command. ``after``: outputs that must not be made at the same time.
    """

    name: str
    needed: bool
    reason: str
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    slice: dict[str, Any] | None = None
    after: tuple[str, ...] = ()

    def slice_file(self, folder: str) -> str:
        """Where the slice is kept, in the scene's `folder` of made files."""
        return f"{folder}/slices/{self.name.replace(' ', '-')}.json"

    def slice_text(self) -> str:
        """The slice as canonical JSON: the same content is the same text."""
        value = {"command": self.command, "scene": msgspec.to_builtins(self.slice)}
        return json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def stages(scene: Scene, path: Path) -> list[StagePlan]:
    """Every stage of a scene, in the order of the pipeline; `path` is the scene file.

    Writes nothing; reads folders to expand patterns, and the ``take.json`` of finished takes
    to see whether their frames are linear.

    Raises
    ------
    UserError
        Where the scene lacks what a needed stage wants, or two stages would write one file.

    """
    try:
        plan = _Planner(scene, path).plan()
    except UserError as error:
        raise UserError(error.what, file=error.file or path) from error
    makers: dict[str, str] = {}
    for stage in plan:
        for output in stage.outputs:
            if output in makers:
                raise UserError(
                    f"{makers[output]} and {stage.name} would both write {output}; rename one",
                    file=path,
                )
            makers[output] = stage.name
    return plan


def patterns(scene: Scene) -> list[str]:
    """The picture patterns with wildcards, whose matches may change without the scene."""
    names = [frame for bracket in scene.bracket for frame in bracket.frames]
    if scene.calibrate:
        names += scene.calibrate.images
    return [name for name in names if glob.has_magic(name)]


class _Planner:
    """The decisions of one plan, stage by stage in the order of the pipeline."""

    def __init__(self, scene: Scene, path: Path) -> None:
        self.scene = scene
        self.file = path.name
        self.root = path.parent
        self.build = scene.folder.rstrip("/")
        self.frames: dict[str, list[str]] = {}
        self.linear: dict[str, bool] = {}
        self.rendered = scene.view if scene.object or scene.light else []
        self.plates = [view for view in self.rendered if view.bracket or view.plate]
        self.shots = [] if scene.env.file or not scene.probe else scene.probe.shot

    def plan(self) -> list[StagePlan]:
        scene = self.scene
        self._check()
        plan: list[StagePlan] = []
        for bracket in scene.bracket:
            plan.append(self._take(bracket, plan))
        plan += [self._hand(bracket) for bracket in scene.bracket if bracket.handheld]
        plan.append(self._response())
        metered = scene.hdr.meter.bracket if scene.hdr.meter else None
        first = sorted(scene.bracket, key=lambda bracket: bracket.name != metered)
        plan += [self._merge(bracket) for bracket in first]
        plan += [self._lens(), self._align()]
        plan += [self._pose(view) for view in scene.view]
        plan += [self._probe(), self._sun()]
        plan += self._stand_in()
        plan += [self._lights(), self._harmonics(), self._prefilter()]
        for view in scene.view:
            plan += self._render(view)
        plan.append(self._report(plan))
        return plan

    # ---- what the scene must hold

    def _check(self) -> None:
        scene = self.scene
        if not re.fullmatch(r"[\w./+,@-]+", self.build) or self.build.startswith("-"):
            raise UserError(f"folder {scene.folder!r}: use letters, digits and _ . - / alone")
        if Path(self.build).is_absolute() or ".." in Path(self.build).parts:
            raise UserError(f"folder {scene.folder!r} must lie within the scene's own folder")
        if self.rendered and not (scene.env.file or scene.probe):
            raise UserError("nothing lights the objects: add a [probe], or env.file")
        if scene.probe and not scene.env.file:
            if not scene.probe.shot:
                raise UserError("[probe] has no shot")
            _check_probe(scene.probe)
        if scene.align:
            shots = [shot.bracket for shot in self.shots]
            known = ["env"] if scene.env.file else shots
            if scene.align.picture not in known:
                raise UserError(
                    f"align.picture {scene.align.picture!r} is not where the light was seen; "
                    f"known: {', '.join(known) or 'none'}"
                )
        for view in scene.view:
            if view.bracket and view.plate:
                raise UserError(f"view {view.name!r} has a bracket and a plate; keep one")
            if view.points and not (view.bracket or view.plate):
                raise UserError(f"view {view.name!r} has points but no photograph")
        for view in self.plates:
            if view.points and not (scene.align and scene.align.points):
                raise UserError(
                    f"view {view.name!r} has points but there is no [align] with a rectangle"
                )
            if not view.points and not view.camera:
                raise UserError(
                    f"view {view.name!r} has a photograph but nothing says from where: give "
                    "its points, or a camera file that holds the pose"
                )
            if not view.camera and not scene.calibrate:
                raise UserError(
                    f"view {view.name!r} has a photograph but no camera: give it one, or add "
                    "[calibrate]"
                )

    # ---- photographs

    def _users(self, bracket: Bracket) -> list[str]:
        """Who reads the radiance of a bracket."""
        users = ["the light probe" for shot in self.shots if shot.bracket == bracket.name]
        users += [f"view {view.name}" for view in self.rendered if view.bracket == bracket.name]
        if not self.scene.probe and not self.scene.view:
            users.append("its own sake")
        return list(dict.fromkeys(users))

    def _expanded(self, bracket: Bracket) -> list[str]:
        if bracket.name not in self.frames:
            self.frames[bracket.name] = _expand(
                bracket.frames, self.root, f"bracket {bracket.name!r}"
            )
        return self.frames[bracket.name]

    def _folder_of(self, bracket: Bracket) -> str:
        return (bracket.take or f"takes/{bracket.name}").rstrip("/")

    def _names_of(self, bracket: Bracket) -> list[str]:
        """The frames as far as they are known before a device takes them."""
        if bracket.device or bracket.emulate:
            return []
        if bracket.frames:
            return self._expanded(bracket)
        return _frames_of_take(self.root / self._folder_of(bracket) / "take.json")

    def _is_raw(self, bracket: Bracket) -> bool:
        names = self._names_of(bracket)
        return bool(names) and all(Path(n).suffix.lower() in RAW_SUFFIXES for n in names)

    def _is_linear(self, bracket: Bracket) -> bool:
        if bracket.name in self.linear:
            return self.linear[bracket.name]
        names = self._names_of(bracket)
        kinds = {Path(name).suffix.lower() in LINEAR_SUFFIXES for name in names}
        if len(kinds) > 1:
            raise UserError(f"bracket {bracket.name!r} mixes linear frames with others")
        self.linear[bracket.name] = kinds == {True}
        return self.linear[bracket.name]

    def _take(self, bracket: Bracket, before: Sequence[StagePlan]) -> StagePlan:
        name = f"take {bracket.name}"
        take = self._folder_of(bracket)
        users = self._users(bracket)
        if self._solves(bracket):
            users.append("the response curve")
        if not users:
            return StagePlan(name, False, "no shot and no view uses it")
        sources = [bool(bracket.frames), bool(bracket.device or bracket.emulate)]
        if sources == [True, True]:
            raise UserError(f"bracket {bracket.name!r} has frames and a device; keep one")
        if sources == [False, False]:
            if not bracket.take:
                raise UserError(f"bracket {bracket.name!r} needs frames, a take or a device")
            return StagePlan(name, False, f"{take} is a finished take")
        if bracket.frames:
            return self._import(bracket, name, take, users)
        if not bracket.times:
            raise UserError(f"bracket {bracket.name!r} needs the times to expose for")
        if bracket.emulate:
            device = bracket.device or f"visca:{self.build}/dev/{bracket.name}"
            video = bracket.video or f"socket:{self.build}/dev/{bracket.name}.sock"
        elif bracket.device and bracket.video:
            device, video = bracket.device, bracket.video
        else:
            raise UserError(f"bracket {bracket.name!r} has a device but no video")
        command = (
            *("chromeball", "acquire", "bracket"),
            *_option("device", device),
            *_option("video", video),
            *_option("times", ",".join(map(str, bracket.times))),
            *("-o", take),
        )
        inputs: tuple[str, ...] = ()
        after: tuple[str, ...] = ()
        if bracket.emulate:
            inputs = (bracket.emulate.radiance,)
            prefix = (
                *("chromeball", "emulate", "visca"),
                *_option("radiance", bracket.emulate.radiance),
                *_option("link", device.partition(":")[2]),
                *_option("video", video),
                *_option("seed", str(bracket.emulate.seed)),
            )
            command = (*prefix, "--", *command)
        else:
            # one device takes one bracket at a time, under `make -j` too
            after = tuple(
                output
                for stage in before
                if {device, video} & set(stage.command)
                for output in stage.outputs
            )
        return StagePlan(
            name,
            True,
            f"{len(bracket.times)} exposures of {device} for {', '.join(users)}",
            inputs,
            (f"{take}/take.json",),
            command,
            {},
            after,
        )

    def _import(self, bracket: Bracket, name: str, take: str, users: list[str]) -> StagePlan:
        frames = self._expanded(bracket)
        if len(frames) < 2:
            raise UserError(
                f"bracket {bracket.name!r} has one picture, merging needs two or more: take "
                "single photographs or finished radiance to a map with `envmap stitch` or "
                "`envmap probe`, and name that map as `file` in [env]; a view takes a `plate`"
            )
        if bracket.times and len(bracket.times) != len(frames):
            raise UserError(
                f"bracket {bracket.name!r} has {len(frames)} frames "
                f"but {len(bracket.times)} times"
            )
        times = _option("times", ",".join(map(str, bracket.times))) if bracket.times else ()
        return StagePlan(
            name,
            True,
            f"{len(frames)} photographs for {', '.join(users)}",
            tuple(frames),
            (f"{take}/take.json",),
            ("chromeball", "acquire", "import", *map(_plain, frames), *times, "-o", take),
            {},
        )

    # ---- radiance

    def _coded(self) -> list[Bracket]:
        """Brackets in use whose frames need a response curve."""
        return [b for b in self.scene.bracket if self._users(b) and not self._is_linear(b)]

    def _solving(self) -> list[Bracket]:
        """The brackets that the response curve is solved from."""
        if self.scene.hdr.response or not self._coded():
            return []
        named = [self.scene.find_bracket(name) for name in self.scene.hdr.solve_from]
        for bracket in named:
            if self._is_linear(bracket):
                raise UserError(
                    f"hdr.solve_from: the frames of {bracket.name!r} are linear and say "
                    "nothing of a response curve"
                )
        probe = {shot.bracket for shot in self.shots}
        coded = self._coded()
        return named or [b for b in coded if b.name in probe][:1] or coded[:1]

    def _solves(self, bracket: Bracket) -> bool:
        return any(bracket.name == other.name for other in self._solving())

    def _motion(self, bracket: Bracket) -> str:
        return f"{self.build}/{bracket.name}.motion.json"

    def _hand(self, bracket: Bracket) -> StagePlan:
        name = f"hdr align {bracket.name}"
        if self._is_linear(bracket):
            raise UserError(
                f"bracket {bracket.name!r} is handheld, and its frames are linear: these "
                "cannot be resampled"
            )
        if not self._users(bracket) and not self._solves(bracket):
            return StagePlan(name, False, "no shot and no view uses it")
        take, output = self._folder_of(bracket), self._motion(bracket)
        return StagePlan(
            name,
            True,
            "the camera was held by hand",
            (f"{take}/take.json",),
            (output,),
            ("chromeball", "hdr", "align", take, "-o", output),
            {},
        )

    def _response(self) -> StagePlan:
        name = "hdr response"
        if self.scene.hdr.response:
            return StagePlan(name, False, f"{self.scene.hdr.response} is given")
        brackets = self._solving()
        if not brackets:
            any_used = any(self._users(bracket) for bracket in self.scene.bracket)
            return StagePlan(
                name, False, "all frames are linear" if any_used else "no bracket is in use"
            )
        takes = [self._folder_of(bracket) for bracket in brackets]
        hdr = self.scene.hdr
        output = f"{self.build}/response.json"
        motion = [self._motion(b) for b in brackets if b.handheld]
        if motion and not all(bracket.handheld for bracket in brackets):
            raise UserError(
                "hdr.solve_from: brackets held by hand and on a tripod; name one kind"
            )
        filters = {tuple(bracket.nd) for bracket in brackets}
        if len(filters) > 1 or (len(brackets) > 1 and len(max(filters)) > 1):
            raise UserError(
                "hdr.solve_from: brackets of different ND filters; name those of one filter"
            )
        return StagePlan(
            name,
            True,
            f"the frames of {', '.join(b.name for b in self._coded())} are not linear",
            (*(f"{take}/take.json" for take in takes), *motion),
            (output,),
            (
                *("chromeball", "hdr", "response", *takes),
                *_filters(brackets[0]),
                *(("--motion", *motion) if motion else ()),
                *(_option("method", hdr.method) if hdr.method != "comparagram" else ()),
                *(_option("smoothness", f"{hdr.smoothness:.10g}") if hdr.smoothness else ()),
                *_refining(hdr.refine_times),
                *(_option("reuse", hdr.reuse) if hdr.reuse else ()),
                *("-o", output),
            ),
            {},
        )

    def _merge(self, bracket: Bracket) -> StagePlan:
        name = f"hdr merge {bracket.name}"
        users = self._users(bracket)
        if not users:
            used = "only the response curve is solved from it"
            return StagePlan(
                name, False, used if self._solves(bracket) else "no shot and no view uses it"
            )
        take = self._folder_of(bracket)
        output = f"{self.build}/{bracket.name}.exr"
        inputs = [f"{take}/take.json"]
        curve: tuple[str, ...] = ()
        if not self._is_linear(bracket):
            response = self.scene.hdr.response or f"{self.build}/response.json"
            inputs.append(response)
            curve = _option("response", response)
        options = [*_filters(bracket), *curve]
        if bracket.handheld:
            inputs.append(self._motion(bracket))
            options += ["--motion", self._motion(bracket)]
        if bracket.moving and self._is_raw(bracket):
            raise UserError(
                f"bracket {bracket.name!r} is moving, and its frames are RAW: ghosts are found "
                "in pictures with their colours"
            )
        if bracket.moving:
            options.append("--deghost")
        if any(view.look.noise and view.bracket == bracket.name for view in self.rendered):
            options.append("--sigma")
        if bracket.vignetting:
            options += _option("vignetting", bracket.vignetting)
            inputs += map(str, file_of(bracket.vignetting))
        hdr = self.scene.hdr
        if hdr.snr:
            options += _option("snr", f"{hdr.snr:.10g}")
        if hdr.white_balance and self._is_raw(bracket):
            options += _option("white-balance", hdr.white_balance)
        if hdr.meter and hdr.meter.bracket == bracket.name:
            options += _metered(hdr.meter)
        elif hdr.meter:
            source = f"{self.build}/{hdr.meter.bracket}.exr"
            inputs.append(source)
            options += _option("scale-from", source)
        return StagePlan(
            name,
            True,
            f"radiance for {', '.join(users)}",
            tuple(inputs),
            (output,),
            ("chromeball", "hdr", "merge", take, *options, "-o", output),
            {},
        )

    # ---- cameras and the world

    def _lens(self) -> StagePlan:
        name = "calibrate lens"
        calibrate = self.scene.calibrate
        if calibrate is None:
            return StagePlan(name, False, "the scene has no [calibrate]")
        if calibrate.camera:
            return StagePlan(name, False, f"{calibrate.camera} is a finished camera")
        if not self.plates:
            return StagePlan(name, False, "no view has a photograph behind it")
        if all(view.camera for view in self.plates):
            return StagePlan(name, False, "every view names its own camera")
        if not calibrate.images or not calibrate.target:
            raise UserError("[calibrate] needs images and a target, or a finished camera")
        images = _expand(calibrate.images, self.root, "calibrate.images")
        output = f"{self.build}/lens.cameramodel"
        return StagePlan(
            name,
            True,
            "the lens of "
            + ", ".join(f"view {view.name}" for view in self.plates if not view.camera),
            tuple(images),
            (output,),
            (
                *("chromeball", "calibrate", "lens", *map(_plain, images)),
                *_option("target", calibrate.target),
                *_option("model", calibrate.model),
                *("-o", output),
            ),
            {},
        )

    def _camera_of(self, view: View) -> str:
        calibrate = self.scene.calibrate
        return (
            view.camera
            or (calibrate.camera if calibrate else None)
            or f"{self.build}/lens.cameramodel"
        )

    def _env(self) -> str:
        return f"{self.build}/env.exr"

    def _seen(self) -> str:
        """The map before its sun is restored."""
        return f"{self.build}/env_seen.exr" if self.scene.env.sun else self._env()

    def _align(self) -> StagePlan:
        name = "envmap align"
        align, probe = self.scene.align, self.scene.probe
        if align is None:
            whose = "panorama's" if self.scene.env.file else "first shot's"
            return StagePlan(name, False, f"no [align]: the {whose} axes are the world's")
        finished = self.scene.env.file if align.picture == "env" else None
        picture = finished or f"{self.build}/{align.picture}.exr"
        inputs = [picture]
        if probe and probe.camera and align.picture != "env":
            inputs.append(probe.camera)
        clicked = {
            "lens": probe and [probe.lens, *(shot.lens for shot in probe.shot)],
            "camera": probe and probe.camera,
            "shot": [shot for shot in self.shots if shot.bracket == align.picture],
        }
        output = f"{self.build}/align.json"
        return StagePlan(
            name,
            True,
            f"world axes and scale from {_clicked(align)} of {align.picture}",
            tuple(inputs),
            (output,),
            ("chromeball", "envmap", "align", self.file, "-o", output),
            {"align": align, "probe": clicked},
        )

    def _probe(self) -> StagePlan:
        name = "envmap probe"
        scene, probe = self.scene, self.scene.probe
        if scene.env.file:
            if scene.env.ground or scene.env.fill:
                raise UserError("env.ground and env.fill are not for a finished panorama")
            aligned = (f"{self.build}/align.json",) if scene.align else ()
            return StagePlan(
                name,
                True,
                f"{scene.env.file} is a finished panorama: turned to world axes, not stitched",
                (scene.env.file, *aligned),
                (self._seen(),),
                ("chromeball", "envmap", "probe", self.file, "-o", self._seen()),
                {"env": {"file": scene.env.file, "width": scene.env.width}},
            )
        if probe is None:
            return StagePlan(name, False, "no [probe]")
        if probe.stitch:
            return self._stitch(probe)
        merged = [f"{self.build}/{shot.bracket}.exr" for shot in probe.shot]
        inputs = list(merged)
        options: list[str] = []
        for axis in ("yaw", "pitch", "roll"):
            angles = [float(getattr(shot, axis)) for shot in probe.shot]
            if axis == "yaw" or any(angles):
                options += _option(axis, ",".join(f"{angle:.10g}" for angle in angles))
        if probe.camera:
            options += _option("camera", probe.camera)
            inputs.append(probe.camera)
        elif lenses := [shot.lens or probe.lens for shot in probe.shot if not shot.ball]:
            same = all(lens == lenses[0] for lens in lenses)
            texts = [lens_text(lens) for lens in lenses if lens]
            options += _option("lens", texts[0] if same and texts else " ".join(texts))
        if balls := [shot.ball for shot in probe.shot if shot.ball]:
            options += _option("ball", " ".join(_numbers(ball) for ball in balls))
            options += _option("photographer", f"{probe.photographer:.10g}")
            options += _option("reflectance", _numbers(probe.reflectance))
        options += _vignetting(probe, inputs)
        if probe.trim:
            options += _option("trim", f"{probe.trim:.10g}")
        if masks := [shot.mask for shot in probe.shot if shot.mask]:
            options += ["--mask", *masks]
            inputs += masks
        if probe.refine_lens:
            options.append("--refine-lens")
        if not probe.refine and len(merged) > 1:
            options.append("--no-refine")
        if scene.env.ground:
            options += _option("ground", _numbers(scene.env.ground))
        if scene.env.fill:
            photograph = scene.photograph_of(scene.find_view(scene.env.fill))
            options += _option("fill", ":".join(photograph))
            inputs += photograph
        if scene.align:
            options += _option("align", f"{self.build}/align.json")
            inputs.append(f"{self.build}/align.json")
        output = self._seen()
        return StagePlan(
            name,
            True,
            f"{len(merged)} shot{'s' if len(merged) > 1 else ''} of the light probe",
            tuple(inputs),
            (output,),
            (
                *("chromeball", "envmap", "probe", *merged, *options),
                *("--width", str(scene.env.width), "-o", output),
            ),
            {},
        )

    def _stitch(self, probe: Probe) -> StagePlan:
        env = self.scene.env
        if env.ground or env.fill:
            raise UserError("env.ground and env.fill are not for [probe] stitch = true")
        merged = [f"{self.build}/{shot.bracket}.exr" for shot in probe.shot]
        inputs = list(merged)
        options: list[str] = []
        if probe.directions:
            options += _option("directions", probe.directions)
            inputs.append(probe.directions)
        else:
            for axis in ("yaw", "pitch", "roll"):
                angles = ",".join(f"{getattr(shot, axis):.10g}" for shot in probe.shot)
                options += _option(axis, angles)
        if probe.sigma:
            options += _option("sigma", f"{probe.sigma:.10g}")
        if probe.camera:
            options += _option("camera", probe.camera)
            inputs.append(probe.camera)
        elif probe.lens:
            options += _option("lens", lens_text(probe.lens))
        options += _vignetting(probe, inputs)
        if self.scene.align:
            options += _option("align", f"{self.build}/align.json")
            inputs.append(f"{self.build}/align.json")
        return StagePlan(
            "envmap stitch",
            True,
            f"{len(merged)} shots, where they looked is refined from the pictures",
            tuple(inputs),
            (self._seen(),),
            (
                *("chromeball", "envmap", "stitch", *merged, *options),
                *("--width", str(env.width), "-o", self._seen()),
            ),
            {},
        )

    def _sun(self) -> StagePlan:
        name, sun = "envmap sun", self.scene.env.sun
        if sun is None:
            return StagePlan(name, False, "no [env.sun]: the map is as it was seen")
        if (sun.meter is None) == (sun.ratio is None):
            raise UserError("[env.sun] needs a meter's reading or a ratio, one of the two")
        options: list[str] = []
        for key in ("meter", "ratio", "normal", "at", "clipped", "color", "radius", "accuracy"):
            value = getattr(sun, key)
            if isinstance(value, str):
                options += _option(key, value)
            elif value is not None:
                options += _option(
                    key, _numbers(value if isinstance(value, tuple) else [value])
                )
        return StagePlan(
            name,
            True,
            "the sun's light from a "
            + ("light meter's reading" if sun.meter is not None else "card in sun and shadow"),
            (self._seen(),),
            (self._env(),),
            ("chromeball", "envmap", "sun", self._seen(), *options, "-o", self._env()),
            {},
        )

    def _lights(self) -> StagePlan:
        name = "envmap lights"
        if not (self.scene.env.file or self.scene.probe):
            return StagePlan(name, False, "no environment map")
        output = f"{self.build}/lights.json"
        count = str(self.scene.env.lights)
        depth = (f"{self.build}/env_depth.exr",) if self.scene.stand_in else ()
        return StagePlan(
            name,
            True,
            "a by-product for other renderers; ours samples the map itself",
            (self._env(), *depth),
            (output,),
            (
                *("chromeball", "envmap", "lights", self._env(), "--count", count),
                *(option for path in depth for option in ("--depth", path)),
                *("-o", output),
            ),
            {},
        )

    def _harmonics(self) -> StagePlan:
        name = "envmap harmonics"
        if not (self.scene.env.file or self.scene.probe):
            return StagePlan(name, False, "no environment map")
        if not self.scene.env.realtime:
            return StagePlan(name, False, "nobody asks: env.realtime is false")
        coefficients, irradiance = (
            f"{self.build}/{file}" for file in ("harmonics.json", "irradiance.exr")
        )
        return StagePlan(
            name,
            True,
            "diffuse light for real-time engines",
            (self._env(),),
            (coefficients, irradiance),
            (
                *("chromeball", "envmap", "harmonics", self._env()),
                *("--map", irradiance, "-o", coefficients),
            ),
            {},
        )

    def _prefilter(self) -> StagePlan:
        name = "envmap prefilter"
        if not (self.scene.env.file or self.scene.probe):
            return StagePlan(name, False, "no environment map")
        if not self.scene.env.realtime:
            return StagePlan(name, False, "nobody asks: env.realtime is false")
        glossy = [thing.name for thing in self.scene.object if _glossy(thing)]
        if not glossy:
            return StagePlan(name, False, "no object is glossy")
        cube, mips, table = (
            f"{self.build}/{file}" for file in ("env.ktx2", "env_prefiltered.exr", "brdf.ktx2")
        )
        return StagePlan(
            name,
            True,
            f"reflections of {', '.join(glossy)} in real-time engines",
            (self._env(),),
            (cube, mips, table),
            (
                *("chromeball", "envmap", "prefilter", self._env()),
                *("--table", table, "-o", cube, "-o", mips),
            ),
            {},
        )

    def _pose(self, view: View) -> StagePlan:
        name = f"calibrate pose {view.name}"
        if view not in self.plates:
            has = view.bracket or view.plate
            return StagePlan(
                name, False, "nothing to render" if has else "no photograph behind the view"
            )
        if not view.points:
            return StagePlan(name, False, f"{view.camera} holds the pose")
        camera, align = self._camera_of(view), f"{self.build}/align.json"
        output = f"{self.build}/{view.name}.cameramodel"
        return StagePlan(
            name,
            True,
            "where the photograph was taken from, by four points",
            (camera, align),
            (output,),
            (
                *("chromeball", "calibrate", "pose", *_option("camera", camera)),
                *_option("points", points_text(view.points)),
                *_option("align", align),
                *("-o", output),
            ),
            {},
        )

    # ---- geometry and pictures

    def _stand_in(self) -> Iterator[StagePlan]:
        names = ("stand-in build", "stand-in depth")
        if not self.scene.stand_in or not (self.scene.env.file or self.scene.probe):
            why = "no environment map" if self.scene.stand_in else "no [[stand_in]]"
            for name in names:
                yield StagePlan(name, False, why)
            return
        mesh, depth = f"{self.build}/stand_in.ply", f"{self.build}/env_depth.exr"
        env = self._env()
        yield StagePlan(
            names[0],
            True,
            f"{len(self.scene.stand_in)} drawn on the panorama",
            (env,),
            (mesh,),
            ("chromeball", "stand-in", "build", self.file, "--env", env, "-o", mesh),
            {"stand_in": self.scene.stand_in},
        )
        yield StagePlan(
            names[1],
            True,
            "how far away the light comes from; the lights get places",
            (mesh, env),
            (depth,),
            ("chromeball", "stand-in", "depth", mesh, "--env", env, "-o", depth),
            {},
        )

    def _render(self, view: View) -> Iterator[StagePlan]:
        """The view's picture, or a stage for each frame of a sequence."""
        name = f"render {view.name}"
        scene = self.scene
        if not scene.object and not scene.light:
            yield StagePlan(name, False, "no [[object]]")
            return
        if not moves(scene, view):
            yield self._picture(name, scene, view, f"{view.name}.exr")
            return
        frames = frames_of(view)
        if not frames:
            raise UserError(f'view {view.name!r} is a sequence: say which, frames = "1-48"')
        index = scene.view.index(view)
        for frame in frames:
            still = at(scene, frame)
            plan = self._picture(
                f"{name} {frame:04d}", still, still.view[index], f"{view.name}.{frame:04d}.exr"
            )
            output = f"{self.build}/{view.name}.%04d.exr"
            # make knows what is to be done again, by time: what is kept would stay old
            more = ("--frames", str(frame), "--force")
            yield replace(plan, command=(*plan.command[:-1], output, *more))

    def _picture(self, name: str, scene: Scene, view: View, picture: str) -> StagePlan:
        inputs = [self._env(), *scene.env.others]
        if scene.stand_in:
            inputs.append(f"{self.build}/stand_in.ply")
        if view.bracket or view.plate:
            inputs += scene.photograph_of(view)
        elif view.camera:
            inputs.append(view.camera)
        if view.closing_camera:
            inputs.append(view.closing_camera)
        inputs += [os.path.relpath(path, self.root) for path in scene_inputs(scene, self.root)]
        picture = f"{self.build}/{picture}"
        stem = picture.removesuffix(".exr")
        pictures = [picture, f"{stem}.png"]
        look = view.look
        if look.response is not None:
            solved = scene.hdr.response or f"{self.build}/response.json"
            inputs.append(solved if look.response == "plate" else look.response)
            pictures.append(f"{stem}.camera.png")
        if isinstance(look.vignetting, str):
            inputs += map(str, file_of(look.vignetting))
        if look.jpeg is not None:
            pictures.append(f"{stem}.camera.jpg")
        counts = (("object", len(scene.object)), ("light", len(scene.light)))
        things = [f"{n} {what}{'s' if n > 1 else ''}" for what, n in counts if n]
        return StagePlan(
            name,
            True,
            f"{' and '.join(things)} at {scene.render.spp} samples a pixel",
            tuple(dict.fromkeys(inputs)),
            tuple(pictures),
            ("chromeball", "render", self.file, *_option("view", view.name), "-o", picture),
            {
                "object": scene.object,
                "light": scene.light,
                "render": scene.render,
                "view": view,
                **({"others": scene.env.others} if scene.env.others else {}),
            },
        )

    def _report(self, plan: Sequence[StagePlan]) -> StagePlan:
        outputs = [output for stage in plan for output in stage.outputs]
        return StagePlan(
            "report",
            bool(outputs),
            "what was done, and how well" if outputs else "nothing is made",
            tuple(outputs),
            (REPORT,) if outputs else (),
            ("chromeball", "report", self.file, "-o", REPORT) if outputs else (),
            {
                "name": self.scene.name,
                "stages": [[s.name, s.needed, s.reason] for s in plan],
                "truth": self.scene.truth,
            },
        )


def _glossy(thing: Object) -> bool:
    """Whether an object mirrors anything; a mesh file's own materials may."""
    if thing.material is None:
        return Path(thing.mesh).suffix.lower() in (".glb", ".gltf", ".obj")
    return thing.material.kind != "diffuse"


def _check_probe(probe: Probe) -> None:
    if probe.refine_lens and (probe.camera or any(shot.ball for shot in probe.shot)):
        raise UserError("[probe] refine_lens solves for what `lens` says: give that")
    balls = [shot.ball is not None for shot in probe.shot]
    if any(balls) != all(balls):
        raise UserError("[probe]: either all shots are of a ball, or none is")
    masks = [shot.mask is not None for shot in probe.shot]
    if any(masks) != all(masks):
        raise UserError("[probe]: either all shots have a mask, or none has")
    own = [shot.lens is not None for shot in probe.shot]
    if any(balls):
        if probe.lens or any(own):
            raise UserError("[probe]: shots of a ball have a camera, or none, but no lens")
    elif probe.camera is not None:
        if probe.lens or any(own):
            raise UserError("[probe] needs a lens or a camera, one of the two")
    elif probe.lens is None and not all(own):
        raise UserError("[probe] needs a lens or a camera, one of the two")


def lens_text(lens: Lens) -> str:
    """``equisolid:190``, or ``equisolid:186:2825,1863.5,1806`` with centre and radius."""
    text = f"{lens.model}:{lens.fov:.10g}"
    if lens.radius is None and lens.centre is None:
        return text
    centre = "," if lens.centre is None else ",".join(f"{v:.10g}" for v in lens.centre)
    radius = "" if lens.radius is None else f"{lens.radius:.10g}"
    return f"{text}:{centre},{radius}"


def _numbers(values: Sequence[float]) -> str:
    return ",".join(f"{value:.10g}" for value in values)


def points_text(points: Quad) -> str:
    """``"x,y x,y x,y x,y"``."""
    return " ".join(f"{x:.10g},{y:.10g}" for x, y in points)


def _clicked(align: Align) -> str:
    """What the axes are found from."""
    counts = (
        ("four points", align.points is not None),
        (f"{len(align.verticals)} verticals", bool(align.verticals)),
        ("the horizon", bool(align.horizon)),
        ("the sun", align.sun is not None),
        ("north", align.north is not None),
    )
    return ", ".join(name for name, there in counts if there)


def _option(name: str, value: str) -> tuple[str, ...]:
    """``--name value``; a value that begins with a minus sign is tied to its name."""
    return (f"--{name}={value}",) if value.startswith("-") else (f"--{name}", value)


def _vignetting(probe: Probe, inputs: list[str]) -> tuple[str, ...]:
    """The option of a fall-off that is known; its file is one of the `inputs`."""
    text = vignetting_text(probe.vignetting)
    inputs += map(str, file_of(text))
    return () if text is None else _option("vignetting", text)


def vignetting_text(value: list[float] | str, root: Path | None = None) -> str | None:
    """A fall-off as --vignetting takes it; a file's path from `root` on."""
    if isinstance(value, str):
        return value if root is None or not file_of(value) else str(root / value)
    return ",".join(repr(c) for c in value) if value else None


def _filters(bracket: Bracket) -> tuple[str, ...]:
    return _option("nd", ",".join(f"{v:.10g}" for v in bracket.nd)) if bracket.nd else ()


def _refining(refine: bool | None) -> tuple[str, ...]:
    if refine is None:
        return ()
    return ("--refine-times",) if refine else ("--no-refine-times",)


def _metered(meter: Meter) -> tuple[str, ...]:
    place = ",".join(map(str, meter.at))
    if meter.luminance is not None:
        return "--luminance", f"{meter.luminance:.10g}", "--at", place
    card = f"{meter.reflectance:.10g}", f"{meter.illuminance:.10g}"
    return "--grey-card", *card, "--at", place


def _plain(name: str) -> str:
    """A file name that no command takes for an option."""
    return f"./{name}" if name.startswith("-") else name


def _expand(names: Sequence[str], root: Path, where: str) -> list[str]:
    """Files for names and patterns, patterns sorted; a plain name need not exist yet."""
    found: list[str] = []
    for name in names:
        if not glob.has_magic(name) or (root / name).exists():
            found.append(name)
            continue
        matches = sorted(glob.glob(name, root_dir=root, recursive=True))
        if not matches:
            raise UserError(
                f"{where}: no picture matches {name!r}; if a rule of the Makefile makes them, "
                "name them one by one, or let pipeline.mk wait for them (pipeline.mk: | FILES)"
            )
        found += matches
    if not found:
        raise UserError(f"{where} names no picture")
    twice = [name for name in found if found.count(name) > 1]
    if twice:
        raise UserError(f"{where} names {twice[0]!r} twice")
    return found


def _frames_of_take(path: Path) -> list[str]:
    """The frames that a finished take lists; none where the take does not stand there yet."""
    if not path.exists():
        return []
    try:
        value = msgspec.json.decode(path.read_bytes())
        return [frame["file"] for frame in value["frames"]]
    except (OSError, msgspec.DecodeError, KeyError, TypeError) as error:
        raise UserError("not a readable take", file=path) from error
