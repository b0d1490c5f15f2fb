"""The suction task as a Gymnasium environment over any arm. One step is one decision, however long it is held."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks, columns
from uarm_rl.task import kinematics, obstacles, positions
from uarm_rl.task.arm import Arm, ArmError, Ghost, JointPositions, PhysicsError, Target
from uarm_rl.task.hold import Hold, change_rad_of, travel_rad_of
from uarm_rl.task.layouts import Layout, Layouts, Reach, in_order
from uarm_rl.task.observation import Look, Observation, PaperObservation
from uarm_rl.task.reward import DistanceReward, RewardTerms
from uarm_rl.task.within import Moment, Within, decisions_within

ACTION_SIZE: Final = 3

#: What an action of the joints is relative to.
ACTIONS: Final = ("joint", "reference", "absolute", "torque")
_A_LITTLE_RAD: Final = 1e-3  # so far a torque is taken to go, where it is asked whether a limit is in its way

_LONGEST_S: Final = 3600.0
_OPTIONS: Final = ("object_position", "obstacles", "home", "ghost", "tolerance_m")


class UArmSuctionEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Bring the suction cup to the centre of the object's upper surface and keep it there.

    *Observation*: 20 numbers or more, see ``observation``. *Action*: 3 numbers in [-1, 1], times ``max_delta_rad`` the
    difference between reference and current position of joint1..joint3; with ``actions="reference"`` that between reference
    and last reference, with ``"absolute"`` -1 and 1 are each joint's own limits. References are cut at the joint limits.
    With ``"torque"`` there are none: the numbers are shares of the motors' torque. A hold that is learned takes a fourth
    number. *Step*: the command acts until ``hold`` releases it. *Reward*: ``reward``, equation (4) of the paper.

    ``layouts`` is what may stand where: an object alone, or obstacles too, which are then behind the other numbers of the
    observation. One that is drawn begins at home, or where it says.

    ``terminated``: success (``info["is_success"]``), the cup stayed within ``tolerance_m`` of the target for ``dwell_s``
    without a break (the flag); or the arm touched an obstacle, and success is out of reach. In a layout that is drawn a
    touch is one of the capsules around the arm (:mod:`uarm_rl.task.obstacles`), in others one that the engine feels.
    ``truncated``: ``time_limit_s`` of arm time has passed (``None``: no limit), the object was pushed out of reach, or the
    simulation exploded (``info["exploded"]``; only a reset with ``home`` mends it).

    ``reset`` takes the options ``object_position`` (three numbers, m; default: a random one), with it ``obstacles`` (six
    numbers each, see :func:`uarm_rl.task.obstacles.boxes`; default: none), ``home`` (default true; false leaves the arm
    where it is and only places a new object) and, with ``home``, ``ghost`` (whether the target is told and nothing solid
    is there; default: a ``ghost_share`` of the episodes) and ``tolerance_m`` (default: drawn between ``tightest_m`` and
    ``tolerance_m``, where the former is given).

    ``info`` has the same keys after ``reset`` and ``step``: ``is_success``, ``distance_m``, ``object_position`` (3,),
    ``control_steps`` of the decision, ``clipped`` (the reference was cut at a limit), ``travel_rad`` (largest joint difference
    between the two states), the reward's terms, ``object_moved_m``, ``object_lost``, ``exploded``, ``ghost``, and how the arm
    leans: ``press_m`` and ``reference_press_m``, how far the cup and the commanded one were below the object's upper surface
    while over it, and ``contact_n``, the largest normal force between them. ``touched`` tells whether the arm has touched
    an obstacle, and ``obstacle_contact_n`` with what force. How the decision went, control
    step by control step, is in ``trace``.

    With ``keep_within``, for training, ``info`` of a ``step`` has ``within`` too: the decisions that might have begun at the
    control steps of this one (:mod:`uarm_rl.task.within`).

    ``metadata`` is each environment's own: ``render_fps`` is the number of decisions a second, so that a film with a picture a
    decision plays at about the arm's speed; with ``rgb_array_list``, ``render`` has a picture for every control step.

    A copy, by ``copy.deepcopy`` or ``pickle``, has a world of its own and begins with ``reset``.
    """

    metadata = {"render_modes": ["rgb_array", "rgb_array_list"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own form)

    def __init__(
        self,
        arm: Arm,
        target: Target,
        reward: DistanceReward,
        hold: Hold,
        *,
        control_hz: int,
        max_delta_rad: float,
        tolerance_m: float,
        dwell_s: float,
        time_limit_s: float | None,
        object_height_m: float,
        ghost_share: float = 0.0,
        keep_within: bool = False,
        observation: PaperObservation | None = None,
        layouts: Layouts | None = None,
        actions: str = "joint",
        tightest_m: float | None = None,
        render_mode: str | None = None,
        render_modes: Sequence[str] = (),
        take_picture: Callable[[], Any] | None = None,
    ) -> None:
        self.metadata = {"render_modes": list(render_modes), "render_fps": control_hz / hold.usual_control_steps}
        if render_mode not in (None, *render_modes):
            raise ValueError(f"render_mode must be one of {', '.join(render_modes)}, or None, got {render_mode!r}")
        self.arm = arm
        self.target = target
        self.render_mode = render_mode
        self._reward = reward
        self._hold = hold
        self._control_hz = control_hz
        self._observation = observation or PaperObservation()
        self._layouts = layouts or Reach()
        self._actions = checks.one_of("actions", actions, ACTIONS)
        self._max_delta_rad = checks.number("max_delta_rad", max_delta_rad, low=0.0, high=math.pi, open_low=True)
        self.tolerance_m = self._tolerance_m = checks.number("tolerance_m", tolerance_m, low=0.0, high=0.1, open_low=True)
        self._tightest_m = None
        if tightest_m is not None:
            self._tightest_m = checks.number("tightest_m", tightest_m, low=0.0, high=tolerance_m, open_low=True)
        self._dwell_steps = dwell_steps(dwell_s, control_hz)
        self._step_limit = math.inf
        if time_limit_s is not None:
            self._step_limit = checks.number("time_limit_s", time_limit_s, low=1.0 / control_hz, high=_LONGEST_S) * control_hz
        self._object_height_m = object_height_m
        self._over_m = object_height_m / 2.0 + kinematics.CUP_RADIUS_M
        self._ghost_share = checks.number("ghost_share", ghost_share, low=0.0, high=1.0)
        self._solid, self._ghost = target, Ghost()
        self._keep_within = keep_within
        self._moments: list[Moment] = []
        self._take_picture = take_picture
        self._pictures: list[Any] = []
        self._trace: list[NDArray[np.float64]] = []
        self._begun = False
        self.observation_space = gymnasium.spaces.Box(-2.0 * math.pi, 2.0 * math.pi, (self._observation.size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE + hold.choices,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - set(_OPTIONS)):
            raise ValueError(f"reset has no option {unknown[0]!r}; it takes {', '.join(_OPTIONS[:-1])} and {_OPTIONS[-1]}")
        homes = options.get("home", True) or (self._layouts.slots > 0 and "object_position" not in options)
        if homes:
            self.arm.home()
            self.target = self._ghost if self._is_ghost(options.get("ghost")) else self._solid
            self._tolerance_m = self._tolerance(options.get("tolerance_m"))
        self._stand(at_rest=homes or self.arm.at_rest)  # else the arm is still doing what it was told before
        self._observation.begin()
        self._object, self._in_reach = self._place(options.get("object_position"), options.get("obstacles")), True
        self._dwelt_steps = 0
        self._elapsed_steps = 0
        self._flag = False
        self._press_m = self._reference_press_m = self._contact_n = self._touch_n = 0.0
        self._begun = True
        self._trace = []
        if self.render_mode == "rgb_array_list":
            self._pictures = [self._picture()]
        return self._observe(), self._info(RewardTerms(0.0, 0.0, 0.0))

    def _stand(self, *, at_rest: bool) -> None:
        """Look where the arm is before a first decision."""
        self._joints = self.arm.read_joints()
        self._link_ends = kinematics.forward(self._joints)
        if at_rest:
            self._reference = self._before = self._joints
            self._passed, self._last_action = 1, np.zeros(ACTION_SIZE + self._hold.choices)

    def _is_ghost(self, wanted: bool | None) -> bool:
        if wanted is None:
            return self._ghost_share > 0.0 and bool(self.np_random.random() < self._ghost_share)
        return checks.boolean("ghost", wanted)

    def _tolerance(self, wanted: float | None) -> float:
        if wanted is None and self._tightest_m is not None:
            low, high = math.log(self._tightest_m), math.log(self.tolerance_m)
            return math.exp(self.np_random.uniform(low, high))
        return self.tolerance_m if wanted is None else checks.number("tolerance_m", wanted, low=0.0, high=0.1, open_low=True)

    def _place(self, object_m: Any, in_the_way: Any) -> tuple[float, float, float]:
        if object_m is None:
            layout = self._layouts.draw(self.np_random, self._object_height_m, self._link_ends[3])
        else:
            told = in_order(obstacles.boxes("obstacles", in_the_way))
            layout = Layout(positions.within_reach("object_position", object_m), told)
        if layout.start_rad is not None:
            self.arm.stand_at(layout.start_rad.tolist())
            self._stand(at_rest=True)
        if self._layouts.slots:
            self.arm.place_obstacles(layout.obstacles)
        elif layout.obstacles:
            raise ValueError("this task has no obstacles; task=obstacles has some")
        self._in_the_way, self._margin_m, self._touched = layout.obstacles, layout.margin_m, False
        self.target.place_object(layout.object_m)
        x, y, z = layout.object_m.tolist()
        return x, y, z

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        if not self._begun:
            raise gymnasium.error.ResetNeeded("step needs a reset before it, in a copy too")
        start_joints, start_cup, start_object = self._joints, self._link_ends[3].tolist(), self._object
        clipped = self._command(action)
        hold = self._hold.chosen(self._last_action[ACTION_SIZE:].tolist())
        self._trace, self._moments, control_steps = [], [], 0
        self._press_m = self._contact_n = 0.0
        lost = timed_out = released = exploded = False
        while not (self._flag or self._touched or lost or timed_out or released):
            earlier, last = self._before, self._joints
            try:
                passed = self.arm.advance()
            except PhysicsError:
                exploded = True
                break
            self._before, self._passed = last, passed
            lost = not self._sense(passed)
            control_steps += passed
            self._trace.append(self.state())
            self._touch_n = self.arm.touch_n() if self._in_the_way else 0.0
            self._touched = self._touch_n > 0.0 or self._comes_near()
            timed_out = self._elapsed_steps >= self._step_limit
            travel_rad = 0.0 if self.arm.at_rest else travel_rad_of(last, self._joints)  # encoders flicker at rest
            change_rad = 0.0 if self.arm.at_rest else change_rad_of(earlier, last, self._joints)
            released = hold.releases(control_steps, travel_rad, change_rad)
            if self._keep_within:
                self._moments.append(self._moment(travel_rad, change_rad, control_steps))
            if self.render_mode == "rgb_array_list":
                self._pictures.append(self._picture())
        if self._touched:
            terms = RewardTerms(0.0, 0.0, 0.0, touching=self._layouts.touching)
        else:
            terms = self._reward(start_cup, start_object, self._link_ends[3].tolist(), self._object, self._press_m)
        info = self._info(
            terms,
            control_steps=control_steps,
            clipped=clipped,
            travel_rad=travel_rad_of(start_joints, self._joints),
            object_moved_m=math.dist(start_object, self._object),
            object_lost=lost,
            exploded=exploded,
        )
        if self._keep_within:
            info["within"] = [] if exploded else self._within(self._flag or lost or timed_out)
        terminated = self._flag or self._touched
        return self._observe(), terms.total, terminated, (lost or timed_out or exploded) and not terminated, info

    def _moment(self, travel_rad: float, change_rad: float, control_steps: int) -> Moment:
        cup = self._link_ends[3].tolist()
        seen = self._observe(), self._joints, cup, self._object, self._depth_m(cup)
        return Moment(*seen, travel_rad, change_rad, control_steps)

    def _within(self, ended: bool) -> list[Within]:
        def action_from(joints: JointPositions) -> NDArray[np.float64]:
            return np.subtract(self._reference, joints) / self._max_delta_rad

        return decisions_within(self._moments, action_from, self._hold, self._reward, ended=ended)

    def _info(
        self,
        terms: RewardTerms,
        *,
        control_steps: int = 0,
        clipped: bool = False,
        travel_rad: float = 0.0,
        object_moved_m: float = 0.0,
        object_lost: bool = False,
        exploded: bool = False,
    ) -> dict[str, Any]:
        """What vector environments can batch: the same keys, shapes and types every time."""
        return {
            "is_success": self._flag and not self._touched,
            "distance_m": self._distance_m(),
            "object_position": np.array(self._object),
            "control_steps": control_steps,
            "clipped": clipped,
            "travel_rad": travel_rad,
            "reward_distance": terms.distance,
            "reward_progress": terms.progress,
            "reward_displacement": terms.displacement,
            "reward_touching": terms.touching,
            "object_moved_m": object_moved_m,
            "object_lost": object_lost,
            "exploded": exploded,
            "ghost": self.target is self._ghost,
            "press_m": self._press_m,
            "reference_press_m": self._reference_press_m,
            "contact_n": self._contact_n,
            "touched": self._touched,
            "obstacle_contact_n": self._touch_n,
        }

    @property
    def trace(self) -> NDArray[np.float64]:
        """The last decision, shape (looks, 9), with the columns ``columns.STATE``.

        A look a control step, fewer on an arm that takes several steps to come to rest; none after ``reset``.
        """
        return np.array(self._trace).reshape(-1, len(columns.STATE))

    def _command(self, action: NDArray[np.float32]) -> bool:
        """Command the joints; true if the reference had to be cut at a limit, or the torque pushes against one."""
        given = np.asarray(action, np.float64)
        if given.shape != self.action_space.shape or not np.all(np.abs(given) <= 1.0):  # NaN compares false
            size = ACTION_SIZE + self._hold.choices
            raise ValueError(f"an action is {size} finite numbers in [-1, 1], got {action!r}")
        wanted = self._wanted(given[:ACTION_SIZE])
        reference = kinematics.clip_to_limits(*wanted)
        self._last_action, self._reference = given, reference
        self._reference_press_m = self._depth_m(kinematics.forward(reference)[3].tolist())
        if self._actions == "torque":
            self.arm.command_torques(given[:ACTION_SIZE].tolist())
        else:
            self.arm.command_joints(reference)
        return reference != wanted

    def _wanted(self, action: NDArray[np.float64]) -> JointPositions:
        """The reference that an action of the joints asks for, before it is cut."""
        if self._actions == "absolute":
            low, high = kinematics.JOINT_LIMITS_RAD.T
            one, two, three = ((low + high) / 2.0 + (high - low) / 2.0 * action).tolist()
            return one, two, three
        scale_rad = _A_LITTLE_RAD if self._actions == "torque" else self._max_delta_rad
        d1, d2, d3 = (scale_rad * action).tolist()
        j1, j2, j3 = self._reference if self._actions == "reference" else self._joints
        return j1 + d1, j2 + d2, j3 + d3

    def _sense(self, passed: int) -> bool:
        """Read arm and object after ``passed`` control steps; false if the object is out of reach."""
        self._joints = self.arm.read_joints()
        if not all(map(math.isfinite, self._joints)):
            raise ArmError(f"the arm reports joints that are no numbers: {self._joints}")
        self._link_ends = kinematics.forward(self._joints)
        position = self.target.object_position()
        if position is not None and position != self._object:  # one at rest is as reachable as it was
            self._object, self._in_reach = position, kinematics.reachable(position)
        self._elapsed_steps += passed
        cup = self._link_ends[3].tolist()
        self._press_m = max(self._press_m, self._depth_m(cup))
        self._contact_n = max(self._contact_n, self.arm.contact_n())
        # An arm that was seen only before and after several steps was near enough at the end of them, perhaps not before.
        stayed = passed if self._dwelt_steps else 1
        self._dwelt_steps = self._dwelt_steps + stayed if math.dist(cup, self._object) <= self._tolerance_m else 0
        self._flag = self._dwelt_steps >= self._dwell_steps
        return position is not None and self._in_reach

    def state(self) -> NDArray[np.float64]:
        """Joints, cup and object as they are now: a row of the trace, shape (9,)."""
        return np.array((*self._joints, *self._link_ends[3].tolist(), *self._object))

    def _depth_m(self, cup_m: Sequence[float]) -> float:
        """How far a cup there is below the object's upper surface, if any of its lip is over it."""
        (x, y, z), (at_x, at_y, top_m) = cup_m, self._object
        return max(0.0, top_m - z) if max(abs(x - at_x), abs(y - at_y)) <= self._over_m else 0.0

    def _comes_near(self) -> bool:
        """Whether an obstacle is nearer to the capsules around the arm than the margin, if there is one."""
        margin_m = self._margin_m
        return margin_m is not None and bool(obstacles.clearances_m(np.array([self._joints]), self._in_the_way)[0] < margin_m)

    def _distance_m(self) -> float:
        return math.dist(self._link_ends[3].tolist(), self._object)

    def _observe(self) -> Observation:
        per_s = self._control_hz / self._passed
        velocity = [per_s * (now - before) for now, before in zip(self._joints, self._before, strict=True)]
        look = Look(
            self._joints,
            self._link_ends,
            self._object,
            self._flag,
            velocity,
            self._reference,
            self._last_action.tolist(),
            self._in_the_way,
        )
        return self._observation.see(look)

    def _picture(self) -> Any:
        if self._take_picture is None:
            raise ValueError("this arm has no camera to render with")
        return self._take_picture()

    def render(self) -> Any:
        """A picture (``rgb_array``), or the pictures of every control step since the last call (``rgb_array_list``)."""
        if self.render_mode == "rgb_array":
            return self._picture()
        if self.render_mode == "rgb_array_list":
            pictures, self._pictures = self._pictures, []
            return pictures
        return None  # "human": the engine's own window shows the world

    def close(self) -> None:
        self.arm.close()

    def __getstate__(self) -> dict[str, Any]:
        """A copy's world is built anew, so its episode has not begun."""
        return self.__dict__ | {"_begun": False, "_pictures": [], "_trace": []}


def dwell_steps(dwell_s: float, control_hz: int) -> int:
    """So many looks in a row, a control step apart, have to find the cup near enough."""
    steps = math.ceil(checks.number("dwell_s", dwell_s, low=0.0, high=_LONGEST_S) * control_hz - 1e-9)
    return max(1, steps)  # a dwell of nothing: arriving is enough
