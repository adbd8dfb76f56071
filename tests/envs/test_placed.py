"""What counts as placed: carried there, let go, still, and borne by the receptacle."""

import copy

import numpy as np
import pytest
from env_rollouts import STILL, WIDOWX_SCENES, keep_still, make
from lerobot_env_cronos import CronosVectorEnv, Task, get_scene
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.scene.arms.widowx.geometry import FINGERTIP_REACH, HOME_QPOS
from lerobot_env_cronos.scene.arms.widowx.kinematics import forward_kinematics, inverse_kinematics
from lerobot_env_cronos.scene.model import TABLE, hand_sensor, support_sensor
from lerobot_env_cronos.scene.scenes import BODIES, SCENES

CENTRE = np.array([0.30, 0.0])
BOTTLE, SHOVEL, PLATE = "ketchup bottle", "kitchen shovel", "yellow plate"
PLATE_TOP = 0.006
WEIGHT = {BOTTLE: 0.1388, SHOVEL: 0.3246}
"""Volume of the boxes that they consist of, times density and 9.81 m/s^2 [N]."""


def put(env: CronosVectorEnv, tasks: list[Task], offsets: np.ndarray, centres: np.ndarray | None = None) -> None:
    """Each stream's receptacle at `centres` (n, 2), its object `offsets` (n, 3) from there, its underside at that
    height; all other bodies far away, all as they rest."""
    bodies = env.scene.bodies
    poses = np.zeros((env.num_envs, len(bodies), 7))
    poses[..., 3] = 1.0
    for i, name in enumerate(bodies):
        poses[:, i, :3] = [-0.10, 0.16 * i - 0.40, BODIES[name].size[2] / 2]
    for n, (task, offset) in enumerate(zip(tasks, offsets, strict=True)):
        centre = CENTRE if centres is None else centres[n]
        poses[n, bodies.index(task.receptacle), :2] = centre
        poses[n, bodies.index(task.object), :2] = centre + offset[:2]
        poses[n, bodies.index(task.object), 2] = offset[2] + BODIES[task.object].size[2] / 2
    env.place_bodies(np.arange(env.num_envs), poses)
    env.set_task(range(env.num_envs), tasks)


def move_hand(env: CronosVectorEnv, fingertips: np.ndarray, closing: np.ndarray) -> None:
    """Teleport the arm: the hand points down, `fingertips` (n, 3), the fingers close along `closing` (n, 2)."""
    n = env.num_envs
    down, side = np.tile([0.0, 0.0, -1.0], (n, 1)), np.concatenate([closing, np.zeros((n, 1))], 1)
    R = np.stack([down, side, np.cross(down, side)], 2)
    goal, q = fingertips + np.array([0, 0, FINGERTIP_REACH]), np.tile(HOME_QPOS, (n, 1))
    start, _, _ = forward_kinematics(q)
    for way in np.linspace(0.05, 1.0, 20):
        q = inverse_kinematics(q, start + way * (goal - start), R)
    assert np.linalg.norm(forward_kinematics(q)[0] - goal, axis=1).max() < 0.01
    env.simulation.move_arm(np.arange(n), q)


def drive(env: CronosVectorEnv, motion: np.ndarray, gripper: np.ndarray, steps: int = 1) -> np.ndarray:
    """Move the hand by `motion` (n or 1, 3) at every step; success (steps, n)."""
    actions = np.zeros((env.num_envs, 7))
    actions[:, :3], actions[:, 6] = motion, gripper
    return np.array([env.step(actions)[4]["is_success"] for _ in range(steps)])


def lies_on(env: CronosVectorEnv, task: Task) -> np.ndarray:
    """From the forces alone: nothing but the receptacle bears any of the object."""
    sim = env.simulation
    borne = sim.force(support_sensor(task.object, task.receptacle))[:, 2]
    rest = np.linalg.norm(sim.force(support_sensor(task.object, TABLE)), axis=1)
    return (borne > 0.05) & (rest == 0) & (sim.force(hand_sensor(task.object))[:, 0] == 0)


