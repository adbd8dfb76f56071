"""Search for ways to be paid success without carrying the object.

    python benchmarks/cheat_hunt.py [--scene=kitchen_2x2] [--trials=1536] [--picture=hunt.png]

For every pair of an object and a receptacle, a hand pushes, presses and drops. The cross-entropy method
searches over where object and hand begin, two legs and a retreat of the hand, its turn and its fingers. The table
counts, for each pair, the trials that

- were paid success though the object was never carried: at no instant was its whole surface more than 1 mm off the
  table and off all receptacles with the hand touching it;
- were paid success for an object that does not stay once the hand is gone (objects are dropped at the rim, too);
- were paid the grasp reward though the object was never carried, as by a fist that is pressed onto it;
- had the object LIE on the receptacle without being carried: toppled, rolled or pushed up. This is allowed.
"""

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot_env_cronos import CronosVectorEnv, Task, get_scene
from lerobot_env_cronos.expert.body_boxes import SceneBoxes, WorldBoxes
from lerobot_env_cronos.expert.hands import point_down
from lerobot_env_cronos.scene.arms.so101 import geometry as so101
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM, from_joints, to_joints
from lerobot_env_cronos.scene.arms.so101.kinematics import gravity_torque
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from lerobot_env_cronos.scene.arms.widowx.geometry import FINGER_CLOSED, FINGER_OPEN, FINGERTIP_REACH, HOME_QPOS
from lerobot_env_cronos.scene.arms.widowx.kinematics import forward_kinematics, inverse_kinematics
from lerobot_env_cronos.scene.model import TABLE, hand_sensor, support_sensor
from lerobot_env_cronos.scene.rotations import matrix_to_rotation_vector, quaternion_to_matrix
from lerobot_env_cronos.scene.scenes import BODIES, Scene
from lerobot_env_cronos.simulation.simulation import Simulation
from PIL import Image

KINDS = ("push", "press", "drop")
"""How a trial begins: the hand beside the object, or above it; the object let fall at the receptacle's rim."""
LEG_S, RETREAT_S = 1.6, 1.2
"""Two straight legs of the hand, and a retreat [s]."""
ALONE_S = 0.6
"""Time that what was paid has to stay once the hand is gone [s]: light things tremble when they are woken."""
POPULATION, ELITE_SHARE = 128, 1 / 8
"""Trials of a generation, and the share of them that the next one is drawn from."""
MIN_SPREAD = 0.08
"""Standard deviation that the search keeps in every number of a trial."""
NUM_PARAMETERS = 22
CLEAR, POINT_SPACING = 0.001, 0.01
"""Gap that separates an object from what does not carry it, and between points of its surface [m]."""
QUARTER_TURN = np.sqrt(0.5)
GRAVITY = 9.81


@dataclass
class Trials:
    """What happened in n trials of one pair, arrays (n, ...)."""

    n: int
    nq: int
    num_steps: int
    paid: np.ndarray = field(init=False)
    """bool: judged a success before the object was ever carried."""
    grasped: np.ndarray = field(init=False)
    """bool: judged grasped though the object was never carried."""
    lay: np.ndarray = field(init=False)
    """bool: the receptacle alone bore the object at two steps in a row, though it had never been carried."""
    unsteady: np.ndarray = field(init=False)
    """bool: judged a success, but without the hand the object did not stay."""
    first_paid: np.ndarray = field(init=False)
    """Control step of the first success, carried or not; `num_steps` if there was none."""
    score: np.ndarray = field(init=False)
    """2 if it was paid without carrying, plus how close it came to that."""
    positions: np.ndarray = field(init=False)
    """(n, nq), MuJoCo's, at the moment of the best score."""

    def __post_init__(self) -> None:
        self.paid, self.grasped, self.lay, self.unsteady = np.zeros((4, self.n), dtype=bool)
        self.first_paid, self.score = np.full(self.n, self.num_steps), np.full(self.n, -np.inf)
        self.positions = np.zeros((self.n, self.nq))


