"""A session in the browser: viser's gizmos and panel over the renderer's picture.

viser's own three-dimensional scene holds nothing but gizmos; the picture is its background.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import math
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from chromeball.renderer.stream import Picture, Session
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import PRIMITIVES, Material, Object, has_key
from chromeball.scene.pose import Pose

#: What the browser's camera may differ from a view's and still be it.
_SAME = 1e-3
#: Seconds that a browser may take to go where it is sent.
_PATIENCE = 3.0
#: Longest side that is rendered, in pixels; larger windows show it enlarged.
_MOST_PIXELS = 1280


class Viewer:
    """A server on loopback that shows a session to every browser tab that asks.

    Raises
    ------
    UserError
        When `host` is not this machine's loopback, or the port is taken.

    """

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 8080) -> None:
        check_loopback(host)
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                raise UserError(
                    f"port {port} of {host} cannot be used ({error.strerror}); choose another "
                    "with --port"
                ) from error
            port = probe.getsockname()[1]
        self.session = session
        # the command says where, in one line
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(
                host, port, label=session.scene.name, verbose=False
            )
        self.url = f"http://{host}:{self._server.get_port()}"
        scene = self._server.scene
        scene.set_up_direction("+y")
        scene.configure_environment_map(None)
        scene.world_axes.visible = False
        # viser's own sharing would send the page through a server of theirs
        self._server.gui.configure_theme(show_share_button=False)
        self._tabs: dict[int, Tab] = {}
        #: a panel for each object that is not keyed
        self.panels = [
            _ObjectPanel(self, entry)
            for entry in session.scene.object
            if entry.name not in session.keyed
        ]
        self._quality_panel()
        self._save_panel()
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def stop(self) -> None:
        """Let all browsers go."""
        self._server.stop()

    def tabs(self) -> list[Tab]:
        """The browser tabs that look."""
        return list(self._tabs.values())

    def tell(self, error: UserError) -> None:
        """Show a mistake in all tabs."""
        for tab in self.tabs():
            tab.client.add_notification("Not possible", str(error), color="red")

    @property
    def gui(self) -> viser.GuiApi:
        """The panel that all tabs share."""
        return self._server.gui

    @property
    def gizmos(self) -> viser.SceneApi:
        """Viser's scene."""
        return self._server.scene

    # ---- tabs

    async def _connect(self, client: viser.ClientHandle) -> None:
        self._tabs[client.client_id] = Tab(client, self.session)

    async def _disconnect(self, client: viser.ClientHandle) -> None:
        tab = self._tabs.pop(client.client_id, None)
        if tab is not None:
            self.session.close(tab.eye)

    # ---- shared panels

    def _quality_panel(self) -> None:
        settings, gui = self.session.settings, self.gui
        with gui.add_folder("Picture"):
            integrator = gui.add_dropdown(
                "light at rest", [*self.session.integrators], initial_value=settings.integrator
            )
            stops = gui.add_slider("exposure (stops)", -8.0, 8.0, 0.1, settings.stops)
            samples = gui.add_slider("samples while moving", 1, 32, 1, settings.samples)
            fps = gui.add_slider("frames per second", 2.0, 60.0, 1.0, settings.fps)
            error = gui.add_number(
                "error at rest (%)", 100 * settings.error, min=0.01, max=50.0, step=0.01
            )
        integrator.on_update(lambda _: self.session.set(integrator=integrator.value))
        stops.on_update(lambda _: self.session.set(stops=float(stops.value)))
        samples.on_update(lambda _: self.session.set(samples=int(samples.value)))
        fps.on_update(lambda _: self.session.set(fps=float(fps.value)))
        error.on_update(lambda _: self.session.set(error=float(error.value) / 100))

    def _save_panel(self) -> None:
        gui = self.gui
        with gui.add_folder("Save", expand_by_default=False):
            name = gui.add_text("file", self.session.file.name)
            sure: Any = gui.add_checkbox("overwrite", False)
            button = gui.add_button("save")
            said = gui.add_markdown("Poses and materials, into a scene file beside this one.")

        def save(_: object) -> None:
            try:
                count = self.session.save(Path(name.value), overwrite=sure.value)
            except UserError as error:
                said.content = f"**{error.what}**"
                return
            sure.value = False
            said.content = f"{name.value}: {count} object{'' if count == 1 else 's'} changed"

        button.on_click(save)