@pytest.mark.parametrize("scene", WIDOWX_SCENES)
def test_no_push_along_the_table_counts(scene):
    # Each pair of bodies once: those of kitchen_2x2 are in kitchen_3x3, too.
    tasks = [t for t in get_scene(scene).tasks if scene != "kitchen_3x3" or t not in SCENES["kitchen_2x2"].tasks]
    which, side, high, opened = (
        a.ravel() for a in np.meshgrid(range(len(tasks)), range(8), range(2), range(2), indexing="ij")
    )
    env, each = make(len(which), scene), [tasks[i] for i in which]
    angle = side * np.pi / 4
    out = np.stack([np.cos(angle), np.sin(angle)], 1)
    size, base = (np.array([BODIES[getattr(t, kind)].size for t in each]) for kind in ("object", "receptacle"))
    reach = (np.abs(out) * size[:, :2]).sum(1) / 2
    gap = reach + (np.abs(out) * base[:, :2]).sum(1) / 2 + 0.003
    far = gap + reach + 0.03 + 0.03 * opened
    centre = CENTRE - out * far[:, None] / 2
    put(env, each, np.concatenate([out * gap[:, None], 0 * gap[:, None]], 1), centre)
    tips = np.where(high, 0.85 * size[:, 2], 0.004)
    # An open hand pushes with the back of one finger, a closed one with both.
    closing = np.where(opened[:, None], out, np.stack([-out[:, 1], out[:, 0]], 1))
    start = np.concatenate([centre + out * far[:, None], tips[:, None]], 1)
    move_hand(env, start + np.array([0, 0, 0.08]), closing)
    drive(env, np.zeros((1, 3)), opened, 2)
    move_hand(env, start, closing)
    push = np.concatenate([-0.02 * out, 0 * gap[:, None]], 1)
    success, lay = np.zeros(len(each), dtype=bool), np.zeros(len(each), dtype=bool)
    for motion, steps in ((push, 10), (np.array([[0, 0, 0.04]]), 2), (np.zeros((1, 3)), 2)):
        success |= drive(env, motion, opened, steps).any(0)
    for i, task in enumerate(tasks):
        lay |= lies_on(env, task) & (which == i)
    assert not success.any(), [(each[i], side[i], high[i], opened[i]) for i in np.flatnonzero(success)]
    # Tall and round ones topple and roll onto it: the receptacle then bears all of them, and still no hand has.
    assert lay.any()


def test_an_overhang_counts_and_a_lean_does_not():
    # The shovel points along y, its centre of mass 5 mm from its middle; the plate's rim is 55 mm from its centre.
    # At 45 mm it overhangs by 64 mm, at 75 mm it tips over the rim until one end is on the table.
    task = Task(SHOVEL, PLATE)
    env = make(5)
    offsets = np.array([[0, y, PLATE_TOP] for y in (0.0, 0.045, -0.045, 0.075, -0.075)])
    put(env, [task] * 5, offsets)
    success = keep_still(env, 10)
    np.testing.assert_array_equal(success[-1], [True, True, True, False, False])
    assert not success[:, 3:].any()
    table = env.simulation.force(support_sensor(SHOVEL, TABLE))[:, 2]
    plate = env.simulation.force(support_sensor(SHOVEL, PLATE))[:, 2]
    np.testing.assert_allclose(plate[:3], WEIGHT[SHOVEL], rtol=0.02)
    np.testing.assert_allclose((plate + table)[3:], WEIGHT[SHOVEL], rtol=0.02)
    # Both bear some of it: it leans.
    assert np.minimum(plate, table)[3:].min() > 0.03
    assert not env.simulation.is_on_table(SHOVEL).any()


