"""The real driver and the emulated camera, on a real pseudo-terminal."""

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.acquire.connect import open_camera
from chromeball.acquire.devices import ShutterCamera
from chromeball.acquire.emulate.camera import VideoCamera
from chromeball.acquire.emulate.visca import Faults, ViscaPort
from chromeball.acquire.visca import MODELS, ViscaCamera
from chromeball.acquire.visca_packets import AutoExposure, set_shutter
from chromeball.scene.errors import DeviceError, UserError

FAST = 20.0
type Scene = NDArray[np.float32]


def camera_of(scene: Scene, model: str = "evi-d100p") -> VideoCamera:
    return VideoCamera(scene, MODELS[model])


def check_contract(device: ShutterCamera) -> None:
    """What every shutter camera keeps."""
    assert device.name
    assert list(device.speeds) == sorted(set(device.speeds), reverse=True)
    for speed in (*device.speeds[3::4], device.speeds[0], device.speeds[-1]):
        assert device.set_shutter(speed) == speed
        assert device.shutter() == speed
    device.close()
    device.close()


@pytest.mark.parametrize("model", list(MODELS))
def test_contract(scene: Scene, short: Path, model: str):
    camera = camera_of(scene, model)
    assert camera.mode is AutoExposure.AUTO
    with ViscaPort(camera, short / "dev", speed=FAST):
        check_contract(open_camera(f"visca:{short / 'dev'},model={model}"))
    assert camera.mode is AutoExposure.MANUAL
    assert camera.position == len(camera.model.times) - 1
    assert not (short / "dev").is_symlink()


@pytest.mark.parametrize("baud", [9600, 38400])
def test_the_rate_is_found(scene: Scene, short: Path, baud: int):
    with ViscaPort(camera_of(scene), short / "dev", baud=baud, speed=FAST):
        device = ViscaCamera(os.fspath(short / "dev"), timeout=0.1)
        assert device.set_shutter(1 / 50) == 1 / 50
        device.close()


def test_a_wrong_rate_is_no_answer(scene: Scene, short: Path):
    with (
        ViscaPort(camera_of(scene), short / "dev", baud=9600, speed=FAST),
        pytest.raises(DeviceError, match="no VISCA camera answers at 38400 baud"),
    ):
        ViscaCamera(os.fspath(short / "dev"), bauds=(38400,), timeout=0.1)


@pytest.mark.parametrize(
    "faults",
    [Faults(drop_ack=0.3), Faults(drop=0.25), Faults(garble=0.25)],
    ids=["ACKs dropped", "replies dropped", "replies garbled"],
)
def test_lost_and_damaged_replies_are_recovered_from(scene: Scene, short: Path, faults: Faults):
    """Whatever is lost, a shutter time that is returned is the camera's."""
    camera, done, failed = camera_of(scene), 0, 0
    with ViscaPort(camera, short / "dev", speed=FAST, faults=faults, seed=3):
        for _ in range(3):  # opening may itself meet three losses in a row
            try:
                device = ViscaCamera(os.fspath(short / "dev"), bauds=(9600,), timeout=0.04)
                break
            except DeviceError:
                continue
        else:
            pytest.fail("never opened")
        for i in range(30):
            speed = device.speeds[4 + i % 12]
            try:
                assert device.set_shutter(speed) == speed
            except DeviceError:
                failed += 1
                continue
            done += 1
            assert camera.model.times[camera.position] == speed
        device.close()
    assert done >= 26, f"{failed} of 30 failed"


def test_a_command_is_not_sent_twice_when_only_its_replies_were_lost(scene: Scene, short: Path):
    sent: list[int] = []

    class Counting(VideoCamera):
        def set_shutter(self, position: int) -> bool:
            sent.append(position)
            return super().set_shutter(position)

    camera = Counting(scene, MODELS["evi-d100p"])
    port = ViscaPort(camera, short / "dev", speed=FAST, faults=Faults(drop_ack=1.0))
    with port:
        camera.set_mode(AutoExposure.MANUAL)
        device = ViscaCamera(os.fspath(short / "dev"), timeout=0.05)
        device.set_shutter(1 / 1000)
        device.close()
    assert sent == [0x0D]


