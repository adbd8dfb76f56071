"""A scripted expert: pick and place from the privileged state, for all streams at once.

It looks at the state at every step and derives what to do from it, so that it retries by itself after a miss, a
slip or a perturbed action. It remembers only which grasp and which free spot it chose, and which object it is
clearing away: one that lies on top of the object to move, or that takes up the last room on its receptacle, is put
on the table first.
"""

import numpy as np

from lerobot_env_cronos.expert.body_boxes import SceneBoxes, WorldBoxes
from lerobot_env_cronos.expert.grasping import choose_grasps, find_blocker, grasp_candidates
from lerobot_env_cronos.expert.hands import CLOSE, HANDS, OPEN, Command, horizontal
from lerobot_env_cronos.expert.placement import Held, choose_places
from lerobot_env_cronos.scene.rotations import quaternion_to_matrix
from lerobot_env_cronos.simulation.judging import IN_HAND
from lerobot_env_cronos.vector_env import CronosVectorEnv

FUNNEL_SLOPE = 1.5
"""Height above the goal per metre of remaining horizontal error."""
ALIGNED = 0.008
"""Horizontal error at which the hand is down at the goal [m]."""
YAW_TO_METRES = 0.04
"""A yaw error of 1 rad counts like this horizontal error [m]."""
GRASP_REACHED = 0.008
"""The fingers close when the hand is this close above the grasp [m]."""
DROP_HEIGHT = 0.003
"""Gap under the object when the hand lets go; more than 12 mm topples objects [m]."""
LET_GO_S = 0.8
"""Time for which the hand goes up from what it has put down, until that counts as lying still [s]."""
NUM_FAILED, MAX_VAIN_S = 3, 1.0
"""Failed grasps that are remembered, and time at a grasp after which it has failed [s]."""
MAX_CLEARED, MAX_CLEARING_S = 3, 8.0
"""Objects that are cleared away for one task, and time after which clearing one is given up [s]."""
NEARBY = 0.09
"""Distance at which the open hand may run into a tall object on its way down [m]."""
PRESSING = 0.010
"""Height of the hand above its target from which it stands on something [m]."""
TOUCHING = 0.004
"""Distance at which something keeps a hand that does not get down to its grasp from it [m]."""
STALE_DISTANCE, STALE_ANGLE = 0.015, 0.2
"""An object or receptacle that moved further than this is looked at again [m, rad]."""