def test_pressed_from_above_counts_once_the_hand_is_gone_and_then_for_good():
    task = Task(BOTTLE, PLATE)
    env = make(2)
    put(env, [task] * 2, np.array([[0, 0, PLATE_TOP]] * 2))
    top = PLATE_TOP + BODIES[BOTTLE].size[2]
    above = np.tile([*CENTRE, top + 0.02], (2, 1))
    # The first hand is there before the bottle has come to rest, the second one comes later.
    above[0, 2] = top - 0.002
    move_hand(env, above, np.tile([1.0, 0.0], (2, 1)))
    closed, pressing = np.zeros(2), np.array([[0, 0, -0.01], [0, 0, 0]])
    early = drive(env, pressing, closed, 4)
    assert env.simulation.force(support_sensor(BOTTLE, PLATE))[0, 2] > 2 * WEIGHT[BOTTLE]
    np.testing.assert_array_equal(early[-1], [False, True])
    assert drive(env, np.array([[0, 0, 0.02], [0, 0, 0]]), closed, 8)[-1].all()
    # Both are placed. A press, and the touches of a hand that goes away, change nothing.
    late = drive(env, np.array([[0, 0, 0], [0, 0, -0.01]]), closed, 4)
    assert env.simulation.force(support_sensor(BOTTLE, PLATE))[1, 2] > 2 * WEIGHT[BOTTLE]
    assert late.all()
    assert drive(env, np.array([[0, 0, 0], [0, 0, 0.02]]), closed, 8).all()


