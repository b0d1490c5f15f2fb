"""Pictures drawn from geometry alone, to hold the camera code against: a box on a table, a board, a marker."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cache

import cv2
import numpy as np

from uarm_rl.real.vision import projection

SCALE = 4  # drawn so much larger and then averaged: edges as a sensor sees them
TABLE_BGR = (150, 140, 130)
TOP_BGR = (20, 20, 235)
SIDES_BGR = ((15, 15, 120), (15, 15, 150), (15, 15, 180), (15, 15, 100))
SIDE_NORMALS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def base_to_pixel(points_m, joints, calibration):
    """Pixels (n, 2) of points in the base frame (n, 3): the way back from ``projection.pixel_to_base``."""
    transform = projection.base_from_camera(joints, calibration)
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    return calibration.lens.pixels((points - transform[:3, 3]) @ transform[:3, :3])


def draw_box(joints, calibration, top_m, yaw=0.0, size_m=(0.03, 0.03, 0.03), *, sides=True, noise=0.0, seed=0):
    """What the camera sees of a red box whose upper surface is centred at ``top_m``; sides may have the table's colour."""
    width, height = calibration.lens.image_size
    image = np.full((height * SCALE, width * SCALE, 3), TABLE_BGR, np.uint8)
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    corners = np.array([[x, y, z] for z in (0.0, -1.0) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))])
    corners = (corners * size_m) @ turn.T + top_m
    eye = projection.base_from_camera(joints, calibration)[:3, 3]
    for side in range(4):
        first, second = side, (side + 1) % 4
        if sides and (eye - corners[first]) @ (turn @ SIDE_NORMALS[side]) > 0.0:
            fill(image, corners[[first, second, second + 4, first + 4]], SIDES_BGR[side], joints, calibration)
    fill(image, corners[:4], TOP_BGR, joints, calibration)
    return as_taken(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), noise, seed)


def draw_dot(joints, calibration, centre_m, radius_m=0.008):
    """A flat red dot."""
    width, height = calibration.lens.image_size
    image = np.full((height * SCALE, width * SCALE, 3), TABLE_BGR, np.uint8)
    angles = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(40)], axis=1)
    with suppress(ValueError):  # behind the camera
        fill(image, centre_m + radius_m * rim, TOP_BGR, joints, calibration)
    return as_taken(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def fill(image, corners_m, colour, joints, calibration):
    edges = zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True)
    points = np.concatenate([first + np.linspace(0.0, 1.0, 8)[:, None] * (second - first) for first, second in edges])
    pixels = base_to_pixel(points, joints, calibration)  # lens distortion bends the edges
    cv2.fillConvexPoly(image, np.round(((pixels + 0.5) * SCALE - 0.5) * 256).astype(np.int32), colour, cv2.LINE_8, 8)


def as_taken(image, noise=0.0, seed=0):
    """With the sensor's noise, through the JPEG of the camera."""
    noisy = image + np.random.default_rng(seed).normal(0.0, noise, image.shape) if noise else image
    _, data = cv2.imencode(".jpg", np.clip(noisy, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return cv2.imdecode(data, cv2.IMREAD_COLOR)


def draw_plate(texture, size_m, camera_from_plate, intrinsics):
    """A flat plate with a grey texture, centred at the plate's origin, on something dark, through lens and JPEG.

    ``size_m``: width and height of the plate. The texture's top left is at -x, -y; its pixels should be about as large
    as the picture's.
    """
    rays = _rays(intrinsics)
    rotation, origin = camera_from_plate[:3, :3], camera_from_plate[:3, 3]
    along = (rotation[:, 2] @ origin) / (rays @ rotation[:, 2])
    on_plate = (rays * along[:, None] - origin) @ rotation[:, :2]
    lookup = (on_plate / np.array(size_m) + 0.5) * np.array(texture.shape[1::-1]) - 0.5
    lookup = lookup.astype(np.float32).reshape(*intrinsics.image_size[::-1], 2)
    image = cv2.remap(texture, lookup[..., 0], lookup[..., 1], cv2.INTER_LINEAR, borderValue=60)
    return as_taken(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), noise=1.0)


@cache  # by identity: undistorting so many pixels takes a while
def _rays(intrinsics):
    v, u = np.indices(intrinsics.image_size[::-1]).reshape(2, -1)
    plane = intrinsics.image_plane(np.stack([u, v], axis=1))
    return np.column_stack([plane, np.ones(len(plane))])


def pose(turn_rad, shift_m):
    """A rigid transform of a rotation vector and a shift, shape (4, 4)."""
    transform = np.eye(4)
    transform[:3, :3] = cv2.Rodrigues(np.asarray(turn_rad, dtype=np.float64))[0]
    transform[:3, 3] = shift_m
    return transform
