"""Picture streams: the emulator's socket, video files, and what goes wrong with them."""

import os
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.acquire.connect import open_video
from chromeball.acquire.emulate.camera import VideoCamera
from chromeball.acquire.emulate.video import VideoServer
from chromeball.acquire.video import HEADER, MAGIC, SocketSource
from chromeball.acquire.visca_packets import MODELS, AutoExposure
from chromeball.scene.errors import DeviceError, UserError

type Scene = NDArray[np.float32]


def test_frames_come_whole_in_order_and_with_their_time(scene: Scene, short: Path):
    camera = VideoCamera(scene, MODELS["evi-d100p"])
    camera.set_mode(AutoExposure.MANUAL)
    with VideoServer(camera, short / "v", speed=4.0):
        source = open_video(f"socket:{short / 'v'}")
        frames = [source.grab() for _ in range(12)]
        source.close()
    times = [frame.monotonic for frame in frames]
    assert np.median(np.diff(times)) == pytest.approx(0.01, rel=0.5)
    for frame in frames:
        assert frame.pixels.shape == scene.shape
        assert frame.monotonic in camera.truth
        assert abs(frame.wall - time.time()) < 60
        assert frame.pixels.std() > 10
    assert not np.array_equal(frames[0].pixels, frames[-1].pixels)  # the noise is new
    assert not (short / "v").exists()


@pytest.mark.parametrize("side", [16, 256])
def test_a_slow_client_misses_frames_and_gets_no_stale_ones(short: Path, side: int):
    scene = np.ones((side, side, 3), np.float32)
    with VideoServer(VideoCamera(scene, MODELS["evi-d100p"]), short / "v", speed=4.0):
        source = SocketSource(os.fspath(short / "v"))
        for _ in range(3):
            time.sleep(0.1)
            asked = time.monotonic()
            assert source.grab().monotonic > asked
        source.close()


def test_two_clients_and_one_that_leaves(scene: Scene, short: Path):
    with VideoServer(VideoCamera(scene, MODELS["evi-d100p"]), short / "v", speed=4.0):
        first, second = (SocketSource(os.fspath(short / "v")) for _ in range(2))
        first.grab()
        first.close()
        assert second.grab().pixels.shape == scene.shape
        assert second.grab().pixels.shape == scene.shape
        second.close()


def test_no_socket_and_a_server_that_dies(scene: Scene, short: Path):
    with pytest.raises(DeviceError, match="is the emulator running"):
        SocketSource(os.fspath(short / "none"))
    with VideoServer(VideoCamera(scene, MODELS["evi-d100p"]), short / "v"):
        source = SocketSource(os.fspath(short / "v"))
        source.grab()
    with pytest.raises(DeviceError, match=r"the video (ended|broke off)"):
        source.grab()
    source.close()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (HEADER.pack(b"JUNK", 1, 0.0, 4, 4) + bytes(48), "damaged"),
        (HEADER.pack(MAGIC, 1, 0.0, 0, 4), "damaged"),
        (HEADER.pack(MAGIC, 1, 0.0, 2**31, 2**31), "damaged"),
        (HEADER.pack(MAGIC, 1, 0.0, 4, 4) + bytes(47), "ended"),
        (b"CB", "ended"),
    ],
)
def test_damaged_streams(short: Path, data: bytes, message: str):
    def serve() -> None:
        connection, _ = listener.accept()
        connection.recv(1)
        connection.sendall(data)
        connection.close()

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.fspath(short / "v"))
        listener.listen()
        listener.settimeout(5)
        thread = threading.Thread(target=serve)
        thread.start()
        source = SocketSource(os.fspath(short / "v"))
        with pytest.raises(DeviceError, match=message):
            source.grab()
        source.close()
        thread.join()


def test_a_stream_that_stands_still(short: Path):
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.fspath(short / "v"))
        listener.listen()
        source = SocketSource(os.fspath(short / "v"), timeout=0.05)
        with pytest.raises(DeviceError, match="stands still"):
            source.grab()
        source.close()


def test_a_video_file(tmp_path: Path):
    import cv2

    path = os.fspath(tmp_path / "clip.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    assert writer.isOpened()
    for level in (40, 200):
        frame = np.zeros((48, 64, 3), np.uint8)
        frame[..., 2] = level  # OpenCV's order is B, G, R
        writer.write(frame)
    writer.release()
    source = open_video(path)
    first, second = source.grab(), source.grab()
    assert first.pixels[..., 0].mean() == pytest.approx(40, abs=6)
    assert second.pixels[..., 0].mean() == pytest.approx(200, abs=6)
    assert second.pixels[..., 2].mean() < 12
    assert second.monotonic > first.monotonic
    with pytest.raises(DeviceError, match="the video ended"):
        source.grab()
    source.close()


def test_what_cannot_be_opened(tmp_path: Path, scene: Scene):
    with pytest.raises(UserError, match="no such video file"):
        open_video(os.fspath(tmp_path / "none.mp4"))
    with pytest.raises(DeviceError, match="no such video device"):
        open_video("v4l2:/dev/none")
    (tmp_path / "not.avi").write_text("no video")
    with pytest.raises(DeviceError, match="cannot be opened as video"):
        open_video(os.fspath(tmp_path / "not.avi"))
    (tmp_path / "taken").write_text("mine")
    camera = VideoCamera(scene, MODELS["evi-d100p"])
    with pytest.raises(UserError, match="something else lies here"):
        VideoServer(camera, tmp_path / "taken").__enter__()
    with pytest.raises(UserError, match="too long for a socket"):
        VideoServer(camera, tmp_path / ("x" * 120)).__enter__()