def test_what_was_placed_is_so_until_it_leaves_the_receptacle():
    # Of three bottles on the plate one is pushed 1 cm along it, one off it, and one is lifted and put back.
    task = Task(BOTTLE, PLATE)
    env = make(3)
    put(env, [task] * 3, np.array([[0, 0, PLATE_TOP]] * 3))
    assert keep_still(env, 3)[-1].all()
    width = BODIES[BOTTLE].size[1]
    tips = np.tile([*CENTRE, PLATE_TOP + 0.004], (3, 1))
    tips[:2, 1] += width / 2 + 0.05
    tips[2, 2] += 0.01
    closing = np.array([[0.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    move_hand(env, tips + np.array([0, 0, 0.08]), closing)
    drive(env, np.zeros((1, 3)), np.array([0, 0, 1]), 2)
    move_hand(env, tips, closing)
    before = env.simulation.body_pose(BOTTLE)[:, 1].copy()
    push = np.array([[0, -0.012, 0], [0, -0.03, 0], [0, 0, 0.0]])
    pushed = drive(env, push, np.array([0, 0, 0]), 4)
    moved = before - env.simulation.body_pose(BOTTLE)[:, 1]
    assert 0.004 < moved[0] < 0.04
    assert moved[1] > 0.05
    assert pushed[:, 0].all()
    assert not pushed[-1, 1]
    lifted = drive(env, np.array([[0, 0, 0.03]]), np.array([0, 0, 0]), 3)
    np.testing.assert_array_equal(lifted[-1], [True, False, False])
    assert env.simulation.body_pose(BOTTLE)[2, 2] > 0.05
    drive(env, np.array([[0, 0, -0.03]]), np.array([0, 0, 0]), 3)
    np.testing.assert_array_equal(keep_still(env, 6)[-1], [True, False, True])


def test_what_is_dropped_counts_when_it_lies_still():
    heights = np.linspace(0.001, 0.06, 16)
    env = make(len(heights))
    put(env, [Task(BOTTLE, PLATE)] * len(heights), np.array([[0, 0, PLATE_TOP + h] for h in heights]))
    assert not env.is_success.any()
    before = env.simulation.body_pose(BOTTLE).copy()
    for _ in range(12):
        env.step(np.tile(STILL, (len(heights), 1)))
        now = env.simulation.body_pose(BOTTLE).copy()
        # In the last 0.2 s it neither fell nor turned.
        assert np.abs(now - before)[env.is_success].max(initial=0) < 0.004
        before = now
    assert env.is_success.all()


def test_the_expert_is_paid_after_it_has_let_go():
    env = make(16)
    env.set_task(range(16), [env.scene.tasks[i % 4] for i in range(16)])
    expert, paid = ScriptedExpert(env), np.zeros(16, dtype=bool)
    for _ in range(80):
        env.step(expert.act())
        for i in np.flatnonzero(env.is_success & ~paid):
            assert lies_on(env, env.current_tasks[i])[i]
        paid |= env.is_success
    assert paid.all()
    # What is complete does not depend on which task a stream has; no object lies on both receptacles.
    complete, own = env.find_complete(env.scene.tasks), env.is_success.copy()
    np.testing.assert_array_equal(complete[np.arange(16), np.arange(16) % 4], own)
    assert (complete.reshape(16, 2, 2).sum(axis=2) <= 1).all()
    env.set_task(range(16), [env.scene.tasks[3]] * 16)
    np.testing.assert_array_equal(env.find_complete(env.scene.tasks), complete)
    np.testing.assert_array_equal(env.is_success, complete[:, 3])


def test_pushed_off_and_on_again_does_not_count():
    task = Task(BOTTLE, "cloth")
    env = make(1)
    put(env, [task], np.array([[0, 0, 0.0094]]))
    assert keep_still(env, 3)[-1, 0]
    # An intervention that moves the cloth away drops the bottle on the table, another slides the cloth under it.
    cloth = env.simulation.body_pose("cloth").copy()
    env.simulation.move_body(np.array([0]), "cloth", cloth + np.array([0.2, 0, 0, 0, 0, 0, 0]))
    assert not keep_still(env, 5).any()
    assert env.simulation.is_on_table(BOTTLE)[0]
    lifted = env.simulation.body_pose(BOTTLE) + np.array([0, 0, 0.0094, 0, 0, 0, 0])
    env.simulation.qpos[:, 8:15] = lifted
    env.simulation.move_body(np.array([0]), "cloth", cloth)
    assert not keep_still(env, 5).any()
    assert lies_on(env, task)[0]
    # Put there by an intervention of its own it counts as carried.
    env.simulation.move_body(np.array([0]), BOTTLE, env.simulation.body_pose(BOTTLE).copy())
    assert keep_still(env, 3)[-1, 0]


def test_a_reset_task_is_complete_from_the_start_when_bodies_were_put_on_the_table():
    env = make(2, "playroom_2x2")
    env.set_task([0, 1], [Task("toy bear", None), Task("plastic bottle", None)])
    assert env.is_success.all()
    _, reward, *_ = env.step(np.tile(STILL, (2, 1)))
    assert env.is_success.all()
    assert not reward.any()


def test_a_body_that_is_put_back_is_no_control_step_of_the_others():
    env = make(1)
    env.scene_reset([0], np.array([0]))
    env.set_task([0], [env.scene.tasks[0]])
    expert, task = ScriptedExpert(env), env.scene.tasks[0]
    others = [body for body in env.scene.bodies if body not in (task.object, task.receptacle)]
    seen = set()
    for _ in range(60):
        env.step(expert.act())
        judge = env.simulation.judge
        # Squeezed at one reading, which is no carry; on the receptacle at one, which is not yet placed.
        if judge.held[0, 0] == 1 or (judge.place[0, 0] > 0 and not env.is_success[0]):
            seen.add(int(judge.held[0, 0]))
            before = {name: array.copy() for name, array in judge.state_arrays().items()}
            helped = copy.deepcopy(env)
            for body in others:
                helped.put_back(0, env.scene.bodies.index(body), np.random.default_rng(1))
            after = helped.simulation.judge.state_arrays()
            for name in ("held", "carried_to", "place", "confirmed", "rests"):
                assert after[name][0, 0] == before[name][0, 0], name
            helped.set_task([0], [helped.scene.tasks[0]])
            assert not helped.is_success[0]
    assert seen == {0, 1}
    assert env.is_success[0]
