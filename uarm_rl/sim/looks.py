"""What the arm looks like, for films and pages: no shape here collides or weighs anything.

The engines' model is a chain of four joints. The real arm has rods besides, which keep elbow, wrist and hand level and drive
the forearm from the shoulder; they follow from the joints, and are drawn. Lengths are those of :mod:`uarm_rl.task.kinematics`,
the rest is by eye.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box

#: Red, green, blue, from 0 to 1.
Colour = tuple[float, float, float]

WHITE: Final[Colour] = (0.93, 0.94, 0.95)
DARK: Final[Colour] = (0.22, 0.24, 0.28)
METAL: Final[Colour] = (0.66, 0.69, 0.73)
ACCENT: Final[Colour] = (0.16, 0.50, 0.74)
RUBBER: Final[Colour] = (0.13, 0.13, 0.14)
HOSE: Final[Colour] = (0.55, 0.70, 0.80)
OBJECT: Final[Colour] = (0.90, 0.32, 0.26)
OBSTACLE: Final[Colour] = (0.42, 0.50, 0.60)
FLOOR: Final[Colour] = (0.92, 0.93, 0.94)
EDGE: Final[Colour] = (0.74, 0.76, 0.78)
FLOOR_RADIUS_M: Final = 0.62
FLOOR_THICK_M: Final = 0.012

#: Towards the light.
LIGHT: Final = (0.6, -0.5, 1.1)

#: w, x, y, z; and of a frame: position (3,), m, and quaternion w, x, y, z (4,).
Quaternion = tuple[float, float, float, float]
Pose = tuple[tuple[float, float, float], Quaternion]


class Mesh(NamedTuple):
    """Triangles, counterclockwise as seen from outside. Every edge has vertices of its own on both sides, so it looks sharp."""

    vertices: Vector  # (n, 3), m
    normals: Vector  # (n, 3)
    faces: NDArray[np.int32]  # (m, 3)


class Part(NamedTuple):
    """What is drawn with one colour in one frame of :func:`poses`."""

    frame: str
    colour: Colour
    mesh: Mesh


# Where the rods are: behind the joints and above them, in the arm's plane, m
_LEVEL_ROD: Final = (-0.040, 0.012)  # of the rod that keeps the elbow's plate level, from shoulder and elbow
_HAND_ROD: Final = (0.004, 0.036)  # of the one that keeps the hand level, from elbow and wrist
_CRANK_M: Final = 0.045  # behind shoulder and elbow, of the rod that drives the forearm
_HOSE_SIDE_M: Final = -0.021
_HOSE_PIECE_M: Final = 0.011
_HOSE_PIECES: Final = 52


def poses(joints_rad: Sequence[float], compression_m: float = 0.0) -> dict[str, Pose]:
    """Where every frame of the arm is at joint1 to joint3 (more are ignored), with bellows that are pressed together so far."""
    turn, lower = float(joints_rad[0]), float(joints_rad[1])
    fall = lower + float(joints_rad[2])  # how far the forearm points down
    shoulder = (kinematics.SHOULDER_FORWARD_M, kinematics.SHOULDER_HEIGHT_M)
    elbow = _moved(shoulder, lower, 0.0, kinematics.LOWER_ARM_M)
    wrist = _moved(elbow, fall, kinematics.FOREARM_M, 0.0)
    cup = (wrist[0] + kinematics.CUP_FORWARD_M, wrist[1] - kinematics.CUP_DOWN_M + compression_m)
    flat = {
        "turret": ((0.0, 0.0), 0.0),
        "lower_arm": (shoulder, lower),
        "level_rod": (_moved(shoulder, 0.0, *_LEVEL_ROD), lower),
        "crank": (shoulder, fall),
        "drive_rod": (_moved(shoulder, fall, -_CRANK_M, 0.0), lower),
        "elbow": (elbow, 0.0),
        "forearm": (elbow, fall),
        "hand_rod": (_moved(elbow, 0.0, *_HAND_ROD), fall),
        "hand": (wrist, 0.0),
        "cup": (cup, 0.0),
    }
    placed = {name: _placed(turn, at, pitch) for name, (at, pitch) in flat.items()}
    for number, (at, pitch) in enumerate(_hose(elbow, fall, wrist)):
        placed[f"hose{number}"] = _placed(turn, at, pitch, _HOSE_SIDE_M)
    return placed | {"base": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))}


#: What a frame hangs from: seen from there it turns and stays where it is. The others stand on the table.
PARENTS: Final = {
    **dict.fromkeys(("lower_arm", "level_rod", "crank"), "turret"),
    **dict.fromkeys(("elbow", "forearm"), "lower_arm"),
    "drive_rod": "crank",
    "hand_rod": "elbow",
    "hand": "forearm",
    "cup": "hand",
}


def seen_from(parent: Pose, pose: Pose) -> Pose:
    """A pose in another's frame, rounded to what nobody sees."""
    (w, x, y, z), (p, q) = parent[1], pose
    turned = _times((w, -x, -y, -z), q)
    dx, dy, dz = (one - other for one, other in zip(p, parent[0], strict=True))
    _, *place = _times(_times((w, -x, -y, -z), (0.0, dx, dy, dz)), (w, x, y, z))
    a, b, c = (round(value, 7) for value in place)
    d, e, f, g = (round(value, 6) for value in turned)
    return (a, b, c), (d, e, f, g)


