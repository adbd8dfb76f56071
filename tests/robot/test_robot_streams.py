"""A simulated SO-101 as the one stream of a run: its clock, its person, its limits and its faults."""

import json
import os
import pty
import signal
import sys

import numpy as np
import pytest
from lerobot.teleoperators.utils import TeleopEvents
from lerobot_env_cronos import CronosVectorEnv
from lerobot_robot_cronos import CronosPersonConfig, CronosSO101Config
from PIL import Image

from cronos_lerobot.robot.config import CronosRobotConfig
from cronos_lerobot.robot.judges import PersonJudge, SimJudge
from cronos_lerobot.robot.person import Events, Person
from cronos_lerobot.robot.safety import Safety
from cronos_lerobot.robot.setups import load_setup
from cronos_lerobot.robot.station import Station, Stopped

FPS, ONE = 30, np.array([0])


@pytest.fixture
def make(tmp_path):
    """Make the streams of a simulated robot with a scripted person; closed at the end of the test."""
    made = []

    def make(person=None, **flags):
        robot = CronosSO101Config(id="desk", real_time=False, camera_names=flags.pop("camera_names", []))
        teleop = CronosPersonConfig(robot_id="desk", reset_s=2.0, judges=False, **(person or {}))
        config = CronosRobotConfig(robot=robot, teleop=teleop, **{"judge": "sim"} | flags)
        env = config.create_streams(1)
        env.config = config
        env.folder = tmp_path
        made.append(env)
        return env

    yield make
    for env in made:
        env.close()


def ledger(env):
    return [json.loads(line) for line in (env.folder / "interventions.jsonl").read_text().splitlines()]


def begin(env, task=0):
    env.scene_reset(ONE, np.array([3]))
    env.set_task(ONE, [env.tasks[task]])


def hold(env, steps):
    return [env.step(env.station.target[None])[4] for _ in range(steps)]


def test_it_observes_what_the_scene_does(make):
    env = make(task_observation="one_hot", camera_names=["front"])
    begin(env, task=2)
    world = CronosVectorEnv(
        1, "so101_desk_2x2", obs_type="environment_state_agent_pos", task_observation="one_hot"
    )
    world.scene_reset(ONE, np.array([3]))
    world.set_task(ONE, [world.tasks[2]])
    assert env.state_names == world.state_names
    assert np.allclose(env.observe()["agent_pos"], world.observe()["agent_pos"], atol=1e-4)
    assert {key: f.shape for key, f in env.config.features.items()} == {
        "action": (6,), "agent_pos": (11,), "observation.images.front": (240, 320, 3)
    }  # fmt: skip


def test_a_scene_reset_waits_for_the_person_and_costs_what_it_takes(make):
    env = make()
    before = env.station.clock.time()
    env.scene_reset(ONE, np.array([3]))
    # Nobody is asked until something follows.
    assert env.station.clock.time() == before
    env.observe()
    # Two seconds home and two of the person's.
    assert env.station.clock.time() - before == pytest.approx(4.0, abs=0.1)
    wanted = CronosVectorEnv(1, "so101_desk_2x2", obs_type="environment_state_agent_pos")
    wanted.scene_reset(ONE, np.array([3]))
    bodies = "environment_state"
    assert np.allclose(env.station.robot.world.observe()[bodies], wanted.observe()[bodies], atol=1e-3)
    (line,) = ledger(env)
    assert (line["kind"], line["start"], line["during"]) == ("scene_reset", 3, "training")
    assert line["seconds"] == pytest.approx(2.0, abs=0.1)
    assert (env.folder / "starts/train_003.png").is_file()


def test_what_was_sent_is_what_is_told_and_help_is_marked(make):
    env = make(person={"takeovers": 1, "patience_s": 1.0})
    begin(env)
    infos = hold(env, FPS + 400)
    helped = [bool(info["intervened"][0]) for info in infos]
    assert not any(helped[: FPS - 1])
    assert any(helped)
    # The expert does the task, and the truth says so.
    assert infos[-1]["is_success"][0]
    assert not helped[-1]
    (line,) = [line for line in ledger(env) if line["kind"] == "take_over"]
    assert line["seconds"] == pytest.approx(sum(helped) / FPS, abs=0.05)
    moved = np.ptp([info["executed_action"][0] for info in infos], axis=0)
    assert (moved[:5] > 1).all()