def test_silence_is_named_with_the_port(scene: Scene, short: Path):
    with ViscaPort(camera_of(scene), short / "dev", speed=FAST, faults=Faults(silent_after=8)):
        device = ViscaCamera(os.fspath(short / "dev"), timeout=0.05)
        start = time.monotonic()
        device.set_shutter(device.speeds[4])  # packets 7 and 8: the command and its read-back
        with pytest.raises(DeviceError, match=r"dev: the camera stopped answering .*power"):
            device.set_shutter(device.speeds[5])
        assert time.monotonic() - start < 5
        device.close()


def test_ports_that_cannot_be_opened(scene: Scene, short: Path):
    with pytest.raises(DeviceError, match="no such serial port") as caught:
        ViscaCamera(os.fspath(short / "none"))
    assert caught.value.exit_code == 1
    with ViscaPort(camera_of(scene), short / "dev", speed=FAST):
        device = ViscaCamera(os.fspath(short / "dev"))
        with pytest.raises(DeviceError, match="another program uses this serial port"):
            ViscaCamera(os.fspath(short / "dev"))
        device.close()


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("jai:/dev/x", "names no camera"),
        ("visca:", "names no camera"),
        ("visca:/dev/x,model=evi-d30", "no model 'evi-d30'; known: evi-d100p"),
        ("visca:/dev/x,speed=3", "unknown option 'speed=3'"),
        ("visca:/dev/x,baud=fast", "'fast' is no baud rate"),
    ],
)
def test_specifications(spec: str, message: str):
    with pytest.raises(UserError, match=message):
        open_camera(spec)