class WatchedSimulation(Simulation):
    """A simulation that notices when an object is carried, at every chunk of physics and from where things are.

    The environment's rule looks at forces and at the ends of control steps instead.
    """

    def __init__(self, scene: Scene, num_sims: int):
        super().__init__(scene, num_sims)
        self.hands = HANDS[scene.arm]
        self.leg_steps = round(LEG_S * scene.fps)
        self.trial_steps = 2 * self.leg_steps + round(RETREAT_S * scene.fps)
        self._boxes = SceneBoxes.from_model(self.model, scene)
        self._points = {o: self._boxes.surface(i, POINT_SPACING) for i, o in enumerate(scene.objects)}
        self._receptacle_boxes = np.flatnonzero(self._boxes.body >= len(scene.objects))
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


class Search:
    """The cross-entropy method on one kind of trial of one pair."""

    def __init__(self, rng: np.random.Generator):
        self._rng = rng
        self._near: tuple[np.ndarray, np.ndarray] | None = None

    def draw(self, n: int) -> np.ndarray:
        """The trials (n, NUM_PARAMETERS) in [0, 1] of the next generation; half of them anywhere."""
        x = self._rng.random((n, NUM_PARAMETERS))
        if self._near is not None:
            near = self._rng.normal(*self._near, x.shape)
            near[:, 0] %= 1.0  # an angle
            x[n // 2 :] = np.clip(near, 0.0, 1.0)[n // 2 :]
        return x

    def learn(self, x: np.ndarray, score: np.ndarray) -> None:
        """Draw the next generation near the best of this one."""
        elite = x[np.argsort(-score, kind="stable")[: max(2, round(ELITE_SHARE * len(x)))]]
        self._near = elite.mean(0), np.maximum(elite.std(0), MIN_SPREAD)


# Trials --------------------------------------------------------------------------------------------------


def run_trials(sim: WatchedSimulation, task: Task, kind: str, x: np.ndarray) -> Trials:
    """Run the trials `x` (n, NUM_PARAMETERS) of one of `KINDS` for a task, one in each simulation."""
    trials = _run(sim, task, kind, x, np.full(len(x), sim.trial_steps))
    paid = np.flatnonzero(trials.first_paid < sim.trial_steps)
    if len(paid):
        # The same once more, up to the payment; then the hand is gone, and the object is left alone.
        _run(sim, task, kind, x, np.where(trials.first_paid < sim.trial_steps, trials.first_paid + 1, 0))
        sim.send_arm_home(paid)
        for _ in range(round(ALONE_S * sim.scene.fps)):
            sim.step(np.tile(sim.hands.still, (len(paid), 1)), paid)
        trials.unsteady[paid] = ~sim.is_on(task.object, task.receptacle)[paid]
    return trials


def _run(sim: WatchedSimulation, task: Task, kind: str, x: np.ndarray, num_steps: np.ndarray) -> Trials:
    """Run every trial for `num_steps` (n,) control steps."""
    legs, grippers = _begin(sim, task, kind, x)
    trials = Trials(len(x), sim.model.nq, sim.trial_steps)
    for step in range(int(num_steps.max())):
        ids = np.flatnonzero(num_steps > step)
        leg = min(step // sim.leg_steps, 2)
        sim.step(sim.hands.act(sim, legs[leg], grippers[leg])[ids], ids)
        _count(sim, task, kind, trials, step)
    return trials


def _count(sim: WatchedSimulation, task: Task, kind: str, trials: Trials, step: int) -> None:
    """Judge the state after a step. What was dropped counts as carried: it shall only stay where it is paid."""
    i, place = sim.scene.objects.index(task.object), sim.scene.receptacles.index(task.receptacle) + 1
    paid, alone = sim.is_on(task.object, task.receptacle), ~sim.was_carried & (kind != "drop")
    trials.paid |= paid & alone
    trials.grasped |= sim.is_grasped(task.object) & alone
    trials.lay |= alone & (sim.judge.confirmed[:, i] == place)
    trials.first_paid[paid & (trials.first_paid == sim.trial_steps)] = step
    weight = sim.model.body(task.object).mass[0] * GRAVITY
    borne = sim.force(support_sensor(task.object, task.receptacle))[:, 2] / weight
    table = np.linalg.norm(sim.force(support_sensor(task.object, TABLE)), axis=1) / weight
    score = np.clip(borne, 0, 1) - np.clip(table, 0, 1) * (-1.0 if kind == "drop" else 1.0)
    score -= 0.5 * (sim.force(hand_sensor(task.object))[:, 0] > 0) + sim.was_carried
    score += 2.0 * trials.paid
    better = score > trials.score
    trials.score[better], trials.positions[better] = score[better], sim.qpos[better]


def _begin(sim: WatchedSimulation, task: Task, kind: str, x: np.ndarray) -> tuple[list, list]:
    """Set up the trials; returns 3 targets of the hand (n, 4), x, y, z and yaw, and whether it is open (n,)."""
    sim.watched = task.object
    angle = 2 * np.pi * x[:, 0]
    away = np.stack([np.cos(angle), np.sin(angle)], 1)
    obj = _place(sim, task, kind, x, sim.hands.centre - 0.07 * away, away)
    # The hand's frame: towards the receptacle, across, up; from the object's middle.
    across = np.stack([away[:, 1], -away[:, 0]], 1)
    half = np.array(BODIES[task.object].size) / 2
    long, tall = half[:2].max(), 2 * max(half[0], half[2])

    def point(along: np.ndarray, aside: np.ndarray, z: np.ndarray) -> np.ndarray:
        xy = obj - away * along[:, None] + across * aside[:, None]
        tips = np.stack([xy[:, 0], xy[:, 1], z + sim.hands.tip_reach], 1)
        low, high = sim.arm.low + np.array([0.02, 0.02, 0.002]), sim.arm.high - np.array([0.02, 0.02, 0.0])
        return np.clip(tips, low, high)

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
    turned, opened = yaw + (2 * x[:, 19] - 1) * 0.8, x[:, 20] > 0.5
    sim.hands.move(sim, start[kind], yaw, opened)
    sim.was_carried[:] = False
    targets = [np.column_stack([p, w]) for p, w in ((first, yaw), (second, turned), (leave, turned))]
    return targets, [opened, np.where(x[:, 21] < 0.2, ~opened, opened), np.ones(len(x), dtype=bool)]


def _place(
    sim: WatchedSimulation, task: Task, kind: str, x: np.ndarray, receptacle: np.ndarray, away: np.ndarray
) -> np.ndarray:
    """Put the pair side by side and all other bodies far away; returns the object's place (n, 2)."""
    n, bodies, everyone = len(x), sim.scene.bodies, np.arange(len(x))
    poses = np.zeros((n, len(bodies), 7))
    poses[..., 3] = 1.0
    for i, name in enumerate(bodies):
        poses[:, i, :3] = [sim.hands.aside, 0.16 * i - 0.40, BODIES[name].size[2] / 2]
    size, base = np.array(BODIES[task.object].size), np.array(BODIES[task.receptacle].size)
    o, r = bodies.index(task.object), bodies.index(task.receptacle)
    poses[:, r, :2] = receptacle
    yaw, turn = np.pi * x[:, 1], np.where(x[:, 2] < 0.5, 0.0, np.pi / 2) + 0.6 * (x[:, 3] - 0.5)
    # Rolled about its long axis, y, by 90 degrees, then turned by `yaw`.
    rolled = x[:, 4] < 0.25
    upright, quarter = np.where(rolled, QUARTER_TURN, 1.0), np.where(rolled, QUARTER_TURN, 0.0)
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    poses[:, o, 3:] = np.stack([c * upright, -s * quarter, c * quarter, s * upright], 1)
    poses[:, r, 3], poses[:, r, 6] = np.cos(turn / 2), np.sin(turn / 2)
    width, height = np.where(rolled, size[2], size[0]), np.where(rolled, size[0], size[2])
    reach = _half_extent(away, yaw, width, size[1]) + _half_extent(away, turn, base[0], base[1])
    gap, lift = reach + 0.02 * x[:, 5] ** 2 + 0.0005, np.zeros(n)
    if kind == "drop":
        gap, lift = reach * (0.5 + 0.6 * x[:, 5]), base[2] + 0.001 + 0.05 * x[:, 9] ** 2
    obj = receptacle + away * gap[:, None]
    poses[:, o, :2], poses[:, o, 2] = obj, height / 2 + lift
    sim.place(everyone, poses)
    if kind != "drop":
        sim.send_arm_home(everyone)
    return obj


def _half_extent(direction: np.ndarray, yaw: np.ndarray, width: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Half extent (n,) of a box of `width` x `length`, turned by `yaw` (n,), along a direction (n, 2) [m]."""
    along = np.abs(direction[:, 0] * np.cos(yaw) + direction[:, 1] * np.sin(yaw))
    across = np.abs(direction[:, 1] * np.cos(yaw) - direction[:, 0] * np.sin(yaw))
    return (along * width + across * length) / 2


# Hands ---------------------------------------------------------------------------------------------------


class WidowXHands:
    """How a trial moves the WidowX: by bounded steps towards a pose."""

    centre, aside = np.array([0.31, 0.0]), -0.12
    """Where a pair is, and the x of what is far away [m]."""
    tip_reach = FINGERTIP_REACH
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    """The action that does nothing."""

    def move(self, sim: Simulation, position: np.ndarray, yaw: np.ndarray, opened: np.ndarray) -> None:
        """Teleport the hands to `position` (n, 3), turned by `yaw` (n,), their fingers `opened` (n,) or closed."""
        q = np.tile(HOME_QPOS, (len(yaw), 1))
        start, _, _ = forward_kinematics(q)
        for way in np.linspace(0.1, 1.0, 10):
            q = inverse_kinematics(q, start + way * (position - start), self._orientation(yaw))
        sim.gripper_target[:] = np.where(opened, FINGER_OPEN, FINGER_CLOSED)
        sim.qpos[:, 6], sim.qpos[:, 7] = sim.gripper_target, -sim.gripper_target
        sim.move_arm(np.arange(len(yaw)), q)

    def act(self, sim: Simulation, target: np.ndarray, opened: np.ndarray) -> np.ndarray:
        """One control step (n, 7) towards `target` (n, 4), place and turn, with `opened` fingers (n,)."""
        p, R, _ = forward_kinematics(sim.arm_target)
        turn = matrix_to_rotation_vector(self._orientation(target[:, 3]) @ R.transpose(0, 2, 1))
        action = np.concatenate([target[:, :3] - p, np.clip(turn, -0.08, 0.08), opened[:, None]], 1)
        return np.clip(action, WIDOWX.action_low, WIDOWX.action_high)

    def _orientation(self, yaw: np.ndarray) -> np.ndarray:
        """A hand that points down, its fingers closing along `yaw` (n,), either one first: (n, 3, 3)."""
        yaw, zero = np.mod(yaw, np.pi), np.zeros_like(yaw)
        down, closing = np.stack([zero, zero, zero - 1], 1), np.stack([np.cos(yaw), np.sin(yaw), zero], 1)
        return np.stack([down, closing, np.cross(down, closing)], 2)


class SO101Hands:
    """How a trial moves the SO-101: every other one at once, as fast as it goes, the others in small steps."""

    centre, aside = np.array([0.20, 0.0]), 0.50
    tip_reach = so101.FINGERTIP_REACH
    still = from_joints(SO101_ARM.home_qpos[None])[0]
    step_rad, opening = 0.04, 55.0

    def move(self, sim: Simulation, position: np.ndarray, yaw: np.ndarray, opened: np.ndarray) -> None:
        """See `WidowXHands`."""
        gripper = to_joints(np.where(opened, self.opening, 0.0)[:, None].repeat(6, 1))[:, 5]
        sim.gripper_target[:], sim.qpos[:, 5] = gripper, gripper
        sim.move_arm(np.arange(len(yaw)), self._joints(position, yaw))

    def act(self, sim: Simulation, target: np.ndarray, opened: np.ndarray) -> np.ndarray:
        """One control step (n, 6); see `WidowXHands`."""
        goal = self._joints(target[:, :3], target[:, 3])
        goal = goal + gravity_torque(goal) / so101.SERVO_KP
        slow = sim.arm_target + np.clip(goal - sim.arm_target, -self.step_rad, self.step_rad)
        goal[::2] = slow[::2]
        action = from_joints(np.concatenate([goal, np.zeros((len(goal), 1))], 1))
        action[:, 5] = np.where(opened, self.opening, 0.0)
        return np.clip(action, SO101_ARM.action_low, SO101_ARM.action_high)

    def _joints(self, position: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        # Either jaw first, the wrist far from its limits.
        azimuth = np.arctan2(position[:, 1], position[:, 0])
        roll = np.mod(yaw - azimuth + np.pi / 2, np.pi) - np.pi / 2
        return point_down(position, azimuth + roll)[0]


HANDS = {WIDOWX.name: WidowXHands(), SO101_ARM.name: SO101Hands()}


# The hunt ------------------------------------------------------------------------------------------------


def hunt(scene: str, num_trials: int, seed: int = 0, population: int = POPULATION) -> np.ndarray:
    """Search every pair of a scene with about `num_trials` trials, print a table; returns the best (nq,) moment.

    Args:
        scene: name of the scene.
        num_trials: of each pair; rounded up to whole generations for each kind.
        seed: of everything that is drawn.
        population: trials of a generation.
    """
    sim, rng = WatchedSimulation(get_scene(scene), population), np.random.default_rng(seed)
    generations = -(-num_trials // (population * len(KINDS)))
    best, best_score = sim.qpos[0].copy(), -np.inf
    columns = ("trials", "paid, not carried", "paid, not staying", "grasp, not carried", "lay, not carried")
    print(f"{'pair':<45}" + "".join(f"{name:>20}" for name in columns))
    for task in sim.scene.tasks:
        counts = np.zeros(len(columns), dtype=int)
        for kind in KINDS:
            search = Search(rng)
            for _ in range(generations):
                x = search.draw(population)
                trials = run_trials(sim, task, kind, x)
                search.learn(x, trials.score)
                found = (trials.paid, trials.unsteady, trials.grasped, trials.lay)
                counts += [population, *(int(one.sum()) for one in found)]
                top = int(trials.score.argmax())
                if kind != "drop" and trials.score[top] > best_score:
                    best, best_score = trials.positions[top].copy(), trials.score[top]
        print(f"{task.instruction:<45}" + "".join(f"{count:>20}" for count in counts), flush=True)
    return best


def main() -> None:
    """Hunt, print the table, draw the trial that came closest to a cheat."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="kitchen_2x2")
    parser.add_argument("--trials", type=int, default=1536, help="of each pair; default: 1536")
    parser.add_argument("--population", type=int, default=POPULATION, help="trials of a generation; default: 128")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, help="PNG of the trial that came closest to a cheat")
    args = parser.parse_args()
    best = hunt(args.scene, args.trials, args.seed, args.population)
    if args.picture is not None:
        env = CronosVectorEnv(1, args.scene, obs_type="environment_state_agent_pos")
        Image.fromarray(env.render_positions(best[None])[0]).save(args.picture)


if __name__ == "__main__":
    main()