def test_targets_keep_to_limits_steps_and_the_box():
    setup = load_setup("so101_desk_2x2")
    safety = Safety(setup, max_step=5.0)
    home = setup.home
    assert np.allclose(safety.limit(home + 3, home), home + 3)
    assert safety.limited == 0
    assert np.allclose(safety.limit(home + 50, home), home + 5)
    assert (safety.steps_for(101), Safety(setup, None).steps_for(101)) == (21, 1)
    far = np.full(6, 1e4, np.float32)
    assert np.allclose(Safety(setup, None).limit(far, home), setup.high)
    assert safety.limited == 1


def test_an_action_that_leaves_the_box_is_not_sent(tmp_path):
    photo = tmp_path / "photos/a.png"
    photo.parent.mkdir()
    Image.new("RGB", (4, 4)).save(photo)
    file = tmp_path / "tasks.yaml"
    file.write_text(
        "arm: so101\ntasks: [push the cup, pull the cup]\nstarts: {train: photos}\n"
        "box: [[-0.1, -0.4, 0.05], [0.4, 0.4, 0.4]]\n"
    )
    setup = load_setup(str(file))
    assert ([task.instruction for task in setup.tasks], setup.starts) == (
        ["push the cup", "pull the cup"],
        {"train": 1, "held_out": 0},
    )
    assert setup.hand(setup.home)[2] > 0.05
    safety = Safety(setup, None)
    down = setup.home + np.array([0, 60, 0, 0, 0, 0], np.float32)
    assert setup.hand(down)[2] < 0.05
    assert np.array_equal(safety.limit(down, setup.home), setup.home)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("tasks: [a]", "must have tasks and starts"),
        ("{tasks: [a], starts: {train: none}}", "needs"),
        ("{arm: so102, tasks: [a], starts: {train: none}}", "valid arms"),
        ("{arm: so101, tasks: [a], starts: {train: none}}", "no picture"),
    ],
)
def test_a_file_of_tasks_that_lacks_something_says_what(tmp_path, text, complaint):
    file = tmp_path / "tasks.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=complaint):
        load_setup(str(file))


@pytest.mark.parametrize("device", ["bus", "camera"])
def test_a_lost_device_cuts_the_trace_and_waits_for_a_person(make, device):
    env = make(camera_names=["wrist"])
    begin(env)
    robot = env.station.robot
    lost = robot.bus if device == "bus" else robot.cameras["wrist"]
    assert not hold(env, 5)[-1]["diverged"][0]
    goal = robot.desk.goal.copy()
    lost.unplug()
    info = env.step(env.station.target[None] + 5)[4]
    assert info["diverged"][0]
    assert not info["is_success"][0]
    assert np.array_equal(robot.desk.goal, goal) == (device == "bus")
    # The person plugs it in, and puts the scene to the start that is wanted.
    env.scene_reset(ONE, np.array([5]))
    env.observe()
    assert [line["kind"] for line in ledger(env)] == ["scene_reset", "mend", "scene_reset"]
    assert not hold(env, 5)[-1]["diverged"][0]


def test_an_emergency_stop_moves_nothing_until_the_person_says_so(make):
    env = make()
    begin(env)
    teleop = env.station.person.teleop
    teleop.press("emergency_stop")
    assert env.step(env.station.target[None] + 5)[4]["diverged"][0]
    assert not any(env.station.robot.bus.sync_read("Torque_Enable").values())
    env.scene_reset(ONE, np.array([5]))
    env.observe()
    assert all(env.station.robot.bus.sync_read("Torque_Enable").values())


def test_an_emergency_stop_on_the_way_home_or_in_a_pause_counts_too(make):
    env = make()
    begin(env)
    robot, teleop = env.station.robot, env.station.person.teleop
    for _ in range(60):
        env.step(env.station.setup.home[None] + 20)
    teleop.press("emergency_stop")
    before = robot.desk.goal.copy()
    with pytest.raises(ConnectionError, match="Emergency"):
        env.station.go_home()
    assert np.array_equal(robot.desk.goal, before)
    assert not any(robot.bus.sync_read("Torque_Enable").values())
    env.scene_reset(ONE, np.array([5]))
    env.observe()
    teleop.press("emergency_stop")
    env.station.wait("", lambda events: events.stop)
    goal = robot.desk.goal.copy()
    assert env.step(env.station.target[None] + 5)[4]["diverged"][0]
    assert np.array_equal(robot.desk.goal, goal)
    env.scene_reset(ONE, np.array([5]))
    env.observe()
    assert [line["kind"] for line in ledger(env)].count("emergency_stop") == 2
    assert not hold(env, 1)[0]["diverged"][0]