class Tab:
    """One browser tab: its camera, its picture, its choice of view."""

    def __init__(self, client: viser.ClientHandle, session: Session) -> None:
        self.client, self.session = client, session
        #: what is shown
        self.picture: Picture | None = None
        #: the pose of the view that is looked through, until the camera is dragged away
        self._own: Pose | None = None
        self._patience = 0.0
        first = next(iter(session.views))
        with client.gui.add_folder("View", order=-1):
            self.views = client.gui.add_dropdown(
                "camera", [*session.views], initial_value=first
            )
            again = client.gui.add_button("back to it")
            self.status = client.gui.add_markdown("")
        self.eye = session.open(self._show, _window(client.camera), first)
        self._go(self.eye.camera)
        self.views.on_update(self._choose)
        again.on_click(self._choose)
        client.camera.on_update(self._moved)

    async def _choose(self, _: object) -> None:
        self._go(self.session.choose(self.eye, self.views.value))

    def _go(self, camera: CameraModel) -> None:
        """Put the browser's camera where the view's is."""
        handle, pose = self.client.camera, camera.world_from_camera
        self._own = pose
        self._patience = math.inf  # counts from the browser's first word, which may be late
        with self.client.atomic():
            handle.up_direction = -pose.rotation[:, 1]
            handle.position = pose.translation
            handle.look_at = pose.translation + pose.rotation[:, 2]
            handle.fov = _vertical_angle(camera, handle.aspect)

    async def _moved(self, handle: viser.CameraHandle) -> None:
        size = _window(handle)
        self.session.resize(self.eye, size)
        turned = Rotation.from_quat(handle.wxyz, scalar_first=True).as_matrix()
        place = np.array(handle.position, float)
        if self._own is not None:
            reach = float(np.linalg.norm(handle.look_at - place))
            moved = np.linalg.norm(place - self._own.translation) > _SAME * reach
            if not moved and np.linalg.norm(turned[:, 2] - self._own.rotation[:, 2]) <= _SAME:
                self._patience = 0.0  # it has arrived
                return
            self._patience = min(self._patience, time.monotonic() + _PATIENCE)
            if time.monotonic() < self._patience:
                return  # where it was before it was sent there
        self._own = None
        fov = 2 * math.atan(math.tan(handle.fov / 2) * size[0] / size[1])
        held = self.session.look(
            self.eye, CameraModel.pinhole(size, fov, Pose(turned, place))
        ).world_from_camera.translation
        if np.linalg.norm(place - held) > _SAME * self.session.radius:
            handle.position = held

    def _show(self, picture: Picture) -> None:
        self.picture = picture
        self.client.scene.set_background_image(
            picture.codes, format="jpeg", jpeg_quality=80 if picture.moving else 95
        )
        height, width = picture.codes.shape[:2]
        error = "" if picture.error is None else f", error {picture.error:.2%}"
        state = "moving" if picture.moving else "finished" if picture.done else "sharpening"
        self.status.content = (
            f"{width} x {height}, {1000 * picture.seconds:.0f} ms, "
            f"{picture.samples} samples{error}: {state}"
        )


class _ObjectPanel:
    """An object's gizmo and its controls, shared by all tabs."""

    def __init__(self, viewer: Viewer, entry: Object) -> None:
        self.viewer, self.session, self.name = viewer, viewer.session, entry.name
        gui = viewer.gui
        with gui.add_folder(entry.name, expand_by_default=len(self.session.scene.object) < 3):
            self.handle = gui.add_checkbox("gizmo", True)
            self.position: Any = gui.add_vector3("position (m)", entry.position, step=0.001)
            self.rotation: Any = gui.add_vector3("rotation (deg)", entry.rotation, step=0.1)
            self.scale: Any = gui.add_vector3("scale", _sides(entry), step=0.001)
            self.size: Any = gui.add_number("scale by", 1.0, min=0.01, max=100.0, step=0.01)
            self.material = _MaterialPanel(gui, entry, self.change)
        self.gizmo = viewer.gizmos.add_transform_controls(
            f"/objects/{entry.name}",
            scale=1.2 * self.session.size_of(entry.name),
            line_width=2.0,
            depth_test=False,
            wxyz=_wxyz(entry),
            position=entry.position,
        )
        self.gizmo.on_update(self._dragged)
        self.handle.on_update(self._shown)
        self.position.on_update(self._typed)
        self.rotation.on_update(self._typed)
        self.scale.on_update(self._typed)
        self.size.on_update(self._sized)

    def _shown(self, _: object) -> None:
        self.gizmo.visible = self.handle.value

    async def _dragged(self, _: object) -> None:
        turned = Rotation.from_quat(self.gizmo.wxyz, scalar_first=True)
        angles = turned.as_euler("xyz", degrees=True, suppress_warnings=True)
        self.change(position=_rounded(self.gizmo.position, 5), rotation=_rounded(angles, 3))

    async def _typed(self, _: object) -> None:
        self.change(
            position=self.position.value, rotation=self.rotation.value, scale=self.scale.value
        )

    async def _sized(self, _: object) -> None:
        factor = float(self.size.value)
        if factor != 1:
            self.change(scale=_rounded(np.array(self.scale.value) * factor, 6))
            self.size.value = 1.0

    def change(self, **fields: Any) -> None:
        try:
            entry = self.session.change(self.name, **fields)
        except UserError as error:
            self.viewer.tell(error)
            return
        for control, value in (
            (self.position, entry.position),
            (self.rotation, entry.rotation),
            (self.scale, _sides(entry)),
        ):
            if tuple(control.value) != tuple(value):
                control.value = value
        if "position" in fields or "rotation" in fields:
            self.gizmo.position, self.gizmo.wxyz = entry.position, _wxyz(entry)
        if "scale" in fields:
            self.gizmo.scale = 1.2 * self.session.size_of(self.name)


