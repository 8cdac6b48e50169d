"""``chromeball view`` in a real browser."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.stream import Session, Settings
from chromeball.renderer.viewer import Viewer, check_loopback
from chromeball.scene.errors import UserError
from tests.renderer.browser import CHROMIUM, Browser
from tests.renderer.scenes import SCENE, write_scene

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
# viser's threads and sockets are closed by its own garbage collection
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
SIZE = (900, 600)


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    scene = write_scene(tmp_path, SCENE.replace("size = [40, 30]", "size = [120, 90]"))
    made = Session(scene, settings=Settings(error=0.05))
    yield made
    made.stop()
    assert made.failure is None


@pytest.fixture
def viewer(session: Session) -> Iterator[Viewer]:
    made = Viewer(session, port=0)
    yield made
    made.stop()


def until(condition: Callable[[], bool]) -> None:
    """Wait for the machine, however busy it is."""
    limit = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.05)


def left(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Where the picture is not covered by viser's panel."""
    return picture[:, : picture.shape[1] * 3 // 5].astype(int)


@needs_browser
def test_the_page_shows_the_picture_and_what_is_moved(
    viewer: Viewer, session: Session, tmp_path: Path
) -> None:
    with Browser(tmp_path / "browser", SIZE) as browser:
        browser.open(viewer.url)
        until(lambda: len(viewer.tabs()) == 1)
        # without gizmos the page is the picture alone
        for panel in viewer.panels:
            panel.gizmo.visible = False
        until(session.is_idle)
        tab = viewer.tabs()[0]

        def shows_it() -> bool:
            shown = left(browser.picture())
            assert tab.picture is not None
            codes = tab.picture.codes
            y = ((np.arange(shown.shape[0]) + 0.5) * codes.shape[0] / shown.shape[0]).astype(
                int
            )
            x = ((np.arange(shown.shape[1]) + 0.5) * codes.shape[1] / SIZE[0]).astype(int)
            expected = codes[y[:, None], x[None]].astype(int)
            # enlarged smoothly, as a JPEG; viser's messages and axes lie in the corners
            error = np.abs(shown - expected)[190:, 100:]
            return bool(np.median(error) <= 3 and np.mean(error) < 6)

        until(shows_it)
        before = left(browser.picture())
        assert before.std() > 20
        session.change("ball", position=(-0.3, 0, 0), material={"color": (0.9, 0.1, 0.1)})

        def has_changed() -> bool:
            change = np.abs(left(browser.picture()) - before).max(axis=2)
            return bool((change > 40).mean() > 0.01)

        until(has_changed)
        until(shows_it)


@needs_browser
def test_a_gizmo_moves_its_object_and_a_drag_the_camera(
    viewer: Viewer, session: Session, tmp_path: Path
) -> None:
    with Browser(tmp_path / "browser", SIZE) as browser:
        browser.open(viewer.url)
        until(lambda: len(viewer.tabs()) == 1 and session.is_idle())
        eye = viewer.tabs()[0].eye
        assert eye.view == "main"
        height, width = browser.picture().shape[:2]
        # the object's place in the browser: where the view's camera sees it
        camera = eye.camera
        at = camera.project_world(np.array([0.0, 0.0, 0.0]))
        scale = height / camera.size[1]
        x = (at[0] - (camera.size[0] - 1) / 2) * scale + width / 2
        y = (at[1] - (camera.size[1] - 1) / 2) * scale + height / 2
        along = camera.project_world(np.array([0.25, 0.0, 0.0]))
        arrow = x + (along[0] - at[0]) * scale
        until(lambda: gizmo_is_there(browser.picture(), round(arrow), round(y)))
        browser.drag((round(arrow), round(y)), (round(arrow) + 60, round(y)))
        until(lambda: session.scene.object[0].position[0] > 0.05)
        position = session.scene.object[0].position
        assert position[1] == pytest.approx(0, abs=1e-6)
        assert position[2] == pytest.approx(0, abs=1e-6)
        assert eye.view == "main"  # the camera has not moved
        browser.drag((60, height - 60), (110, height - 80))
        until(lambda: eye.view is None)
        moved = eye.camera.world_from_camera
        assert np.linalg.norm(moved.translation - session.captured.origin) <= (
            session.radius * 1.001
        )


def gizmo_is_there(picture: NDArray[np.uint8], x: int, y: int) -> bool:
    around = picture[y - 6 : y + 7, x - 6 : x + 7].astype(int)
    return bool((np.ptp(around, axis=2) > 100).any())


@needs_browser
def test_tabs_come_and_go(viewer: Viewer, session: Session, tmp_path: Path) -> None:
    with Browser(tmp_path / "one") as one:
        one.open(viewer.url)
        with Browser(tmp_path / "two") as two:
            two.open(viewer.url)
            until(lambda: len(viewer.tabs()) == 2 and session.is_idle())
            assert {tab.eye for tab in viewer.tabs()} == set(session.eyes())
        until(lambda: len(viewer.tabs()) == 1)
    until(lambda: not viewer.tabs())
    assert session.eyes() == ()


def test_only_this_machine_is_served(viewer: Viewer) -> None:
    port = int(viewer.url.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    listening = [line.split()[1] for line in lines if line.split()[3] == "0A"]
    assert [a for a in listening if int(a.split(":")[1], 16) == port] == [
        f"0100007F:{port:04X}"
    ]
    for host in ("0.0.0.0", "192.168.1.4", "::", "example.org", ""):
        with pytest.raises(UserError, match="stays on this machine"):
            check_loopback(host)
    for host in ("127.0.0.1", "::1", "localhost", "127.0.0.5"):
        check_loopback(host)
    with pytest.raises(UserError, match="choose another with --port"):
        Viewer(viewer.session, port=port)


def test_the_command_says_where_and_ends_with_control_c(tmp_path: Path) -> None:
    import signal

    # where the tests run in the background, the shell has turned SIGINT off for children
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from chromeball.cli.main import main; main()"
    )
    command = [sys.executable, "-c", program, "view"]
    with subprocess.Popen(
        [*command, str(write_scene(tmp_path)), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        try:
            _, complaints = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert (process.returncode, complaints) == (0, "")


def test_without_the_extra_the_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.renderer.scenes import run

    monkeypatch.delitem(sys.modules, "chromeball.renderer.viewer", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UserError, match=r"needs viser.*pip install 'chromeball\[viewer\]'"):
        run("view", write_scene(tmp_path))
