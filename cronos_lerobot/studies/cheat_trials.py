"""The trials of the cheat hunt: a hand that pushes, presses or drops, written as numbers between 0 and 1.

Version 0's test of success is kept here, to say what the same trials were paid then.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from lerobot_env_cronos.expert.body_boxes import SceneBoxes, WorldBoxes
from lerobot_env_cronos.scene.model import TABLE, hand_sensor, support_sensor
from lerobot_env_cronos.scene.robot import EE_HIGH, EE_LOW, FINGER_CLOSED, FINGER_OPEN, FINGERTIP_REACH, HOME_QPOS
from lerobot_env_cronos.scene.scenes import BODIES, Scene
from lerobot_env_cronos.simulation.kinematics import (
    forward_kinematics,
    inverse_kinematics,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
)
from lerobot_env_cronos.simulation.simulation import ACTION_HIGH, ACTION_LOW, NUM_ARM_JOINTS, Simulation

RULES = ("v0", "v1")
KINDS = ("push", "press", "drop")
"""How a trial begins: the hand beside the object, or above it; the object let fall at the receptacle's rim."""

LEG_STEPS, RETREAT_STEPS = 8, 6
NUM_STEPS = 2 * LEG_STEPS + RETREAT_STEPS
"""Two straight legs of the hand, and a retreat [control steps]."""

CENTRE = np.array([0.31, 0.0])
CLEAR = 0.001
"""Gap that separates an object from what does not carry it [m]."""
POINT_SPACING = 0.01
QUARTER_TURN = np.sqrt(0.5)
STANDARD_GRAVITY = 9.81

NUM_PARAMETERS = 22


class Pair(NamedTuple):
    """An object and the receptacle that it belongs on."""

    object: str
    receptacle: str


@dataclass
class Trials:
    """What happened in n trials of one pair."""

    paid: dict[str, np.ndarray]
    """(n,) number of control steps that a rule judged a success before the object was ever carried, by rule."""
    lay: np.ndarray
    """(n,) bool: the receptacle alone bore the object at two steps in a row, though it had never been carried."""
    unsteady: np.ndarray
    """(n,) bool: paid by version 1's rule, but without the hand the object did not stay."""
    first_paid: np.ndarray
    """(n,) control step at which version 1's rule paid, carried or not; NUM_STEPS if it never did."""
    score: dict[str, np.ndarray]
    """(n,) how often a trial was paid by a rule without carrying, or else how close it came to that."""
    positions: dict[str, np.ndarray]
    """(n, nq), MuJoCo's, at the moment of the best score."""

    @classmethod
    def none_of(cls, n: int, nq: int) -> "Trials":
        """Of n trials that have not begun."""
        no = np.zeros(n, dtype=bool)
        return cls(
            {rule: np.zeros(n, dtype=int) for rule in RULES}, no, no.copy(), np.full(n, NUM_STEPS),
            {rule: np.full(n, -np.inf) for rule in RULES}, {rule: np.zeros((n, nq)) for rule in RULES},
        )  # fmt: skip


class WatchedSimulation(Simulation):
    """A simulation that notices when an object is carried, at every chunk of physics and from where things are.

    Carried means: every point of its surface is more than 1 mm off the table and off every receptacle, while the
    hand touches it. Version 1's rule looks at forces and at the ends of control steps instead.
    """

    def __init__(self, scene: Scene, num_sims: int, num_threads: int = 0):
        super().__init__(scene, num_sims, num_threads)
        boxes = SceneBoxes.from_model(self.model, scene)
        self._boxes = boxes
        self._points = {o: boxes.surface(i, POINT_SPACING) for i, o in enumerate(scene.objects)}
        self._receptacle_boxes = np.flatnonzero(boxes.body >= len(scene.objects))
        self.watched = scene.objects[0]
        self.was_carried = np.zeros(num_sims, dtype=bool)

    def _advance(self, ids: np.ndarray, nstep: int) -> np.ndarray:
        broken = super()._advance(ids, nstep)
        touched = ids[self.force(hand_sensor(self.watched))[ids, 0] > 0]
        self.was_carried[touched] |= self.gap(self.watched, touched) > CLEAR
        return broken

    def gap(self, obj: str, ids: np.ndarray) -> np.ndarray:
        """Distance (k,) of an object's surface from the table and all receptacles [m]."""
        if not len(ids):
            return np.zeros(0)
        pose = self.body_pose(obj)[ids]
        points = pose[:, None, :3] + self._points[obj] @ quaternion_to_matrix(pose[:, 3:]).transpose(0, 2, 1)
        gap = points[..., 2].min(1)
        # Only what is off the table is worth the distances.
        high = gap > CLEAR
        world = WorldBoxes.at(self._boxes, self.body_poses()[ids[high]])
        receptacles = world.distance(points[high], self._receptacle_boxes).min((1, 2))
        gap[high] = np.minimum(gap[high], receptacles)
        return gap


