"""The emulated workplace: arm, camera and object behind two pseudo-terminals, or in memory."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Final

import numpy as np

from uarm_rl import checks, signals
from uarm_rl.emulator.camera import SnapCamera
from uarm_rl.emulator.faults import CameraFault, Fault
from uarm_rl.emulator.firmware import Firmware
from uarm_rl.emulator.firmware_3_2 import MarlinFirmware
from uarm_rl.emulator.optics import Optics, Picture, plain_texture, tag_texture
from uarm_rl.emulator.physics import Place, World
from uarm_rl.emulator.pty import MAX_SPEED, PtyServer
from uarm_rl.emulator.realism import Realism, Settings
from uarm_rl.real.ports import SPEED
from uarm_rl.real.vision.camera_model import Calibration, nominal
from uarm_rl.sim.cup import Bellows
from uarm_rl.task import kinematics, positions
from uarm_rl.task.obstacles import Box, boxes, leaves_room

_LOOKS: Final = ("box", "sticker", "tag")
_UNPAINTED: Final = (0.9, 0.9, 0.88)
_TAG: Final = 0
_WAIT_S: Final = 0.1
_BESIDE_M: Final = 0.02  # between the arm over an object and an obstacle: somebody who puts an object down leaves it room


def emulate(*, speed: float, **workplace: Any) -> None:
    """Emulate arm and camera on two pseudo-terminals until Ctrl-C or SIGTERM; then return.

    Prints ``arm: PATH`` and ``camera: PATH`` first, flushed, then what is behind them. ``speed``: seconds of arm time in a
    second; a world that cannot keep up slows down. The other keywords are those of :class:`Workplace`. Together they are
    the keys of ``conf/emulate.yaml``. Raises ``ValueError`` with a sentence for a value that cannot be used, before
    anything is printed.
    """
    checks.number("speed", speed, low=0.0, high=MAX_SPEED, open_low=True)
    stop = threading.Event()
    with (
        signals.heard(lambda number: stop.set()),
        Workplace(**workplace) as place,
        PtyServer(place.firmware, speed=speed) as arm,
        PtyServer(place.camera, speed=speed, reset_on_open=False) as camera,
        TemporaryDirectory(prefix="uarm-rl-") as folder,
    ):
        Path(folder, SPEED).write_text(f"{speed!r}\n")
        plugged = {"arm": arm, "camera": camera}
        for name, server in plugged.items():  # beside each other, so that who has the arm's finds the camera's
            Path(folder, name).symlink_to(server.path)
            print(f"{name}: {Path(folder, name)}")
        print(f"{place}, {speed:g} times as fast as real; Ctrl-C ends it", flush=True)
        while not stop.wait(_WAIT_S):
            for name in [name for name, server in plugged.items() if server.wait(0.0)]:
                plugged.pop(name).close()  # raises what broke it
                print(f"the cable of the {name} is unplugged", flush=True)


class Workplace:
    """Arm, camera and object without terminals, for tests and for studies in virtual time; a context manager.

    ``firmware`` and ``camera`` are devices: ``MemoryPort`` makes ports of them, ``PtyServer`` terminals.

    ``firmware``: V4.10, V4.5 or V3.2. ``sim``, ``cup``, ``realism``, ``faults``: the groups of that name in ``conf/``, as plain
    values. ``object_position``: (x, y, z) in metres of the object's upper surface, or ``None`` for a random place that the cup
    can reach, at least ``nearest_m`` from the base's axis. ``obstacle``: see :func:`uarm_rl.task.obstacles.boxes`.
    ``replace_object``: see :class:`World`. ``look``: ``box`` (painted all over), ``sticker`` (painted on top) or ``tag`` (an
    AprilTag on top). ``colour``: red, green, blue, 0 to 255. ``calibration``: file with lens and mount of the camera, or
    ``None`` for the nominal ones at ``image_size`` (w, h). ``seed`` determines everything random but not when bytes arrive.
    """

    def __init__(
        self,
        *,
        firmware: str | float,
        seed: int,
        sim: Mapping[str, Any],
        cup: Mapping[str, Any],
        realism: Mapping[str, Any],
        faults: Mapping[str, Sequence[Mapping[str, Any]]],
        object_position: Sequence[float] | None,
        obstacle: Any,
        nearest_m: float,
        replace_object: bool,
        look: str,
        colour: Sequence[int],
        calibration: str | None,
        image_size: Sequence[int],
    ) -> None:
        version = _version(firmware)
        real = _build("realism", Realism, realism)
        arm_faults = tuple(_fault(Fault, fault) for fault in faults["arm"])
        camera_faults = tuple(_fault(CameraFault, fault) for fault in faults["camera"])
        camera_truth = _calibration(calibration, image_size)
        paint, top = _appearance(look, colour)
        seeds = np.random.SeedSequence(checks.integer("seed", seed, low=0)).spawn(4)
        of_arm, of_camera, of_places, of_encoders = (np.random.default_rng(sequence) for sequence in seeds)
        settings = Settings(
            firmware=version,
            encoder_offset_deg=real.draw_joint_offset_deg(of_arm),
            encoder_noise_deg=real.encoder_noise_deg,
            noise_seed=int(of_encoders.integers(2**32)),
            boot_s=real.boot_s,
            latency_s=real.serial_latency_s,
        )
        engine, world = sim["name"], {key: value for key, value in sim.items() if key != "name"}
        if engine != "pybullet":
            raise ValueError(f"the emulator's world is PyBullet's and has no other engine; leave sim={engine} out")
        height_m = float(sim["object_size_m"])
        checks.number("nearest_m", nearest_m, low=0.0, high=0.3)
        standing = boxes("obstacle", obstacle)
        self.world: World = _build(
            "sim",
            World,
            world,
            _places(of_places, height_m, nearest_m, _position(object_position), standing),
            cup=_cup(cup),
            obstacles=standing,
            nearest_m=nearest_m,
            replace_object=replace_object,
            backlash_deg=real.backlash_deg,
            suction_n=real.suction_n,
            grip_s=real.grip_s,
            paint=paint,
        )
        kind = MarlinFirmware if version == "V3.2.0" else Firmware
        self.firmware = kind(settings, self.world, faults=arm_faults)
        self.optics = Optics(camera_truth, real, of_camera, top=top)
        self.camera = SnapCamera(self.picture, jpeg_quality=real.jpeg_quality, snap_s=real.snap_s, faults=camera_faults)

    def picture(self) -> Picture:
        """What the camera sees now: BGR, shape (h, w, 3), before JPEG."""
        return self.optics.picture(self.world)

    def __str__(self) -> str:
        x, y, z = (1000.0 * value for value in self.world.object_position() or (np.nan,) * 3)
        return f"uArm Swift Pro with firmware {self.firmware.settings.firmware}, object at ({x:.0f}, {y:.0f}, {z:.0f}) mm"

    def close(self) -> None:
        """End the world; closing twice is fine."""
        self.world.close()

    def __enter__(self) -> Workplace:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


# YAML and the command line read an unquoted 4.10 as the number 4.1; there is no other 4.1 here.
_VERSIONS: Final = {"4.10": "V4.10.0", "4.1": "V4.10.0", "4.10.0": "V4.10.0", "4.5": "V4.5.0", "4.5.0": "V4.5.0"} | {
    "3.2": "V3.2.0",
    "3.2.0": "V3.2.0",
}


def _version(firmware: str | float) -> str:
    try:
        return _VERSIONS[str(firmware).upper().removeprefix("V")]
    except KeyError:
        raise ValueError(f"firmware is V4.10, V4.5 or V3.2, got {firmware!r}") from None


def _build(group: str, kind: Any, settings: Mapping[str, Any], *values: Any, **more: Any) -> Any:
    try:
        return kind(*values, **settings, **more)
    except TypeError as error:
        raise ValueError(f"the keys of {group} do not fit: {error}") from error


def _cup(settings: Mapping[str, Any]) -> Bellows | None:
    if settings.get("name") not in ("rigid", "bellows"):
        raise ValueError(f"cup is rigid or bellows, got {settings.get('name')!r}")
    values = {key: value for key, value in settings.items() if key != "name"}
    bellows: Bellows | None = _build("cup", Bellows, values) if settings["name"] == "bellows" else None
    return bellows


def _fault(kind: type[Fault], settings: Mapping[str, Any]) -> Any:
    values = dict(settings)
    values["data"] = str(values.get("data", "")).encode("latin-1")
    fault: Fault = _build("faults", kind, values)
    return fault


def _calibration(path: str | None, image_size: Sequence[int]) -> Calibration:
    if path is not None:
        return Calibration.load(Path(path))
    checks.numbers("image_size", image_size, (320, 240), "two numbers of pixels, width and height")
    width, height = checks.integers("image_size", image_size, low=32, high=1280)
    return nominal((width, height))


def _appearance(look: str, colour: Sequence[int]) -> tuple[tuple[float, ...], Picture | None]:
    """Paint of the box (0 to 1), and what lies on top of it."""
    if look not in _LOOKS:
        raise ValueError(f"look is one of {', '.join(_LOOKS)}, got {look!r}")
    checks.numbers("colour", colour, (217, 38, 26), "three numbers, red, green and blue")
    checks.integers("colour", colour, low=0, high=255)
    if look == "box":
        return tuple(value / 255.0 for value in colour), None
    return _UNPAINTED, tag_texture(_TAG) if look == "tag" else plain_texture(colour)


def _position(position: Sequence[float] | None) -> Sequence[float] | None:
    if position is None:
        return None
    position = checks.position("object_position", position)
    if not kinematics.reachable(position):
        raise ValueError(f"the cup cannot reach object_position {list(position)!r}; it is the upper surface, in metres")
    return position


def _places(
    generator: np.random.Generator, height_m: float, nearest_m: float, first: Sequence[float] | None, standing: Sequence[Box]
) -> Iterator[Place]:
    """Where the object is put, one after the other; at any angle, but for the place that somebody chose."""
    if first is not None:
        yield first, 0.0
    while True:
        place = positions.draw(generator, height_m)
        if math.hypot(place[0], place[1]) >= nearest_m and leaves_room(place, standing, _BESIDE_M):
            yield place, float(generator.uniform(-np.pi / 4.0, np.pi / 4.0))