def test_a_pause_is_waited_for_and_noted(make):
    env = make()
    begin(env)
    teleop, clock = env.station.person.teleop, env.station.clock
    teleop.press("pause")
    polls = iter([*[lambda: None] * 19, lambda: teleop.press("pause")])
    sleep = clock.sleep
    clock.sleep = lambda seconds: (next(polls)(), sleep(seconds))
    hold(env, 1)
    clock.sleep = sleep
    (line,) = [line for line in ledger(env) if line["kind"] == "pause"]
    # 20 looks, each of two control steps.
    assert line["seconds"] == pytest.approx(20 * 2 / FPS, abs=0.05)


def test_ctrl_c_moves_the_arm_home_at_once(make):
    env = make()
    begin(env)
    for _ in range(60):
        env.step(env.station.setup.home[None] + 20)
    before = signal.signal(signal.SIGINT, lambda number, frame: None)
    try:
        hold(env, 1)
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(Stopped, match="SIGINT"):
            hold(env, 1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert np.allclose(env.station.robot.desk.positions(), env.station.setup.home, atol=4)
    env.station._signal = None


def test_a_dry_run_moves_nothing_and_shows_what_it_would(make, capsys):
    env = make(camera_names=["front"], dry_run=True)
    begin(env)
    goal = env.station.robot.desk.goal.copy()
    for _ in range(FPS):
        env.step(env.station.setup.home[None] + 20)
    assert np.array_equal(env.station.robot.desk.goal, goal)
    assert "shoulder_pan.pos: wants 20.0, may 20.0, is " in capsys.readouterr().out
    assert (env.folder / "dry_run_front.png").is_file()


class LateClock:
    """Time that passes only by sleeping, and by what the test adds."""

    def __init__(self):
        self.now = 0.0

    def time(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_late_steps_are_counted_and_nothing_hurries_after_them(make):
    station: Station = make().station
    station.clock = clock = LateClock()
    station.begin()
    for extra in (0.0, 0.02, 0.1, 0.0):
        clock.now += extra
        station.act(station.target)
    # 0.02 s fit into a step of 0.033; after 0.1 s the next step has its whole time.
    assert station.late == 1
    assert clock.now == pytest.approx(2 / FPS + 0.1 + 1 / FPS, abs=1e-6)


def test_keys_of_a_terminal_are_events(monkeypatch):
    controller, terminal = pty.openpty()
    with os.fdopen(terminal, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        person = Person(None, LateClock())
        os.write(controller, b"s \nx")
        assert person.look() == Events(success=True, takes_over=True, done=True)
        assert person.look() == Events(takes_over=True)
        os.write(controller, b" f")
        assert person.look() == Events(failure=True)
        person.close()
    os.close(controller)


def test_nobody_beside_the_robot_is_an_error():
    with pytest.raises(ValueError, match="nobody"):
        Person(None, LateClock())


def test_a_person_judges_from_the_key_to_the_other_key():
    judge = PersonJudge()
    judge.begin(None)
    said = [judge.judge({}, Events(success=k == 1, failure=k == 3)) for k in range(5)]
    assert said == [False, True, True, False, False]
    judge.begin(None)
    assert not judge.judge({}, Events())


def test_the_truth_is_turned_around_in_a_share_of_the_segments():
    class World:
        def find_complete(self, tasks):
            return np.array([[tasks[0]]])

    judge = SimJudge(World(), 0.3, 10, np.random.default_rng(0))
    wrong = 0
    for segment in range(1000):
        truth = segment % 2 == 0
        judge.begin(truth)
        wrong += [judge.judge({}, Events()) for _ in range(10)][-1] != truth
    # 300 expected, standard deviation 14.
    assert 250 < wrong < 350


def test_buttons_of_a_teleoperator_judge(make):
    env = make(judge="person")
    begin(env)
    assert not hold(env, 1)[0]["is_success"][0]
    env.station.person.teleop.press(TeleopEvents.SUCCESS)
    _, reward, _, _, info = env.step(env.station.target[None])
    assert (reward.tolist(), info["is_success"].tolist()) == ([1.0], [True])
    assert ledger(env)[-1]["kind"] == "success"
    with pytest.raises(ValueError, match="num_envs=1"):
        CronosRobotConfig(robot=CronosSO101Config(id="other")).create_streams(2)