def test_death_of_the_device(short: Path):
    """The emulator in a process of its own is killed: reads and writes fail, cleanly."""
    code = (
        "import sys, signal, numpy as np\n"
        "from chromeball.acquire.emulate.camera import VideoCamera\n"
        "from chromeball.acquire.emulate.visca import ViscaPort\n"
        "from chromeball.acquire.visca_packets import MODELS\n"
        "camera = VideoCamera(np.ones((4, 4, 3), np.float32), MODELS['evi-d100p'])\n"
        "with ViscaPort(camera, sys.argv[1], speed=20.0):\n"
        "    print('ready', flush=True)\n"
        "    signal.pause()\n"
    )
    link = os.fspath(short / "dev")
    process = subprocess.Popen([sys.executable, "-c", code, link], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        device = ViscaCamera(link)
        device.set_shutter(1 / 50)
        process.send_signal(signal.SIGKILL)
        process.wait()
        with pytest.raises(DeviceError, match="the serial port broke off"):
            device.set_shutter(1 / 100)
        device.close()
        with pytest.raises(DeviceError, match=r"no such serial port|broke off"):
            ViscaCamera(link)
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


# ---- the emulator alone, byte for byte


class Line:
    """Raw bytes to and from the pseudo-terminal."""

    def __init__(self, link: Path) -> None:
        self.handle = os.open(link, os.O_RDWR | os.O_NOCTTY)

    def write(self, text: str) -> None:
        os.write(self.handle, bytes.fromhex(text))

    def read(self, packets: int, patience: float = 2.0) -> list[str]:
        data = b""
        deadline = time.monotonic() + patience
        while data.count(b"\xff") < packets and (left := deadline - time.monotonic()) > 0:
            if select.select([self.handle], [], [], left)[0]:
                data += os.read(self.handle, 1)
        return [(part + b"\xff").hex(" ") for part in data.split(b"\xff")[:-1]]


def test_both_sockets_interleave(scene: Scene, short: Path):
    """Two commands at once: each ACK opens a socket, and its completion names that socket."""
    camera = camera_of(scene)
    camera.set_mode(AutoExposure.MANUAL)
    orders: set[tuple[str, ...]] = set()
    with ViscaPort(camera, short / "dev", baud=38400, speed=2.0):
        line = Line(short / "dev")
        for _ in range(12):
            line.write("81 01 04 4A 00 00 00 00 FF" + "81 01 04 4A 00 00 00 01 FF")
            replies = line.read(4)
            opened: list[str] = []
            for kind, socket in (reply[3:5] for reply in replies):
                if kind == "4":
                    assert socket not in opened
                    opened.append(socket)
                else:
                    opened.remove(socket)
            assert not opened
            orders.add(tuple(replies))
        os.close(line.handle)
    assert ("90 41 ff", "90 42 ff", "90 51 ff", "90 52 ff") in orders


def test_a_third_command_finds_the_buffer_full_and_a_cancelled_one_ends(
    scene: Scene, short: Path
):
    camera = camera_of(scene)
    camera.set_mode(AutoExposure.MANUAL)
    port = ViscaPort(camera, short / "dev")
    done = time.monotonic() + 60
    replies: list[str] = []
    port._reply = lambda body: replies.append(body.hex(" "))  # pyright: ignore
    for position in (3, 4, 5):
        port._command(set_shutter(position), done)  # pyright: ignore[reportPrivateUsage]
    port._command(b"\x22", done)  # pyright: ignore[reportPrivateUsage]
    port._command(b"\x22", done)  # pyright: ignore[reportPrivateUsage]
    assert replies == ["90 41", "90 42", "90 60 03", "90 62 04", "90 62 05"]
    assert camera.position == 4


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("88 30 01 FF", "88 30 02 ff"),
        ("88 01 00 01 FF", "88 01 00 01 ff"),
        ("81 01 00 01 FF", "90 50 ff"),
        ("81 09 04 39 FF", "90 50 00 ff"),
        ("81 01 04 4A 00 00 00 05 FF", "90 61 41 ff"),  # AE is automatic
        ("81 01 04 39 07 FF", "90 60 02 ff"),
        ("81 01 04 4A 00 00 01 04 FF", "90 60 02 ff"),  # off the table
        ("81 01 04 4A 05 FF", "90 60 02 ff"),
        ("81 22 FF", "90 62 05 ff"),
        ("81 77 77 FF", "90 60 02 ff"),
    ],
)
def test_replies_byte_for_byte(scene: Scene, short: Path, command: str, reply: str):
    with ViscaPort(camera_of(scene), short / "dev", speed=FAST):
        line = Line(short / "dev")
        line.write(command)
        assert line.read(1) == [reply]
        os.close(line.handle)


def test_latency_is_that_of_the_real_line(scene: Scene, short: Path):
    """9600 baud, PAL: ACK about 27 ms, completion about 47 ms after the command."""
    camera = camera_of(scene)
    camera.set_mode(AutoExposure.MANUAL)
    acks: list[float] = []
    completions: list[float] = []
    with ViscaPort(camera, short / "dev"):
        line = Line(short / "dev")
        for i in range(12):
            time.sleep(0.013 * (i % 3))
            start = time.monotonic()
            line.write("81 01 04 4A 00 00 00 05 FF")
            assert line.read(1) == ["90 41 ff"]
            acks.append(time.monotonic() - start)
            assert line.read(1) == ["90 51 ff"]
            completions.append(time.monotonic() - start)
        os.close(line.handle)
    # A busy machine only makes it later; the fastest answers are the line's own.
    assert 0.0125 <= min(acks) < 0.040
    assert min(completions) - min(acks) > 0.010
    assert min(completions) < 0.070


def test_a_link_in_the_way(scene: Scene, short: Path):
    (short / "dev").write_text("mine")
    with pytest.raises(UserError, match="something else lies here"):
        ViscaPort(camera_of(scene), short / "dev").__enter__()
    assert (short / "dev").read_text() == "mine"