def check_loopback(host: str) -> None:
    """Refuse a host that other machines can reach: the viewer asks nobody who they are."""
    try:
        inside = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        inside = False
    if not inside:
        raise UserError(
            f"--host {host}: the viewer has no password and stays on this machine; from "
            "another one use ssh -L 8080:127.0.0.1:8080"
        )


#: Keys of a material that have a slider: least, most, and what stands there unless given.
_SLIDERS = {
    "roughness": (0.0, 1.0, 1.0),
    "metallic": (0.0, 1.0, 0.0),
    "specular": (0.0, 1.0, 1.0),
    "ior": (1.0, 4.0, 1.5),
    "transmission": (0.0, 1.0, 0.0),
    "clearcoat": (0.0, 1.0, 0.0),
    "clearcoat_roughness": (0.0, 1.0, 0.0),
    "alpha": (0.0, 1.0, 1.0),
}
_OWN = "the file's own"


class _MaterialPanel:
    """What an object is made of; keys without a control stay as the scene file has them."""

    def __init__(self, gui: viser.GuiApi, entry: Object, change: Callable[..., None]) -> None:
        self._change = change
        self._material: dict[str, Any] = msgspec.to_builtins(entry.material or Material())
        kinds = [*get_args(get_type_hints(Material)["kind"])]
        own = [] if entry.mesh in PRIMITIVES else [_OWN]
        material = entry.material or Material()
        self._kind: Any = gui.add_dropdown(
            "material",
            [*own, *kinds],
            initial_value=_OWN if own and entry.material is None else material.kind,
        )
        self._color: Any = gui.add_rgb("color", _display(material.color or (0.5, 0.5, 0.5)))
        self._kind.on_update(lambda _: self._edit(kind=self._kind.value))
        self._color.on_update(lambda _: self._edit(color=_linear(self._color.value)))
        self._sliders: dict[str, Any] = {}
        for name, (least, most, usual) in _SLIDERS.items():
            given = getattr(material, name)
            value = usual if given is None else given
            slider: Any = gui.add_slider(name.replace("_", " "), least, most, 0.01, value)
            slider.on_update(
                lambda _, name=name, slider=slider: self._edit(**{name: float(slider.value)})
            )
            self._sliders[name] = slider
        self._reveal()

    def _edit(self, **fields: Any) -> None:
        kind = self._kind.value
        self._material |= {**fields, "kind": kind}
        kept = {
            key: value
            for key, value in self._material.items()
            if value is not None and has_key(kind, key)
        }
        self._change(material=None if kind == _OWN else kept)
        self._reveal()

    def _reveal(self) -> None:
        """Show the controls that mean something to the kind."""
        kind = self._kind.value
        self._color.visible = kind != _OWN
        for name, slider in self._sliders.items():
            slider.visible = kind != _OWN and has_key(kind, name)


def _display(color: tuple[float, ...]) -> tuple[int, int, int]:
    from chromeball.scene.image import to_display

    r, g, b = (int(v) for v in to_display(np.array(color, np.float32)))
    return r, g, b


def _linear(codes: tuple[int, int, int]) -> tuple[float, ...]:
    from chromeball.scene.color import srgb_decode

    return _rounded(srgb_decode(np.array(codes) / 255), 4)


def _window(camera: viser.CameraHandle) -> tuple[int, int]:
    width, height = max(1, camera.image_width), max(1, camera.image_height)
    fit = min(1.0, _MOST_PIXELS / max(width, height))
    return max(1, round(width * fit)), max(1, round(height * fit))


def _vertical_angle(camera: CameraModel, aspect: float) -> float:
    """The browser's field of view in which the view's picture lies where its rays are.

    By the middle of the picture: other lenses than a pinhole agree with gizmos there alone.
    """
    width, height = camera.size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    above, here = camera.unproject(np.stack([middle - [0, 0.5], middle + [0, 0.5]]))
    per_pixel = abs(float(here[1] / here[2] - above[1] / above[2]))
    if not 0 < per_pixel < 1:  # a lens that does not see its own middle
        return math.radians(90)
    high = max(height, width / aspect)
    return min(2 * math.atan(per_pixel * high / 2), math.radians(170))


def _sides(entry: Object) -> tuple[float, float, float]:
    scale = entry.scale
    return scale if isinstance(scale, tuple) else (scale, scale, scale)


def _wxyz(entry: Object) -> tuple[float, float, float, float]:
    turned = Rotation.from_euler("xyz", entry.rotation, degrees=True)
    w, x, y, z = (float(v) for v in turned.as_quat(scalar_first=True))
    return w, x, y, z


def _rounded(values: NDArray[np.floating], digits: int) -> tuple[float, ...]:
    return tuple(round(float(v), digits) for v in values)