def is_on_v0(sim: Simulation, pair: Pair) -> np.ndarray:
    """Version 0's success (n,): centres near in the plane, one above the other, any contact."""
    offset = sim.body_pose(pair.object)[:, :3] - sim.body_pose(pair.receptacle)[:, :3]
    obj, receptacle = BODIES[pair.object].size, BODIES[pair.receptacle].size
    gap = offset[:, 2] - (obj[2] + receptacle[2]) / 2
    near = np.linalg.norm(offset[:, :2], axis=1) <= max(receptacle[:2]) / 2 + 0.01
    force = np.linalg.norm(sim.force(support_sensor(pair.object, pair.receptacle)), axis=1)
    return near & (offset[:, 2] > 0) & (gap <= 0.05) & (force > 0.03)


def run_trials(sim: WatchedSimulation, pair: Pair, kind: str, x: np.ndarray) -> Trials:
    """Run the trials `x` (n, NUM_PARAMETERS) in [0, 1] of one of `KINDS` for a pair, one in each simulation."""
    trials = _run(sim, pair, kind, x, np.full(len(x), NUM_STEPS))
    paid = np.flatnonzero(trials.first_paid < NUM_STEPS)
    if len(paid):
        # The same once more, up to the payment; then the hand is gone, and the object is left alone.
        _run(sim, pair, kind, x, np.where(trials.first_paid < NUM_STEPS, trials.first_paid + 1, 0))
        sim.send_arm_home(paid)
        trials.unsteady[paid] = ~sim.is_on(pair.object, pair.receptacle)[paid]
    return trials