def _times(one: Quaternion, other: Quaternion) -> Quaternion:
    """Hamilton's product."""
    (a, b, c, d), (e, f, g, h) = one, other
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _moved(at: tuple[float, float], pitch: float, ahead: float, up: float) -> tuple[float, float]:
    """The point that far ahead and up of ``at`` in a frame that is pitched down."""
    sin, cos = math.sin(pitch), math.cos(pitch)
    return at[0] + ahead * cos + up * sin, at[1] - ahead * sin + up * cos


def _placed(turn: float, at: tuple[float, float], pitch: float, side: float = 0.0) -> Pose:
    """A pose in the arm's plane, which is turned about the vertical axis."""
    sin, cos = math.sin(turn), math.cos(turn)
    s1, c1, s2, c2 = math.sin(turn / 2), math.cos(turn / 2), math.sin(pitch / 2), math.cos(pitch / 2)
    return (at[0] * cos - side * sin, at[0] * sin + side * cos, at[1]), (c1 * c2, -s1 * s2, c1 * s2, s1 * c2)


def _hose(elbow: tuple[float, float], fall: float, wrist: tuple[float, float]) -> Iterator[tuple[tuple[float, float], float]]:
    """Where the pieces of the suction hose are, from the hand along the forearm down to the turret: middle and pitch."""
    way = np.array(
        [
            _moved(wrist, 0.0, 0.052, -0.032),
            _moved(wrist, 0.0, 0.074, 0.004),
            _moved(wrist, 0.0, 0.040, 0.044),
            _moved(elbow, fall, 0.100, 0.030),
            _moved(elbow, fall, 0.030, 0.026),
            _moved(elbow, 0.0, -0.040, 0.028),
            _moved(elbow, 0.0, -0.075, -0.030),
            (-0.062, 0.125),
            (-0.040, 0.085),
            (-0.020, 0.0),
            (-0.020, -0.5),
        ]
    )
    points = _smooth(way)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    ends = np.arange(_HOSE_PIECES + 1) * _HOSE_PIECE_M
    r, z = (np.interp(ends, along, points[:, axis]) for axis in (0, 1))
    for (r0, z0), (r1, z1) in zip(zip(r, z, strict=True), zip(r[1:], z[1:], strict=False), strict=False):
        yield (float(r0 + r1) / 2, float(z0 + z1) / 2), math.atan2(r1 - r0, z1 - z0)


def _smooth(way: Vector) -> Vector:
    """A curve through the points, shape (n, 2): Catmull and Rom's."""
    before, after = np.vstack([way[:1], way[:-1]]), np.vstack([way[1:], way[-1:]])
    slopes = (after - before) / 2.0
    t = np.linspace(0.0, 1.0, 12, endpoint=False)[:, np.newaxis, np.newaxis]
    a, b, v, w = way[:-1], way[1:], slopes[:-1], slopes[1:]
    curve = (2 * t**3 - 3 * t**2 + 1) * a + (t**3 - 2 * t**2 + t) * v + (3 * t**2 - 2 * t**3) * b + (t**3 - t**2) * w
    return np.vstack([curve.transpose(1, 0, 2).reshape(-1, 2), way[-1:]])


@cache
def parts() -> tuple[Part, ...]:
    """The arm's parts; those of one frame and colour are one."""
    together: dict[tuple[str, Colour], list[Mesh]] = {}
    for frame, colour, mesh in _pieces():
        together.setdefault((frame, colour), []).append(mesh)
    return tuple(Part(frame, colour, joined(meshes)) for (frame, colour), meshes in together.items())


