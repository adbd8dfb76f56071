"""The scripted person: does tasks, presses keys on time or wrongly, resets the scene, takes over."""

import numpy as np
import pytest
from lerobot.processor.hil_processor import HasTeleopEvents
from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot_env_cronos import CronosVectorEnv, ScriptedExpert
from simulated_arm import CUBE_ON_PLATE, SCENE, connect_both

CUBE_ON_TABLE = "put the cube on the table"


def still(robot) -> dict:
    """The action that changes nothing."""
    return dict(zip(robot.action_features, robot.desk.goal, strict=True))


def happened(person) -> set:
    return {event for event, on in person.get_teleop_events().items() if on}


def test_it_does_its_task_as_the_expert_does_and_presses_success_in_time(tmp_path):
    robot, person = connect_both(tmp_path, start=2, task=CUBE_ON_PLATE, reaction_s=0.5)
    assert isinstance(person, HasTeleopEvents)
    assert person.action_features == robot.action_features
    env = CronosVectorEnv(1, SCENE, num_threads=1)
    env.scene_reset(np.arange(1), np.array([2]))
    env.set_task([0], [task for task in env.tasks if task.instruction == CUBE_ON_PLATE])
    expert, succeeded, pressed = ScriptedExpert(env), None, []
    for step in range(1, 300):
        action = expert.act()
        assert list(person.get_action().values()) == list(person.get_action().values()) == action[0].tolist()
        robot.send_action(person.get_action())
        env.step_streams(action, np.arange(1))
        succeeded = succeeded or (step if env.is_success[0] else None)
        if TeleopEvents.SUCCESS in happened(person):
            pressed.append(step)
        if succeeded and step > succeeded + 30:
            break
    assert pressed == [succeeded + 15]


def test_wrong_keys(tmp_path):
    robot, person = connect_both(tmp_path, wrong_key_rate=1.0)
    person.send_feedback({"task": CUBE_ON_PLATE})
    pressed = []
    for step in range(1, 480):
        robot.send_action(still(robot))
        pressed += [step] * (TeleopEvents.SUCCESS in happened(person))
    assert pressed == [432]
    # A task that is complete from the start: the key is not pressed.
    person.send_feedback({"task": CUBE_ON_TABLE})
    for _ in range(480):
        robot.send_action(still(robot))
        assert not happened(person)
    assert robot.world.is_success[0]
    person.config.wrong_key_rate = 0.0
    for judges in (True, False):
        person.send_feedback({"task": CUBE_ON_TABLE, "judge": judges})
        person.get_teleop_events()
        robot.clock.sleep(1.0)
        assert happened(person) == ({TeleopEvents.SUCCESS} if judges else set())


def test_the_share_of_wrong_keys_and_late_resets_is_as_asked_and_seeded(tmp_path):
    def draw(seed: int) -> tuple[list, list]:
        robot, person = connect_both(tmp_path, wrong_key_rate=0.3, late_rate=0.5, seed=seed)
        wrong, takes = [], []
        for _ in range(300):
            person.send_feedback({"task": CUBE_ON_PLATE, "scene_reset": 0})
            wrong.append(person._segment.wrong)
            takes.append(person._reset[0] - robot.clock.time())
        robot.disconnect()
        return wrong, takes

    wrong, takes = draw(0)
    assert (wrong, takes) == draw(0) != draw(1)
    assert np.mean(wrong) == pytest.approx(0.3, abs=0.08)
    assert np.mean(np.array(takes) > 20) == pytest.approx(0.5, abs=0.09)
    assert min(takes) == 20
    assert 38 < max(takes) < 40


def test_it_resets_the_scene_later_and_says_so_once(tmp_path):
    robot, person = connect_both(tmp_path)
    person.send_feedback({"scene_reset": 5, "split": "held_out"})
    robot.send_action(dict.fromkeys(robot.action_features, 10.0))
    robot.clock.sleep(19.9)
    assert not happened(person)
    robot.clock.sleep(0.1)
    assert happened(person) == {"scene_reset"}
    env = CronosVectorEnv(1, SCENE, num_threads=1)
    env.scene_reset(np.arange(1), np.array([5]), "held_out")
    np.testing.assert_array_equal(robot.world.simulation.qpos, env.simulation.qpos)
    assert not happened(person)
    np.testing.assert_allclose(list(person.get_action().values()), env.observe()["agent_pos"][0], atol=1e-3)
    person.press("pause")
    assert happened(person) == {"pause"}


def test_it_takes_over_when_it_takes_too_long(tmp_path):
    robot, person = connect_both(tmp_path, start=1, patience_s=1.0, takeovers=1, judges=False)
    person.send_feedback({"task": CUBE_ON_PLATE})
    helped = []
    for _ in range(300):
        helping = person.get_teleop_events()[TeleopEvents.IS_INTERVENTION]
        helped.append(helping)
        robot.send_action(person.get_action() if helping else still(robot))
        if helped[-2:] == [True, False]:
            break
    assert helped[:30] == [False] * 30
    assert all(helped[30:-1])
    assert robot.world.is_success[0]
    person.send_feedback({"task": "put the marker on the plate"})
    robot.clock.sleep(5.0)
    assert not happened(person)


def test_who_is_told_nonsense_says_so(tmp_path):
    robot, person = connect_both(tmp_path)
    with pytest.raises(ValueError, match="put the cube on the plate"):
        person.send_feedback({"task": "dance"})
    robot.disconnect()
    with pytest.raises(DeviceNotConnectedError, match="desk"):
        person.get_action()