def _run(sim: WatchedSimulation, pair: Pair, kind: str, x: np.ndarray, num_steps: np.ndarray) -> Trials:
    """Run every trial for `num_steps` (n,) control steps."""
    legs, grippers = _begin(sim, pair, kind, x)
    trials = Trials.none_of(len(x), sim.model.nq)
    for step in range(int(num_steps.max())):
        ids = np.flatnonzero(num_steps > step)
        leg = min(step // LEG_STEPS, 2)
        sim.step(hand_action(sim, legs[leg], grippers[leg])[ids], ids)
        _count(sim, pair, kind, trials, step)
    return trials


def _count(sim: WatchedSimulation, pair: Pair, kind: str, trials: Trials, step: int) -> None:
    """Judge the state after a step. What was dropped counts as carried: it shall only stay where it is paid."""
    i, place = sim.scene.objects.index(pair.object), sim.scene.receptacles.index(pair.receptacle) + 1
    paid = {"v0": is_on_v0(sim, pair), "v1": sim.is_on(pair.object, pair.receptacle)}
    alone = ~sim.was_carried & (kind != "drop")
    trials.lay |= alone & (sim.judge.confirmed[:, i] == place)
    trials.first_paid[paid["v1"] & (trials.first_paid == NUM_STEPS)] = step
    weight = sim.model.body(pair.object).mass[0] * STANDARD_GRAVITY
    borne = sim.force(support_sensor(pair.object, pair.receptacle))[:, 2] / weight
    table = np.linalg.norm(sim.force(support_sensor(pair.object, TABLE)), axis=1) / weight
    closeness = np.clip(borne, 0, 1) - np.clip(table, 0, 1) * (-1.0 if kind == "drop" else 1.0)
    closeness -= 0.5 * (sim.force(hand_sensor(pair.object))[:, 0] > 0) + sim.was_carried
    for rule in RULES:
        trials.paid[rule] += paid[rule] & alone
        score = closeness + 2.0 * trials.paid[rule]
        better = score > trials.score[rule]
        trials.score[rule][better] = score[better]
        trials.positions[rule][better] = sim.qpos[better]


def _begin(
    sim: WatchedSimulation, pair: Pair, kind: str, x: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Set up the trials; returns 3 targets of the hand (n, 4), x, y, z and yaw, and whether it is open (n,)."""
    n = len(x)
    sim.watched = pair.object
    angle = 2 * np.pi * x[:, 0]
    away = np.stack([np.cos(angle), np.sin(angle)], 1)
    receptacle = CENTRE - 0.07 * away
    obj = _place(sim, pair, kind, x, receptacle, away)
    # The hand's frame: towards the receptacle, across, up; from the object's middle.
    across = np.stack([away[:, 1], -away[:, 0]], 1)
    half = np.array(BODIES[pair.object].size) / 2
    long, tall = half[:2].max(), 2 * max(half[0], half[2])

    def point(along: np.ndarray, aside: np.ndarray, z: np.ndarray) -> np.ndarray:
        xy = obj - away * along[:, None] + across * aside[:, None]
        tips = np.stack([xy[:, 0], xy[:, 1], z + FINGERTIP_REACH], 1)
        return np.clip(tips, EE_LOW + np.array([0.02, 0.02, 0.002]), EE_HIGH - np.array([0.02, 0.02, 0.0]))

    beside = -(half[:2].min() + 0.03 + 0.05 * x[:, 6])
    start = {
        "push": point(beside, (2 * x[:, 7] - 1) * long, tall * x[:, 8] ** 2),
        "press": point((2 * x[:, 6] - 1) * long, (2 * x[:, 7] - 1) * long, tall + 0.01 + 0.02 * x[:, 8]),
    }
    start["drop"] = np.where((x[:, 8] < 0.5)[:, None], start["press"] + [0, 0, 0.06], start["push"])
    first = point(-0.02 + 0.10 * x[:, 9], (2 * x[:, 10] - 1) * 0.05, 0.06 * x[:, 11] ** 2)
    second = point(0.15 * x[:, 12], (2 * x[:, 13] - 1) * 0.06, 0.08 * x[:, 14] ** 2)
    leave = second + np.stack([(0.16 * x[:, 15] - 0.08), (0.16 * x[:, 16] - 0.08), 0.02 + 0.08 * x[:, 17]], 1)
    yaw = angle + np.pi * x[:, 18]
    turned = yaw + (2 * x[:, 19] - 1) * 0.8
    opened = x[:, 20] > 0.5
    move_hand(sim, start[kind], yaw, opened)
    targets = [np.column_stack([p, w]) for p, w in ((first, yaw), (second, turned), (leave, turned))]
    sim.was_carried[:] = False
    return targets, [opened, np.where(x[:, 21] < 0.2, ~opened, opened), np.ones(n, dtype=bool)]


def _place(
    sim: WatchedSimulation, pair: Pair, kind: str, x: np.ndarray, receptacle: np.ndarray, away: np.ndarray
) -> np.ndarray:
    """Put the pair side by side and all other bodies far away; returns the object's place (n, 2)."""
    n, bodies = len(x), sim.scene.bodies
    poses = np.zeros((n, len(bodies), 7))
    poses[..., 3] = 1.0
    for i, name in enumerate(bodies):
        poses[:, i, :3] = [-0.12, 0.16 * i - 0.40, BODIES[name].size[2] / 2]
    size, base = np.array(BODIES[pair.object].size), np.array(BODIES[pair.receptacle].size)
    o, r = bodies.index(pair.object), bodies.index(pair.receptacle)
    poses[:, r, :2] = receptacle
    yaw, turn = np.pi * x[:, 1], np.where(x[:, 2] < 0.5, 0.0, np.pi / 2) + 0.6 * (x[:, 3] - 0.5)
    rolled = x[:, 4] < 0.25
    quarter = np.where(rolled, QUARTER_TURN, 0.0)
    # Rolled about its long axis, y, by 90 degrees, then turned by `yaw`.
    upright = np.where(rolled, QUARTER_TURN, 1.0)
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    poses[:, o, 3:] = np.stack([c * upright, -s * quarter, c * quarter, s * upright], 1)
    poses[:, r, 3], poses[:, r, 6] = np.cos(turn / 2), np.sin(turn / 2)
    width, height = np.where(rolled, size[2], size[0]), np.where(rolled, size[0], size[2])
    reach = _reach(away, yaw, width, size[1]) + _reach(away, turn, base[0], base[1])
    gap = reach + 0.02 * x[:, 5] ** 2 + 0.0005
    lift = np.zeros(n)
    if kind == "drop":
        gap, lift = reach * (0.5 + 0.6 * x[:, 5]), base[2] + 0.001 + 0.05 * x[:, 9] ** 2
    obj = receptacle + away * gap[:, None]
    poses[:, o, :2], poses[:, o, 2] = obj, height / 2 + lift
    everyone = np.arange(n)
    sim.place(everyone, poses)
    if kind != "drop":
        sim.send_arm_home(everyone)
    return obj


def _reach(direction: np.ndarray, yaw: np.ndarray, width: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Half extent (n,) of a box of `width` x `length`, turned by `yaw` (n,), along a direction (n, 2) [m]."""
    along = np.abs(direction[:, 0] * np.cos(yaw) + direction[:, 1] * np.sin(yaw))
    across = np.abs(direction[:, 1] * np.cos(yaw) - direction[:, 0] * np.sin(yaw))
    return (along * width + across * length) / 2


def _orientation(yaw: np.ndarray) -> np.ndarray:
    """A hand that points down, its fingers closing along `yaw` (n,): (n, 3, 3)."""
    zero = np.zeros_like(yaw)
    down = np.stack([zero, zero, zero - 1], 1)
    closing = np.stack([np.cos(yaw), np.sin(yaw), zero], 1)
    return np.stack([down, closing, np.cross(down, closing)], 2)


def move_hand(sim: Simulation, position: np.ndarray, yaw: np.ndarray, opened: np.ndarray) -> None:
    """Teleport the hands to `position` (n, 3), turned by `yaw` (n,), their fingers `opened` (n,) or closed."""
    q = np.tile(HOME_QPOS, (len(yaw), 1))
    start, _, _ = forward_kinematics(q)
    for way in np.linspace(0.1, 1.0, 10):
        q = inverse_kinematics(q, start + way * (position - start), _orientation(_nearest(yaw)))
    sim.gripper_target[:] = np.where(opened, FINGER_OPEN, FINGER_CLOSED)
    sim.qpos[:, NUM_ARM_JOINTS] = sim.gripper_target
    sim.qpos[:, NUM_ARM_JOINTS + 1] = -sim.gripper_target
    sim.move_arm(np.arange(len(yaw)), q)


def _nearest(yaw: np.ndarray) -> np.ndarray:
    """The same line of closing between 0 and pi: either finger may be first."""
    return np.mod(yaw, np.pi)


def hand_action(sim: Simulation, target: np.ndarray, opened: np.ndarray) -> np.ndarray:
    """One control step (n, 7) of the hands towards `target` (n, 4), place and turn, with `opened` fingers (n,)."""
    p, R, _ = forward_kinematics(sim.arm_target)
    turn = matrix_to_rotation_vector(_orientation(_nearest(target[:, 3])) @ R.transpose(0, 2, 1))
    turn = np.clip(turn, -0.08, 0.08)
    action = np.concatenate([target[:, :3] - p, turn, opened[:, None]], 1)
    return np.clip(action, ACTION_LOW, ACTION_HIGH)
