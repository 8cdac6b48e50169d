"""Maps for other programs: each shows the test map's axes where we say that they are."""

from __future__ import annotations

import functools
import http.server
import importlib.util
import json
import math
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.envmap import app
from chromeball.envmap.companion import Dome, companion
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.orientation import CONVENTIONS, oriented
from chromeball.envmap.picture import latlong_attributes, map_from_world, read_latlong
from chromeball.envmap.resample import warp
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.pose import Pose

THREE = Path(__file__).resolve().parents[2] / "build/three"

#: Axes of the test map and the colours of their discs.
MARKS: tuple[tuple[tuple[int, int, int], tuple[float, float, float]], ...] = (
    ((1, 0, 0), (1.0, 0.0, 0.0)),
    ((-1, 0, 0), (0.0, 1.0, 1.0)),
    ((0, 1, 0), (0.0, 1.0, 0.0)),
    ((0, -1, 0), (1.0, 0.0, 1.0)),
    ((0, 0, 1), (0.0, 0.0, 1.0)),
    ((0, 0, -1), (1.0, 1.0, 0.0)),
)


def axis_map(width: int, radius: float = 0.35) -> np.ndarray:
    """A lat-long map (width / 2, width, 3) with a disc of its own colour on each axis.

    +X red, +Y green, +Z blue, the opposite axes in the opposite colours, `radius` radians
    wide; between them grey. For trying a program's orientation.
    """
    d = LatLong((width, width // 2)).directions()
    picture = np.full((*d.shape[:2], 3), 0.2, np.float32)
    for axis, color in MARKS:
        picture[d @ np.array(axis, float) > math.cos(radius)] = color
    return picture


def run(*arguments: object) -> None:
    app([str(a) for a in arguments], result_action="return_value", exit_on_error=False)


@pytest.fixture
def axes(tmp_path: Path) -> Path:
    """The axis map, in units of 2 cd/m^2, seen from 1.5 m above the floor."""
    path = tmp_path / "axes.exr"
    kept = {"whiteLuminance": 2.0, "Copyright": "who", "DateTime": "2026:01:02 03:04:05"}
    write_exr(path, axis_map(128), attributes=latlong_attributes(kept, [0, 1.5, 0]))
    return path


def own_axes(program: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """The marked directions in the program's axes, and their colours."""
    turn = np.array(CONVENTIONS[program].own_from_world, float)
    return [(turn @ np.array(axis, float), np.array(color)) for axis, color in MARKS]


@pytest.mark.parametrize("program", CONVENTIONS)
def test_the_turned_map_is_what_the_convention_says(program: str) -> None:
    """Two routes: moved columns, and the convention's own words."""
    found = CONVENTIONS[program]
    picture = oriented(axis_map(64), found).radiance
    colors = {tuple(np.abs(d).round() * np.sign(d)): c for d, c in own_axes(program)}
    middle, quarter = 32, 48
    assert picture[16, middle] == pytest.approx(colors[tuple(map(float, found.centre))])
    assert picture[16, quarter] == pytest.approx(colors[tuple(map(float, found.right))])
    assert picture[0, 0] == pytest.approx(colors[tuple(map(float, found.up))])
    turn = found.map_from_world
    assert np.linalg.det(turn) == pytest.approx(1)  # none mirrors
    assert turn[1].tolist() == [0, 1, 0]


@pytest.mark.parametrize("program", CONVENTIONS)
def test_columns_moved_are_the_map_resampled(program: str) -> None:
    rng = np.random.default_rng(3)
    picture = rng.random((32, 64, 3)).astype(np.float32)
    found = oriented(picture, CONVENTIONS[program])
    assert found.exact
    assert found.energy_error == 0
    turn = CONVENTIONS[program].map_from_world
    target = LatLong((64, 32), turn.T @ WORLD_FROM_LATLONG.rotation)
    resampled = warp(picture, LatLong((64, 32)), target, smooth=False).radiance
    np.testing.assert_allclose(found.radiance, resampled, atol=2e-4)
    assert np.sort(found.radiance, axis=None).tolist() == np.sort(picture, axis=None).tolist()


def test_a_width_that_four_does_not_divide_is_resampled_with_its_energy() -> None:
    found = oriented(axis_map(126), CONVENTIONS["blender"])
    assert not found.exact
    assert found.energy_error < 1e-3
    assert found.radiance.shape == (63, 126, 3)


@pytest.mark.parametrize("program", CONVENTIONS)
def test_attributes_survive_and_say_the_turn(program: str, axes: Path, tmp_path: Path) -> None:
    run("export", axes, "--for", program, "-o", tmp_path / "dome.exr")
    image = read_latlong(tmp_path / "dome.exr")
    convention = CONVENTIONS[program]
    np.testing.assert_allclose(
        map_from_world(image.attributes), convention.map_from_world, atol=1e-6
    )
    assert image.attributes["Copyright"] == "who"
    assert image.attributes["DateTime"] == "2026:01:02 03:04:05"
    assert image.attributes["whiteLuminance"] == 2
    np.testing.assert_allclose(np.ravel(image.attributes["origin"]), [0, 1.5, 0])
    assert read_image(tmp_path / "dome.exr").attributes["textureformat"] == (
        "LatLong Environment"
    )
    # what the rotation says leads back to our axes
    looked_up = LatLong(image.size).pixels_of(
        np.array([a for a, _ in MARKS], float) @ map_from_world(image.attributes).T
    )
    for (x, y), (_, color) in zip(np.round(looked_up).astype(int), MARKS, strict=True):
        here = image.rgb[np.clip(y, 0, image.size[1] - 1), x % image.size[0]]
        assert here == pytest.approx(color)


def test_openexr_itself_reads_our_attributes(axes: Path) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR's module is not installed")
    header = openexr.File(str(axes)).header()
    assert header["envmap"] == openexr.ENVMAP_LATLONG
    assert header["capDate"] == "2026:01:02 03:04:05"
    assert header["owner"] == "who"
    assert header["whiteLuminance"] == 2
    assert len(header["chromaticities"]) == 8
    assert header["worldToCamera"][3].tolist() == [0, -1.5, 0, 1]
    plain = axes.with_name("plain.exr")
    write_exr(plain, axis_map(8))
    assert "capDate" not in openexr.File(str(plain)).header()  # not known: not said


def test_metadata_through_warp(axes: Path, tmp_path: Path) -> None:
    turned = tmp_path / "turned.exr"
    options = ("--from", "latlong", "--to", "latlong", "--width", 64)
    run("warp", axes, *options, "--rotate", "90,0,0", "-o", turned)
    image = read_latlong(turned)
    assert image.attributes["Copyright"] == "who"
    assert "origin" not in image.attributes
    # the picture's directions, led back by its attribute, are the world's
    d = np.array([[1.0, 0, 0], [0, 0, 1]]) @ map_from_world(image.attributes).T
    for (x, y), color in zip(
        np.round(LatLong((64, 32)).pixels_of(d)).astype(int),
        ((1, 0, 0), (0, 0, 1)),
        strict=True,
    ):
        assert image.rgb[y, x % 64] == pytest.approx(color, abs=1e-3)


def test_scale_and_sixteen_bits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bright = axis_map(32)
    bright[3, 5] = 1e6
    path = tmp_path / "env.exr"
    write_exr(path, bright, attributes=latlong_attributes({"whiteLuminance": 1.0}))
    run("export", path, "--for", "three", "-o", tmp_path / "dome.exr")
    assert "1 pixels are above 65504" in capsys.readouterr().err
    run("export", path, "--for", "three", "--scale", 0.05, "-o", tmp_path / "dome.exr")
    assert "65504" not in capsys.readouterr().err
    note = json.loads((tmp_path / "dome.json").read_text())
    image = read_latlong(tmp_path / "dome.exr")
    assert image.rgb.max() * note["intensity"] == pytest.approx(1e6)
    assert note["unit"] == "cd/m^2"
    # what a later command takes for cd/m^2 stays right
    assert image.attributes["whiteLuminance"] == pytest.approx(20)
    run("export", path, "--for", "unreal", "-o", tmp_path / "dome.hdr")
    assert read_image(tmp_path / "dome.hdr").pixels.max() == pytest.approx(1e6, rel=1 / 128)
    with pytest.raises(UserError, match="infinite"):
        run("export", path, "--for", "usd", "--scale", 1e35, "-o", tmp_path / "dome.exr")


def test_refusals(axes: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"reads \.exr and \.hdr"):
        run("export", axes, "--for", "three", "-o", tmp_path / "dome.dds")
    with pytest.raises(UserError, match="as they are"):
        run("export", axes, "--for", "usd", "--keep-pixels", "-o", tmp_path / "dome.exr")
    with pytest.raises(UserError, match="input"):
        run("export", axes, "--for", "usd", "-o", axes)
    with pytest.raises(UserError, match="name it with letters"):
        companion("usd", Dome("a@b.exr", True, 1.0, False, None))
    with pytest.raises(UserError, match="unknown program"):
        companion("maya", Dome("a.exr", True, 1.0, False, None))
    distorted = {"worldToCamera": np.diag([1.0, 2, 1, 1])}
    with pytest.raises(UserError, match="no rotation"):
        map_from_world(distorted)


# ---- the programs themselves


def test_mitsuba_shows_the_axes(axes: Path, tmp_path: Path) -> None:
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    run("export", axes, "--for", "mitsuba", "-o", tmp_path / "dome.exr")
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.0.0"><include filename="dome.xml"/></scene>')
    mitsuba.set_variant("scalar_rgb")
    sky = mitsuba.load_file(str(scene)).environment()
    for direction, color in own_axes("mitsuba"):
        si = mitsuba.SurfaceInteraction3f()
        si.wi = mitsuba.Vector3f(*(-direction).tolist())
        assert np.ravel(sky.eval(si)) == pytest.approx(2 * color, abs=1e-3)


def test_usd_reads_the_dome(axes: Path, tmp_path: Path) -> None:
    usd, geometry, light = (
        pytest.importorskip(f"pxr.{name}", reason="usd-core is not installed")
        for name in ("Usd", "UsdGeom", "UsdLux")
    )
    run("export", axes, "--for", "usd", "-o", tmp_path / "dome.exr")
    stage = usd.Stage.Open(str(tmp_path / "dome.usda"))
    assert geometry.GetStageUpAxis(stage) == "Y"
    assert geometry.GetStageMetersPerUnit(stage) == 1
    dome = light.DomeLight(stage.GetDefaultPrim())
    assert dome.GetTextureFormatAttr().Get() == light.Tokens.latlong
    assert Path(dome.GetTextureFileAttr().Get().resolvedPath) == tmp_path / "dome.exr"
    assert dome.GetIntensityAttr().Get() == 2  # nits per unit of the picture
    world = geometry.Xformable(dome).ComputeLocalToWorldTransform(0)
    assert np.array(world).tolist() == np.eye(4).tolist()


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed")
@pytest.mark.parametrize("kind", ["pixels", "keep-pixels", "usd"])
def test_blender_shows_the_axes(kind: str, axes: Path, tmp_path: Path) -> None:
    """Blender itself, by our script, and by its import of our USD file."""
    program = "usd" if kind == "usd" else "blender"
    more = ["--keep-pixels"] if kind == "keep-pixels" else []
    run("export", axes, "--for", program, *more, "-o", tmp_path / "dome.exr")
    beside = tmp_path / ("dome.usda" if kind == "usd" else "dome.py")
    view = Path(__file__).with_name("blender_view.py")
    seen = tmp_path / "seen.exr"
    done = subprocess.run(
        [sys.executable, str(view), kind, str(beside), str(seen)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    picture = read_image(seen).pixels
    # looks along -X, up is +Z: to its right is +Y
    eye = Pose(np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]), np.zeros(3))
    camera = CameraModel.fisheye("equidistant", (64, 64), math.radians(340), pose=eye)
    for direction, color in own_axes("blender"):
        if direction @ [1, 0, 0] > 0.9:
            continue  # behind it
        x, y = np.round(camera.project_world(direction)).astype(int)
        assert picture[y, x, :3] == pytest.approx(2 * color, abs=2e-3), direction


PAGE = """<!doctype html><body style="margin:0;background:black">
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { EXRLoader } from "/three/examples/jsm/loaders/EXRLoader.js";
try {
  const note = await (await fetch("/dome.json")).json();
  const texture = await new EXRLoader().loadAsync("/" + note.file);
  texture.mapping = THREE[note.mapping];
  const scene = new THREE.Scene();
  scene.background = scene.environment = texture;
  scene.backgroundRotation.set(...note.backgroundRotation);
  scene.environmentRotation.set(...note.environmentRotation);
  const renderer = new THREE.WebGLRenderer();
  renderer.setSize(96, 64);
  document.body.appendChild(renderer.domElement);
  const target = new THREE.WebGLRenderTarget(8, 8, { type: THREE.FloatType });
  const camera = new THREE.PerspectiveCamera(10, 1, 0.1, 10);
  // a mirror, whose normal faces the camera: it shows what lies behind the camera
  const mirror = new THREE.Mesh(new THREE.PlaneGeometry(4, 4), new THREE.MeshStandardMaterial(
    { metalness: 1, roughness: 0, side: THREE.DoubleSide }));
  window.look = (d, reflected) => {
    scene.remove(mirror);
    camera.up.set(...(Math.abs(d[1]) > 0.9 ? [0, 0, 1] : [0, 1, 0]));
    camera.lookAt(...(reflected ? d.map((v) => -v) : d));
    if (reflected) {
      mirror.position.set(...d.map((v) => -v));
      mirror.lookAt(0, 0, 0);
      scene.add(mirror);
    }
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
    const pixels = new Float32Array(8 * 8 * 4);
    renderer.readRenderTargetPixels(target, 0, 0, 8, 8, pixels);
    return JSON.stringify(Array.from(pixels.slice(4 * 36, 4 * 36 + 3)));
  };
  window.ready = "yes";
} catch (error) { window.ready = String(error); }
</script>"""


@pytest.mark.skipif(
    not THREE.is_dir(), reason="no three.js: `npm pack three`, its package as build/three"
)
@pytest.mark.parametrize("keep", [False, True])
def test_three_shows_the_axes(keep: bool, axes: Path, tmp_path: Path) -> None:
    """three.js in a browser: the background, and what a mirror reflects."""
    pytest.importorskip("websockets", reason="no websockets, which drives the browser")
    from tests.renderer.browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("no Chromium")
    site = tmp_path / "site"
    site.mkdir()
    more = ["--keep-pixels"] if keep else []
    run("export", axes, "--for", "three", *more, "-o", site / "dome.exr")
    (site / "three").symlink_to(THREE)
    (site / "index.html").write_text(PAGE)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with Browser(tmp_path / "profile") as browser:
                browser.open(f"http://127.0.0.1:{server.server_port}/index.html")
                limit = time.monotonic() + 60
                while (said := browser.run("window.ready")) is None:
                    assert time.monotonic() < limit, browser.console
                    time.sleep(0.2)
                assert said == "yes"
                for direction, color in own_axes("three"):
                    for mirrored in ("false", "true"):
                        d = json.dumps(direction.tolist())
                        seen = json.loads(browser.run(f"look({d}, {mirrored})"))
                        assert seen == pytest.approx(color, abs=0.03), (direction, mirrored)
        finally:
            server.shutdown()