class ScriptedExpert:
    """Expert actions for the current tasks of a `CronosVectorEnv`.

    It is deterministic.

    Args:
        env: whose state is read; it is never changed.
        streams: act in these alone (k,); n is k then, and streams are numbered by their place in here.

    Attributes:
        mistake: (n, 3) how far from where it is the object to move is believed to be [m]; 0 but for misses on
            purpose.
    """

    def __init__(self, env: CronosVectorEnv, streams: np.ndarray | None = None):
        self.env, self.sim, self.scene = env, env.simulation, env.scene
        self._hand, self._arm_kind, fps = HANDS[env.scene.arm], env.scene.robot, env.scene.fps
        self._let_go_steps, self._max_vain_steps = round(LET_GO_S * fps), round(MAX_VAIN_S * fps)
        self._max_clearing_steps = round(MAX_CLEARING_S * fps)
        n, bodies = env.num_envs if streams is None else len(streams), self.scene.bodies
        self.mistake = np.zeros((n, 3))
        self._mine = slice(None) if streams is None else streams
        self._boxes = SceneBoxes.from_model(self.sim.model, self.scene)
        self._candidates = {
            i: grasp_candidates(self._hand, self._boxes, i) for i in range(len(self.scene.objects))
        }
        self._corners = {i: self._boxes.corners(i) for i in range(len(self.scene.objects))}
        self._is_support = np.array([name in self.scene.receptacles for name in bodies])
        # Indices of the object to move and of where to (-1: the table): by the task, and what is done first.
        self._task, self._goal = np.full((n, 2), -2), np.full((n, 2), -2)
        self._grasp_known, self._place_known = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self._grasp_point, self._grasp_axis, self._grasp_floor = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
        self._grasp_pose, self._grasp_width = np.zeros((n, 7)), np.zeros(n)
        self._held_width = np.zeros(n)
        # The last grasp points that failed, and for how long the hand has been at the current one in vain.
        self._failed, self._vain = np.full((n, NUM_FAILED, 3), np.inf), np.zeros(n, dtype=int)
        self._was_holding = np.zeros(n, dtype=bool)
        self._letting_go = np.zeros(n, dtype=int)
        self._place_xy, self._place_anchor, self._place_closing = (np.zeros((n, 2)) for _ in range(3))
        # The object that is being cleared away (-1: none), whether it has been in the hand, since when, how often.
        self._clear, self._clear_held = np.full(n, -1), np.zeros(n, dtype=bool)
        self._clear_steps, self._num_cleared = np.zeros(n, dtype=int), np.zeros(n, dtype=int)

    def reset(self, ids: np.ndarray) -> None:
        """Forget everything about streams `ids` (a new segment or episode)."""
        self._forget_choices(ids)
        self._clear[ids], self._num_cleared[ids] = -1, 0

    def _forget_choices(self, ids: np.ndarray) -> None:
        self._grasp_known[ids] = self._place_known[ids] = self._was_holding[ids] = False
        self._failed[ids], self._vain[ids], self._letting_go[ids] = np.inf, 0, 0

    def act(self) -> np.ndarray:
        """Actions (n, a) in physical units, within the action bounds."""
        self._look()
        self._update_goals()
        self._measure_held()
        self._update_grasps()
        self._update_places()
        command, place = self._pick(), self._place()
        done = self._success | ~self._holding & (self._letting_go > 0)
        self._letting_go -= done & ~self._success
        for applies, other in ((self._holding, place), (done, self._finish())):
            mask = applies[:, None]
            command = Command(*(np.where(mask, theirs, ours) for theirs, ours in zip(other, command)))
        width = np.where(self._holding | done, self._held_width, self._grasp_width)
        return self._hand.act(self._arm_target, command, width)

    # Perception -------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Read what this step's decisions need from the simulation."""
        sim = self.sim
        mine = self._mine
        self._poses = sim.body_poses()[mine]
        along = self._hand.closes_along
        self._arm, self._arm_target = sim.qpos[mine, : self._arm_kind.num_joints], sim.arm_target[mine]
        self._p, self._R = self._arm_kind.forward_kinematics(self._arm)[:2]
        self._target_p, target_R = self._hand.target_pose(self._arm_target)
        self._closing, self._target_closing = self._R[:, :, along], target_R[:, :, along]
        self._yaw = np.arctan2(self._closing[:, 1], self._closing[:, 0])
        self._opening = sim.gripper_opening()[mine]
        # Fingers that cannot close press on a side too wide for them: that is not a grasp.
        closed = (self._opening < self._hand.widest_opening)[:, None]
        self._held_objects = closed & np.stack([sim.is_grasped(name)[mine] for name in self.scene.objects], 1)

    def _update_goals(self) -> None:
        """The body to move and where to, (n,) indices; an object held by mistake goes to the table first."""
        bodies = self.scene.bodies
        tasks = [
            (bodies.index(t.object), bodies.index(t.receptacle) if t.receptacle else -1)
            for t in self.env.current_tasks
        ]
        goal = np.array(tasks)[self._mine]
        self.reset(np.flatnonzero((goal != self._task).any(1)))
        self._task = goal.copy()
        i = np.arange(len(goal))
        self._success = self.env.is_success[self._mine] & ~self._held_objects[i, goal[:, 0]]
        other = self._held_objects.copy()
        other[i, goal[:, 0]] = False
        wrong = other.any(1)
        goal[wrong] = np.stack([other.argmax(1), np.full(len(goal), -1)], 1)[wrong]
        self._success &= ~wrong
        self._update_clearing(goal)
        clearing = (self._clear >= 0) & ~wrong
        goal[clearing] = np.stack([self._clear, np.full(len(goal), -1)], 1)[clearing]
        self._forget_choices(np.flatnonzero((goal != self._goal).any(1)))
        self._goal = goal
        self._holding = self._held_objects[i, goal[:, 0]]
        self._object = self._poses[i, goal[:, 0]]
        self._object[:, :3] += self.mistake
        self._object_R = quaternion_to_matrix(self._object[:, 3:])

    def _measure_held(self) -> None:
        """How wide what is held is, until the fingers let go of it: they have to open further than that."""
        mine = self._holding & (self._letting_go == 0)
        self._held_width[mine] = self._hand.held_width(self._opening)[mine]

    def _update_clearing(self, goal: np.ndarray) -> None:
        """Stop clearing what was put down, or is not in the way of the `goal` (n, 2) of the task any more."""
        i, active = np.arange(len(goal)), self._clear >= 0
        held = active & self._held_objects[i, np.maximum(self._clear, 0)]
        self._clear_steps = np.where(active, self._clear_steps + 1, 0)
        put_down = self._clear_held & ~held
        self._clear_held = held
        done = put_down | self._success | self._held_objects[i, goal[:, 0]] & ~held
        done |= (self._clear_steps > self._max_clearing_steps) & ~held
        self._clear[active & done] = -1

    def _start_clearing(self, ids: np.ndarray, blocker: np.ndarray) -> None:
        """Clear away the objects `blocker` (k,) of streams `ids` first; -1 for none."""
        free = (blocker >= 0) & (self._clear[ids] < 0) & (self._num_cleared[ids] < MAX_CLEARED)
        self._clear[ids[free]] = blocker[free]
        self._num_cleared[ids[free]] += 1
        self._clear_steps[ids[free]] = 0

    def _update_grasps(self) -> None:
        """Choose a grasp where none is known, or where the object has moved since."""
        moved = np.linalg.norm(self._object[:, :3] - self._grasp_pose[:, :3], axis=1) > STALE_DISTANCE
        cosine = np.abs((self._object[:, 3:] * self._grasp_pose[:, 3:]).sum(1))
        moved |= 2 * np.arccos(np.minimum(cosine, 1.0)) > STALE_ANGLE
        wanted = ~self._holding & ~self._success & (moved | ~self._grasp_known)
        for obj in np.unique(self._goal[wanted, 0]):
            ids = np.flatnonzero(wanted & (self._goal[:, 0] == obj))
            grasps = choose_grasps(
                self._hand,
                self._candidates[obj], obj, WorldBoxes.at(self._boxes, self._poses[ids]),
                (self._object[ids, :3], self._object_R[ids]), self._arm[ids], self._failed[ids], self._is_support,
            )  # fmt: skip
            self._grasp_point[ids], self._grasp_axis[ids] = grasps.point, grasps.axis
            self._grasp_floor[ids], self._grasp_width[ids] = grasps.floor, grasps.width
            self._grasp_pose[ids] = self._object[ids]
            self._grasp_known[ids] = True
            self._start_clearing(ids, grasps.blocker)
            self._make_room(ids[(self._goal[ids, 1] >= 0) & (self._clear[ids] < 0)])

    def _make_room(self, ids: np.ndarray) -> None:
        """Before picking up, clear away an object from receptacles that have no room left."""
        for obj, target in np.unique(self._goal[ids], axis=0):
            mine = ids[(self._goal[ids] == (obj, target)).all(1)]
            R = self._object_R[mine]
            hand = self._object[mine, :3] + np.einsum("nij,nj->ni", R, self._grasp_point[mine])
            closing = np.einsum("nij,nj->ni", R, self._grasp_axis[mine])
            held = Held(
                self._object[mine, :3],
                R,
                hand,
                np.arctan2(closing[:, 1], closing[:, 0]),
                self._arm[mine],
                self._grasp_width[mine],
            )
            places = choose_places(
                self._hand, self.scene, obj, target, WorldBoxes.at(self._boxes, self._poses[mine]),
                self._poses[mine, target, :2], held,
            )  # fmt: skip
            self._start_clearing(mine, places.blocker)

    def _give_up(self, failed: np.ndarray) -> None:
        """Remember the grasps that failed (n,) bool, so that the next choice is another one."""
        self._failed[failed, 1:] = self._failed[failed, :-1]
        self._failed[failed, 0] = self._grasp_point[failed]
        self._grasp_known[failed], self._vain[failed] = False, 0

    def _update_places(self) -> None:
        """Choose a free spot for what is newly held, or where the receptacle has moved since."""
        self._place_known &= self._holding
        receptacle = self._goal[:, 1]
        xy = self._poses[np.arange(len(receptacle)), np.maximum(receptacle, 0), :2]
        moved = (receptacle >= 0) & (np.linalg.norm(xy - self._place_anchor, axis=1) > STALE_DISTANCE)
        wanted = self._holding & (moved | ~self._place_known)
        for obj, target in np.unique(self._goal[wanted], axis=0):
            ids = np.flatnonzero(wanted & (self._goal == (obj, target)).all(1))
            width = self._held_width[ids]
            middle = self._hand.to_middle(self._p[ids], horizontal(self._closing[ids]), width)
            held = Held(self._object[ids, :3], self._object_R[ids], middle, self._yaw[ids], self._arm[ids], width)
            places = choose_places(
                self._hand, self.scene, obj, target, WorldBoxes.at(self._boxes, self._poses[ids]), xy[ids], held
            )
            self._place_xy[ids], self._place_anchor[ids] = places.xy, places.anchor
            self._place_closing[ids] = places.closing
            self._place_known[ids] = True

    # Decisions --------------------------------------------------------------------------------------------

    def _pick(self) -> Command:
        """Hover, align, descend and close."""
        point = self._object[:, :3] + np.einsum("nij,nj->ni", self._object_R, self._grasp_point)
        closing = horizontal(np.einsum("nij,nj->ni", self._object_R, self._grasp_axis))
        hand, width = self._hand, self._grasp_width
        grasp = hand.to_end_effector(point, closing, width)
        lowest = self._grasp_floor + hand.tip_clearance + hand.tip_reach - 0.002
        grasp[:, 2] = np.maximum(grasp[:, 2], lowest)
        error = self._misalignment(grasp, closing)
        low = self._p[:, 2] - grasp[:, 2]
        aligned = error < ALIGNED + 0.004
        empty = self._opening < hand.empty_opening
        missed = aligned & (low < GRASP_REACHED) & empty
        close = aligned & (low < GRASP_REACHED) & ~empty
        down = aligned & (self._target_p[:, 2] - grasp[:, 2] < GRASP_REACHED)
        pressing = self._p[:, 2] - self._target_p[:, 2] > PRESSING
        self._notice_failures(missed, empty, down | pressing)
        # Fingers that are still opening do not go down on the object.
        still_opening = np.where(close, 0.0, hand.still_opening(self._opening, width))
        gripper = np.where(close, CLOSE, OPEN)[:, None]
        # Nor does a hand that is not aligned yet: it would knock over what is tall.
        tall = np.maximum(self._top_nearby(point) - point[:, 2] - hand.pad_half[0], 0.0)
        return Command(self._funnel(grasp, error, still_opening, tall), closing, gripper)

    def _notice_failures(self, missed: np.ndarray, empty: np.ndarray, there: np.ndarray) -> None:
        """Give up grasps that closed on nothing, let the object slip, or cannot be reached (n,) bool."""
        trying = ~self._holding & ~self._success
        self._vain = np.where(there & trying, self._vain + 1, 0)
        slipped = self._was_holding & trying & empty
        self._was_holding = self._holding.copy()
        stuck = self._vain > self._max_vain_steps
        self._clear_from_under_hand(np.flatnonzero(stuck))
        self._give_up(missed & ~self._holding | slipped | stuck)

    def _clear_from_under_hand(self, ids: np.ndarray) -> None:
        """Where the hand does not get down to the grasp, clear away what it stands on."""
        for obj in np.unique(self._goal[ids, 0]):
            mine = ids[self._goal[ids, 0] == obj]
            closing, width = horizontal(self._closing[mine]), self._grasp_width[mine]
            middle = self._hand.to_middle(self._p[mine], closing, width)
            blocker = find_blocker(
                self._hand, WorldBoxes.at(self._boxes, self._poses[mine]), middle, closing, obj,
                self._is_support, width, TOUCHING,
            )  # fmt: skip
            self._start_clearing(mine, blocker)

    def _place(self) -> Command:
        """Lift, carry above the free spot, lower and let go."""
        i = np.arange(len(self._p))
        receptacle = self._goal[:, 1]
        goal_xy = self._place_xy + self._place_anchor
        closing = np.concatenate([self._place_closing, np.zeros((len(i), 1))], 1)
        turn = np.arctan2(closing[:, 1], closing[:, 0]) - self._yaw
        offset = self._object[:, :3] - self._p
        c, s = np.cos(turn), np.sin(turn)
        position = np.empty_like(self._p)
        position[:, 0] = goal_xy[:, 0] - (c * offset[:, 0] - s * offset[:, 1])
        position[:, 1] = goal_xy[:, 1] - (s * offset[:, 0] + c * offset[:, 1])
        top = np.where(receptacle >= 0, self._receptacle_top(receptacle), 0.0)
        position[:, 2] = self._p[:, 2] + top - self._bottom() + DROP_HEIGHT
        tips = top + self._hand.tip_clearance + self._hand.tip_reach - 0.002
        position[:, 2] = np.maximum(position[:, 2], tips)
        error = self._misalignment(position, closing)
        low = self._p[:, 2] - position[:, 2]
        # The target is down but the hand is not: the object rests on something.
        rests = (self._target_p[:, 2] - position[:, 2] < 0.004) & (self._p[:, 2] - self._target_p[:, 2] > 0.005)
        carried = self._is_carried() | (self._hand.lift == 0.0)
        release = carried & (error < ALIGNED + 0.006) & ((low < 0.006) | rests)
        self._letting_go[self._holding & release] = self._let_go_steps
        gripper = np.where(release, OPEN, CLOSE)[:, None]
        lift, none = np.where(carried, 0.0, self._hand.lift), np.zeros(len(i))
        return Command(self._funnel(position, error, lift, none), closing, gripper)

    def _is_carried(self) -> np.ndarray:
        """Whether the judge has seen what is held (n,) long enough in the air."""
        carried_to = self.sim.judge.carried_to[self._mine]
        objects = np.minimum(self._goal[:, 0], len(self.scene.objects) - 1)
        return carried_to[np.arange(len(objects)), objects] == IN_HAND

    def _finish(self) -> Command:
        """The object is put down: open, go straight up and wait."""
        position = self._target_p.copy()
        opened = self._hand.has_let_go(self._opening, self._held_width)
        height = np.maximum(self._target_p[:, 2], self._hand.retreat)
        position[:, 2] = np.where(opened, height, position[:, 2])
        return Command(position, self._target_closing, np.full((len(position), 1), OPEN))

    def _misalignment(self, goal: np.ndarray, closing: np.ndarray) -> np.ndarray:
        """Horizontal error (n,) of the hand, a yaw error counting as metres [m]."""
        yaw = np.arctan2(closing[:, 1], closing[:, 0]) - self._yaw
        yaw = np.abs(np.arctan2(np.sin(yaw), np.cos(yaw)))
        return np.linalg.norm((goal - self._p)[:, :2], axis=1) + YAW_TO_METRES * yaw

    def _funnel(self, goal: np.ndarray, error: np.ndarray, least: np.ndarray, tall: np.ndarray) -> np.ndarray:
        """Come to `goal` from above: the height follows the remaining error, and below it the hand rises first.

        It stays `least` (n,) above the goal, and `tall` (n,) higher than usual until it is aligned [m].
        """
        rise = np.clip(FUNNEL_SLOPE * (error - ALIGNED), 0.0, self._hand.hover)
        rise += tall * np.clip((error - ALIGNED) / ALIGNED, 0.0, 1.0)
        height = goal[:, 2] + np.maximum(rise, least)
        too_low = height - self._target_p[:, 2]
        advance = np.clip(1.0 - (too_low - 0.02) / 0.03, 0.0, 1.0)
        position = self._target_p + advance[:, None] * (goal - self._target_p)
        position[:, 2] = height
        return position

    def _receptacle_top(self, receptacle: np.ndarray) -> np.ndarray:
        top = WorldBoxes.at(self._boxes, self._poses).top()
        masked = np.where(self._boxes.body == receptacle[:, None], top, -np.inf)
        return masked.max(1)

    def _top_nearby(self, point: np.ndarray) -> np.ndarray:
        """Height (n,) of the highest object around `point` (n, 3) or around the hand [m]."""
        world = WorldBoxes.at(self._boxes, self._poses)
        gap = [np.linalg.norm(world.centre[..., :2] - xy[:, None, :2], axis=-1) for xy in (point, self._p)]
        near = (np.minimum(*gap) < NEARBY) & ~self._is_support[self._boxes.body]
        return np.where(near, world.top(), 0.0).max(1)

    def _bottom(self) -> np.ndarray:
        """Height (n,) of the lowest point of the object to move [m]."""
        bottom = np.empty(len(self._p))
        for obj, corners in self._corners.items():
            mine = self._goal[:, 0] == obj
            bottom[mine] = np.einsum("ni,pi->np", self._object_R[mine, 2], corners).min(1)
        return bottom + self._object[:, 2]