def _pieces() -> Iterator[Part]:
    long, far, ahead = kinematics.LOWER_ARM_M, kinematics.FOREARM_M, kinematics.CUP_FORWARD_M
    up, forward = kinematics.SHOULDER_HEIGHT_M, kinematics.SHOULDER_FORWARD_M
    foot = [(0.0, 0.0), (0.066, 0.0), (0.068, 0.002), (0.068, 0.010), (0.066, 0.012), (0.062, 0.012)]
    yield Part("base", DARK, lathe([*foot, (0.060, 0.056), (0.057, 0.060), (0.0, 0.060)]))
    yield Part("base", ACCENT, lathe([(0.0, 0.060), (0.052, 0.060), (0.052, 0.063), (0.0, 0.063)]))
    yield Part(
        "turret", WHITE, lathe([(0.0, 0.063), (0.058, 0.063), (0.060, 0.065), (0.060, 0.073), (0.058, 0.075), (0.0, 0.075)])
    )
    for side in (-1.0, 1.0):
        cheek = [(forward, up, 0.021), (forward - 0.030, 0.080, 0.008), (forward + 0.026, 0.080, 0.008)]
        yield Part("turret", WHITE, slab(cheek, 0.005, at=side * 0.026))
        yield Part(
            "turret",
            DARK,
            slab([(forward + x, up + z, 0.006) for x in (-0.016, 0.016) for z in (-0.016, 0.016)], 0.030, at=side * 0.044),
        )
        yield Part("turret", METAL, slab([(forward, up, 0.012)], 0.003, at=side * 0.0605))
        yield Part("lower_arm", WHITE, slab([(0.0, 0.0, 0.016), (0.0, long, 0.013)], 0.005, at=side * 0.0165))
        yield Part("lower_arm", ACCENT, slab([(0.0, long, 0.008)], 0.004, at=side * 0.0200))
        yield Part(
            "forearm", WHITE, slab([(-_CRANK_M, 0.0, 0.009), (0.0, 0.0, 0.013), (far, 0.0, 0.010)], 0.004, at=side * 0.0095)
        )
        yield Part(
            "hand", WHITE, slab([(0.0, 0.0, 0.010), (*_HAND_ROD, 0.007), (0.030, -0.002, 0.010)], 0.004, at=side * 0.0145)
        )
        yield Part("hand", ACCENT, slab([(0.0, 0.0, 0.0065)], 0.003, at=side * 0.0175))
    yield Part("lower_arm", DARK, slab([(0.0, 0.030, 0.008), (0.0, long - 0.034, 0.008)], 0.028))
    yield Part("lower_arm", METAL, slab([(0.0, long, 0.006)], 0.046))
    yield Part("lower_arm", METAL, slab([(0.0, 0.0, 0.009)], 0.058))
    yield Part("forearm", DARK, slab([(0.030, 0.0, 0.006), (far - 0.030, 0.0, 0.006)], 0.016))
    yield Part("crank", METAL, slab([(-_CRANK_M, 0.0, 0.008), (0.0, 0.0, 0.013)], 0.005, at=-0.0035))
    yield Part("drive_rod", METAL, slab([(0.0, 0.0, 0.0055), (0.0, long, 0.0055)], 0.005, at=0.0025))
    yield Part("level_rod", METAL, slab([(0.0, 0.0, 0.0050), (0.0, long, 0.0050)], 0.004, at=0.0225))
    yield Part(
        "turret", WHITE, slab([(forward, up, 0.012), (forward + _LEVEL_ROD[0], up + _LEVEL_ROD[1], 0.008)], 0.004, at=0.0265)
    )
    triangle = [(0.0, 0.0, 0.013), (*_LEVEL_ROD, 0.008), (*_HAND_ROD, 0.008)]
    yield Part("elbow", DARK, slab(triangle, 0.005, at=0.0270))
    yield Part("hand_rod", METAL, slab([(0.0, 0.0, 0.0050), (far, 0.0, 0.0050)], 0.004, at=0.0225))
    yield Part("hand", METAL, slab([(*_HAND_ROD, 0.004)], 0.044))
    yield Part("hand", METAL, slab([(0.0, 0.0, 0.005)], 0.038))
    yield Part("hand", DARK, slab([(ahead + x, z, 0.004) for x in (-0.017, 0.013) for z in (-0.026, 0.006)], 0.034))
    yield Part("hand", METAL, moved(lathe([(0.0, 0.0), (0.005, 0.0), (0.005, 0.026), (0.0, 0.026)]), (ahead, 0.0, -0.054)))
    yield Part(
        "cup",
        RUBBER,
        lathe(
            [
                (0.0, 0.0008),
                (0.0085, 0.0),
                (0.0095, 0.0012),
                (0.0065, 0.0065),
                (0.0085, 0.0095),
                (0.0060, 0.0125),
                (0.0078, 0.0155),
                (0.0055, 0.0185),
                (0.0055, 0.0215),
                (0.0, 0.0215),
            ]
        ),
    )
    half = 0.5 * _HOSE_PIECE_M + 0.0006
    piece = lathe([(0.0, -half - 0.001), (0.0026, -half), (0.0026, half), (0.0, half + 0.001)], 10)
    for number in range(_HOSE_PIECES):
        yield Part(f"hose{number}", HOSE, piece)


