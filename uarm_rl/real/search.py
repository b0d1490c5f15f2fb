"""Finding the object with the camera at the arm's hand.

The camera sees a part of the table only, so it looks from several poses; where the object was put down last it looks
first. What it sees near the edge of a picture is off by millimetres (side faces, lens, height), so it looks a second
time from where the object is in the middle, or as near to it as the arm can draw back.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl.real.audit import ObstructedError
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.real.trials import ObjectNotFoundError, Sighting
from uarm_rl.real.vision.camera import Camera, CameraError
from uarm_rl.real.vision.camera_model import Calibration
from uarm_rl.real.vision.detection import Detector, TargetNotFoundError, annotate
from uarm_rl.real.vision.projection import locate_box, look_at, pixel_to_base
from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import Vector

#: Cup radius and height (m), and turns of the base (degrees), of the poses to look from. With the nominal
#: mount and a QVGA picture they see all of the operating range beyond 150 mm from the base's axis, and most of the rest.
_RINGS_M: Final = ((0.225, 0.175), (0.1275, 0.14))
_TURNS_DEG: Final = (15, -15, 45, -45, 75, -75)
_SECOND_LOOK_M: Final = 0.14  # height of the cup, from which it draws back the farthest
_ASIDE_DEG: Final = (0, 4, 8, 12, 16)
_SETTLE_S: Final = 0.2  # the arm swings a little after it has stopped
_MAX_MISFIT_PX: Final = 4.0
_MAX_WIDER: Final = 0.12  # of the object's outline; a cube told 5 mm too wide or too narrow is off by 15 %


class CameraSearch:
    """Looks for an object of ``object_size_m`` (length, width, height) that stands on the table.

    ``whole_object``: the detector outlines all that is seen of the object; else it marks the centre of its upper surface.
    """

    def __init__(
        self,
        camera: Camera,
        detector: Detector,
        calibration: Calibration,
        *,
        object_size_m: Sequence[float],
        whole_object: bool,
    ) -> None:
        self._camera = camera
        self._detector = detector
        self._calibration = calibration
        self._size_m = tuple(object_size_m)
        self._whole_object = whole_object

    def find(self, arm: SwiftArm, guess_m: Vector | None) -> Sighting:
        """Look from pose after pose until the object is seen, then once more from above it."""
        looks = 0
        reasons: Counter[str] = Counter()
        for poses in self._poses(guess_m):
            try:
                self._go(arm, poses)
                looks += 1
                first = self._look(arm)[0]
                self._go(arm, self._above(first))
                looks += 1
                target, misfit_px, picture = self._look(arm)
            except TargetNotFoundError as error:
                reasons[str(error)] += 1
                continue
            apart_m = math.dist(first[:2], target[:2])
            picture = annotate(picture, self._detector.detect(picture), _words(target))
            return Sighting(target, looks, misfit_px, apart_m, picture)
        rarest = min(reasons, key=lambda reason: reasons[reason])  # an empty table is seen often, and tells little
        raise ObjectNotFoundError(
            f"the object was not found in {looks} pictures (one of the reasons: {rarest}); put it in front of the arm, 160 to "
            "350 mm from the axis of its base, and check light, detector and what else is on the table"
        )

    def _poses(self, guess_m: Vector | None) -> Iterator[Iterable[Vector]]:
        """Where to look from, one after the other; each is a choice of poses."""
        if guess_m is not None:
            yield self._above(guess_m)
        for turn_deg in _TURNS_DEG:
            for radius_m, height_m in _RINGS_M:
                turn = math.radians(turn_deg)
                yield [kinematics.inverse((radius_m * math.cos(turn), radius_m * math.sin(turn), height_m))]

    def _above(self, point_m: Vector) -> Iterator[Vector]:
        """Poses that look down at a point; far to the side, where the base cannot turn enough, or beside an obstacle, from a
        little beside it. Raises ``TargetNotFoundError`` behind the last."""
        x, y, z = point_m.tolist()
        reason = ""
        for turn_deg in (*_ASIDE_DEG, *(-aside for aside in _ASIDE_DEG[1:])):
            turn = math.copysign(1.0, -y) * math.radians(turn_deg)
            beside = math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y, z
            try:
                yield look_at(beside, self._calibration, _SECOND_LOOK_M)
            except kinematics.UnreachableError as error:
                reason = reason or str(error)
        if reason:
            raise TargetNotFoundError(reason)

    @staticmethod
    def _go(arm: SwiftArm, poses: Iterable[Vector]) -> None:
        """To the first of the poses that no obstacle is in the way of. Raises ``TargetNotFoundError`` if there is none."""
        refused = ""
        for joints in poses:
            try:
                arm.move_joints(joints.tolist())
            except ObstructedError as error:
                refused = str(error)
            else:
                return
        raise TargetNotFoundError(refused)

    def _look(self, arm: SwiftArm) -> tuple[Vector, float | None, NDArray[np.uint8]]:
        """Target (m), misfit (px) and picture from where the arm is. Raises ``TargetNotFoundError``."""
        arm.rest(_SETTLE_S)
        at = arm.read_joints()
        picture = self._camera.read()
        if getattr(self._camera, "frozen", False):  # it has moved since the last picture, so the picture cannot be the same
            raise CameraError(
                f"{self._camera.name} sends the same picture again and again; unplug it, plug it in and start again"
            )
        self._calibration.lens.check_size(picture)
        seen = self._detector.detect(picture)
        try:
            if not self._whole_object:
                return pixel_to_base(seen.centre_px, at, self._calibration, self._size_m[2]), None, picture
            box = locate_box(seen.outline_px, at, self._calibration, self._size_m)
        except ValueError as error:  # no place on the table explains what is seen
            raise TargetNotFoundError(str(error)) from error
        if box.misfit_px > _MAX_MISFIT_PX:
            raise TargetNotFoundError(
                f"what is seen has not the shape of the object (it misses by {box.misfit_px:.1f} px); check object_size_m, "
                "the detector and the calibration"
            )
        if abs(box.scale - 1.0) > _MAX_WIDER:
            length, width, height = (1000.0 * side for side in self._size_m)
            raise TargetNotFoundError(
                f"what is seen is {100.0 * box.scale:.0f}% as wide as an object of {length:g} x {width:g} x {height:g} mm; "
                "give its true size with object_size_m=[length,width,height] in metres, or check detector and calibration"
            )
        return box.top_m, box.misfit_px, picture


def _words(target_m: Vector) -> str:
    x, y, z = (1000.0 * target_m).tolist()
    return f"({x:.1f}, {y:.1f}, {z:.1f}) mm"
