"""The way from rest to rest with a trapezoidal speed, as the arm's firmware plans every move."""

from __future__ import annotations

import math
from typing import NamedTuple


class Trapezoid(NamedTuple):
    """Speeds up for ``ramp_s``, cruises, and slows down for ``ramp_s``; a short way is a triangle."""

    begins_s: float
    duration_s: float
    ramp_s: float

    @property
    def ends_s(self) -> float:
        return self.begins_s + self.duration_s

    def share(self, time_s: float) -> float:
        """How much of the way has been travelled, from 0 to 1."""
        t = time_s - self.begins_s
        if t <= 0.0:
            return 0.0
        if t >= self.duration_s:
            return 1.0
        ramp, total = self.ramp_s, self.duration_s
        whole = total - ramp  # distance in units of the cruising speed
        if t < ramp:
            travelled = 0.5 * t * t / ramp
        elif t <= total - ramp:
            travelled = t - 0.5 * ramp
        else:
            travelled = whole - 0.5 * (total - t) ** 2 / ramp
        return travelled / whole


def trapezoid(begins_s: float, distance: float, speed: float, acceleration: float) -> Trapezoid:
    """The quickest way of a length, in any unit, within a speed and an acceleration of that unit; all above zero."""
    speed = min(speed, math.sqrt(distance * acceleration))
    ramp_s = speed / acceleration
    return Trapezoid(begins_s, distance / speed + ramp_s, ramp_s)