def box(length_m: float, width_m: float | None = None, height_m: float | None = None) -> Mesh:
    """A box about its centre with edges that are broken a little; a cube, as the object is, where one side is given."""
    wide, high = width_m or length_m, height_m or length_m
    edge = 0.06 * min(length_m, wide, high)
    x, z = length_m / 2.0 - edge, high / 2.0 - edge
    return slab([(x * one, z * other, edge) for one in (-1.0, 1.0) for other in (-1.0, 1.0)], wide, bevel=0.5 * edge)


def obstacle(one: Box) -> Mesh:
    """An obstacle, where it stands."""
    return moved(box(*one.size_m), one.centre_m)


def floor() -> Mesh:
    """A round table."""
    radius, below = FLOOR_RADIUS_M, -FLOOR_THICK_M
    return lathe([(0.0, below), (radius, below), (radius, 0.0), (0.0, 0.0)], 96)


# Two ways to make a shape


def slab(circles: Iterable[tuple[float, float, float]], thickness: float, *, at: float = 0.0, bevel: float = 0.0008) -> Mesh:
    """A plate around circles (x, z, radius), as a rubber band would lie; its middle is at y = ``at``."""
    angles = np.linspace(0.0, 2.0 * math.pi, 28, endpoint=False)
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    given = np.array(list(circles))
    spots, radii = np.repeat(given[:, :2], len(around), 0), np.repeat(given[:, 2], len(around))
    outwards = np.tile(around, (len(given), 1))
    hull = _hull(spots + radii[:, np.newaxis] * outwards)
    spots, radii, outwards = spots[hull], radii[hull], outwards[hull]

    def ring(y: float, inset: float) -> Vector:
        return _in_plane(spots + (radii - inset)[:, np.newaxis] * outwards, at + y)

    half = thickness / 2.0
    rings = [ring(-half, bevel), ring(bevel - half, 0.0), ring(half - bevel, 0.0), ring(half, bevel)]
    tilts = ((-1.0, 1.0), (0.0, 1.0), (1.0, 1.0))
    strips = [
        _strip(rings[number], rings[number + 1], _in_plane(tilt[1] * outwards, tilt[0])) for number, tilt in enumerate(tilts)
    ]
    return joined([*strips, _cap(rings[0][::-1], (0.0, -1.0, 0.0)), _cap(rings[-1], (0.0, 1.0, 0.0))])


def lathe(profile: Sequence[tuple[float, float]], sides: int = 48) -> Mesh:
    """What turns about the z axis: (radius, z) from the middle of its lower side outwards, up, and to the middle again."""
    angles = np.linspace(0.0, -2.0 * math.pi, sides, endpoint=False)
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    strips = []
    for (r0, z0), (r1, z1) in pairwise(profile):
        low, high = (np.column_stack([r * around, np.full(sides, z)]) for r, z in ((r0, z0), (r1, z1)))
        strips.append(_strip(low, high, np.column_stack([(z1 - z0) * around, np.full(sides, r0 - r1)])))
    return joined(strips)


def moved(mesh: Mesh, by_m: Sequence[float]) -> Mesh:
    """The mesh, elsewhere."""
    return mesh._replace(vertices=mesh.vertices + np.asarray(by_m))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
    )


def _in_plane(points: Vector, y: float) -> Vector:
    return np.column_stack([points[:, 0], np.full(len(points), y), points[:, 1]])


def _strip(low: Vector, high: Vector, normals: Vector) -> Mesh:
    """Between two rings, shape (n, 3), that go round clockwise as seen from the second."""
    n = len(low)
    one, next_one = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate([np.column_stack([one, one + n, next_one]), np.column_stack([next_one, one + n, next_one + n])])
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = Mesh(np.concatenate([low, high]), np.concatenate([unit, unit]), faces.astype(np.int32))
    return mesh._replace(faces=mesh.faces[_area(mesh) > 0.0])


def _area(mesh: Mesh) -> Vector:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in (0, 1, 2))
    area: Vector = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return area


def _cap(ring: Vector, normal: tuple[float, float, float]) -> Mesh:
    """A flat end, shape (n, 3), clockwise as seen from outside."""
    others = np.arange(1, len(ring) - 1)
    faces = np.column_stack([np.zeros_like(others), others + 1, others])
    return Mesh(ring, np.tile(np.array(normal), (len(ring), 1)), faces.astype(np.int32))


def _hull(points: Vector) -> list[int]:
    """Which points are corners of their convex hull, counterclockwise: Andrew's monotone chain."""
    order = np.lexsort(points.T[::-1]).tolist()

    def chain(numbers: Iterable[int]) -> list[int]:
        kept: list[int] = []
        for number in numbers:
            while len(kept) > 1 and _left(points[kept[-2]], points[kept[-1]], points[number]) <= 1e-12:
                kept.pop()
            kept.append(number)
        return kept[:-1]

    return chain(order) + chain(order[::-1])


def _left(a: Vector, b: Vector, c: Vector) -> float:
    """Above zero where the way from a over b to c turns left."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
