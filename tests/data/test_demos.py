import logging

import numpy as np
import pytest
from collected_demos import Spy, collect, command, episodes_of, home_position
from datasets import load_dataset
from lerobot.datasets import LeRobotDataset
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.expert.reach import find_reach
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX

from cronos_lerobot.data.demos import DemoCollector, DemoConfig, StartConfig
from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.perturbations import ActionNoise, MissConfig, NoiseConfig
from cronos_lerobot.data.schema import demonstration_features
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.scripts.record_demos import record_demos

NUM_ENVS = 4


@pytest.fixture(scope="module")
def env():
    return CronosVectorEnv(NUM_ENVS, obs_type="environment_state_agent_pos")


def test_successful_episodes_of_every_task_in_balance(env, tmp_path):
    dataset, collector = collect(env, tmp_path / "d", DemoConfig(steps_after_release=2), 8)
    assert dataset.num_episodes == collector.successes == 8
    tasks = [task for tasks in dataset.meta.episodes["tasks"] for task in tasks]
    assert {task: tasks.count(task) for task in tasks} == {task.instruction: 2 for task in env.scene.tasks}
    for episode in episodes_of(dataset):
        assert episode["next.success"][-3:].all()
        assert not episode["next.success"][0]
        assert episode["next.done"].tolist() == [False] * (len(episode["index"]) - 1) + [True]
        assert not episode["next.truncated"].any()
        assert episode["next.reward"].sum() == pytest.approx(1.0)  # "difference": the level reached


def test_a_resumed_dataset_begins_with_the_next_configurations(env, tmp_path):
    collect(env, tmp_path / "d", DemoConfig(), 6)
    features = demonstration_features(env)
    with SegmentWriter("me/demos", tmp_path / "d", features, 5, resume=-1) as writer:
        DemoCollector(env, ScriptedExpert(env), writer, DemoConfig()).collect(6)
    episodes = LeRobotDataset("me/demos", root=tmp_path / "d").meta.episodes
    begun = [(tasks[0], number) for tasks, number in zip(episodes["tasks"], episodes["cronos.configuration"])]
    assert sorted(begun) == sorted((task.instruction, number) for task in env.scene.tasks for number in range(3))


def test_starts_at_home_in_training_configurations(env, tmp_path):
    config = DemoConfig(start=StartConfig(num_configurations=1))
    dataset, _ = collect(env, tmp_path / "d", config, 8)
    home = home_position(env)
    for episode in episodes_of(dataset):
        np.testing.assert_allclose(episode["observation.state"][0, :3], home, atol=2e-3)
    assert dataset.meta.episodes["cronos.configuration"] == [0] * 8


def test_same_seed_same_demonstrations(env, tmp_path):
    config = DemoConfig(noise=NoiseConfig(share=0.5), start=StartConfig(layouts="random"))
    first, second, other = (
        collect(env, tmp_path / name, config, seed=seed)[0].hf_dataset.with_format("numpy")[:]
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    for key in first:
        np.testing.assert_array_equal(first[key], second[key])
    assert not np.array_equal(first["observation.state"][:4], other["observation.state"][:4])


def test_noise_is_executed_but_not_recorded(env, tmp_path, monkeypatch):
    spy = Spy(env, monkeypatch)
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(noise=NoiseConfig(share=1.0, rate=0.5)), expert=spy)
    labels, executed = np.stack(spy.labels), np.stack(spy.executed)
    assert (np.abs(labels - executed)[..., :6].max(axis=-1) > 1e-4).mean() > 0.2
    # Every recorded frame is a state that the expert saw, beside what it wanted to do there.
    known = {(a.tobytes(), s.tobytes()) for a, s in zip(labels.reshape(-1, 7), np.concatenate(spy.seen))}
    rows = dataset.hf_dataset.with_format("numpy")[:]
    assert all((a.tobytes(), s.tobytes()) in known for a, s in zip(rows["action"], rows["observation.state"]))


def test_without_perturbed_frames_what_is_recorded_was_executed(env, tmp_path, monkeypatch):
    spy = Spy(env, monkeypatch)
    config = DemoConfig(
        record_perturbed=False, noise=NoiseConfig(share=0.5, rate=0.1), misses=MissConfig(share=0.5)
    )
    dataset, _ = collect(env, tmp_path / "d", config, 8, expert=spy)
    labels, executed = np.stack(spy.labels), np.stack(spy.executed)
    perturbed = (labels != executed).any(-1)
    assert perturbed.any()
    # Every recorded frame is one that was not perturbed, and all of an episode follow one another.
    frames = np.concatenate([np.stack(spy.seen), labels], -1)
    when = {frames[at].tobytes(): at for at in np.ndindex(frames.shape[:2])}
    for episode in episodes_of(dataset):
        rows = np.concatenate([episode["observation.state"], episode["action"]], -1)
        # The first may be the pose at home, which all streams have.
        steps, streams = zip(*(when[row.tobytes()] for row in rows[1:]), strict=True)
        assert len(set(streams)) == 1
        assert np.diff(steps).tolist() == [1] * (len(steps) - 1)
        assert not perturbed[list(steps), streams[0]].any()
        assert episode["next.done"].tolist() == [False] * len(steps) + [True]


def test_noise_leaves_the_gripper_and_the_bounds_alone():
    noise = ActionNoise(NoiseConfig(share=1.0, rate=1.0, scale=5.0), 2, WIDOWX)
    for stream in range(2):
        noise.reset(stream, np.random.default_rng(stream))
    actions = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (2, 1))
    noisy = noise.apply(actions, np.array([True, False]))
    assert (noisy[0, :6] != 0).all()
    assert (np.abs(noisy[0, :6]) <= 0.21).all()
    assert noisy[:, 6].tolist() == [1, 1]
    np.testing.assert_array_equal(noisy[1], actions[1])


def test_a_miss_closes_beside_the_object_and_shows_the_recovery(env, tmp_path, monkeypatch):
    spy = Spy(env, monkeypatch)
    dataset, collector = collect(env, tmp_path / "d", DemoConfig(misses=MissConfig(share=1.0)), expert=spy)
    assert collector.successes == 4
    labels, executed = np.stack(spy.labels), np.stack(spy.executed)
    # Closed on purpose where the expert would keep the gripper open: that is never what is recorded.
    assert ((executed[..., 6] < 0.5) & (labels[..., 6] > 0.5)).sum() >= 4
    for episode in episodes_of(dataset):
        opening, command = episode["observation.state"][:, 9], episode["action"][:, 6]
        recovers = (opening < 0.5) & (command > 0.5) & ~episode["next.success"]
        assert recovers.any()


def test_a_miss_of_another_arm_closes_beside_the_object_and_shows_the_recovery(tmp_path):
    env = CronosVectorEnv(2, "so101_desk_2x2", obs_type="environment_state_agent_pos")
    dataset, collector = collect(env, tmp_path / "d", DemoConfig(misses=MissConfig(share=1.0, min_offset_m=0.04)))
    assert collector.successes == 4
    for episode in episodes_of(dataset):
        gripper, command = episode["observation.state"][:, 5], episode["action"][:, 5]
        # Shut further than on any object, and told to open: the expert finds nothing between the jaws.
        assert ((gripper < 5) & (command > 20) & ~episode["next.success"]).any()


@pytest.mark.parametrize("arm_pose", ["random", "after_task"])
def test_starts_elsewhere(env, tmp_path, arm_pose):
    start = StartConfig(arm_pose=arm_pose, layouts="random")
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(start=start))
    starts = np.stack([episode["observation.state"][0, :3] for episode in episodes_of(dataset)])
    assert (np.linalg.norm(starts - home_position(env), axis=1) > 0.02).all()
    assert np.linalg.norm(starts[0] - starts[1]) > 0.02
    assert dataset.meta.episodes["cronos.configuration"] == [-1] * 4


def test_the_arm_is_at_home_in_some_episodes_and_elsewhere_in_others(env, tmp_path):
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(start=StartConfig(arm_pose="either")), 8)
    starts = np.stack([episode["observation.state"][0, :3] for episode in episodes_of(dataset)])
    at_home = np.abs(starts - home_position(env)).max(axis=1) < 0.01
    assert 0 < at_home.sum() < 8


def test_occupied_receptacles_hold_the_other_object(env, tmp_path):
    start = StartConfig(occupied_receptacles=True)
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(start=start))
    bodies = env.scene.bodies
    home = home_position(env)
    for episode, (task,) in zip(episodes_of(dataset), dataset.meta.episodes["tasks"], strict=True):
        (task,) = [t for t in env.scene.tasks if t.instruction == task]
        (other,) = [name for name in env.scene.objects if name != task.object]
        state = episode["observation.environment_state"][0].reshape(len(bodies), -1)
        distance = state[bodies.index(other), :2] - state[bodies.index(task.receptacle), :2]
        assert np.linalg.norm(distance) < 0.07
        np.testing.assert_allclose(episode["observation.state"][0, :3], home, atol=2e-3)


def test_starts_after_several_tasks_have_all_objects_on_receptacles(env, tmp_path):
    start = StartConfig(misplaced_objects=True, occupied_receptacles=True, earlier_tasks=3)
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(start=start), 12)
    bodies, on_receptacles, on_one = env.scene.bodies, 0, 0
    for episode, (task,) in zip(episodes_of(dataset), dataset.meta.episodes["tasks"], strict=True):
        (task,) = [t for t in env.scene.tasks if t.instruction == task]
        xy = episode["observation.environment_state"][0].reshape(len(bodies), -1)[:, :2]
        objects, places = (
            np.array([xy[bodies.index(name)] for name in names])
            for names in (env.scene.objects, env.scene.receptacles)
        )
        near = np.linalg.norm(objects[:, None] - places, axis=-1) < 0.07
        assert not near[env.scene.objects.index(task.object), env.scene.receptacles.index(task.receptacle)]
        assert near.any()
        on_receptacles += near.any(axis=1).all()
        on_one += near.all(axis=0).any()
        assert episode["next.success"][-1]
    # Never after one task alone.
    assert on_receptacles > on_one > 0


def test_layouts_over_the_reach(env, tmp_path):
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(start=StartConfig(layouts="reach")), 8)
    assert dataset.meta.episodes["cronos.configuration"] == [-1] * 8
    first = np.stack([episode["observation.environment_state"][0] for episode in episodes_of(dataset)])
    xy = first.reshape(8, len(env.scene.bodies), -1)[..., :2].reshape(-1, 2)
    assert find_reach(env.scene).contains(xy).all()
    assert ((xy < env.scene.spawn_low) | (xy > env.scene.spawn_high)).any(axis=1).sum() >= 8  # of 32 bodies


def test_reset_tasks_begin_with_the_object_on_a_receptacle(env, tmp_path):
    dataset, _ = collect(env, tmp_path / "d", DemoConfig(reset_tasks=True, steps_after_release=2), 6)
    tasks = [task for tasks in dataset.meta.episodes["tasks"] for task in tasks]
    assert sorted(tasks) == sorted(task.instruction for task in env.scene.tasks + env.scene.reset_tasks)
    home, bodies = home_position(env), env.scene.bodies
    for episode, task in zip(episodes_of(dataset), tasks, strict=True):
        resets = [reset for reset in env.scene.reset_tasks if reset.instruction == task]
        if resets:
            state = episode["observation.environment_state"][0].reshape(len(bodies), -1)
            at = state[bodies.index(resets[0].object), :2]
            receptacles = state[[bodies.index(name) for name in env.scene.receptacles], :2]
            assert np.linalg.norm(receptacles - at, axis=1).min() < 0.07
            assert not episode["next.success"][0]
            assert episode["next.success"][-3:].all()
            np.testing.assert_allclose(episode["observation.state"][0, :3], home, atol=2e-3)


def test_what_is_complete_from_the_start_is_nothing_to_show(env, tmp_path, monkeypatch):
    """Without a look at the start these would be demonstrations of standing still."""
    step, found = env.step, []

    def complete_at_first(actions):
        *result, info = step(actions)
        if not found:
            found.append(True)
            info["is_success"] = np.ones(NUM_ENVS, bool)
        return *result, info

    monkeypatch.setattr(env, "step", complete_at_first)
    dataset, collector = collect(env, tmp_path / "d", DemoConfig())
    assert dataset.num_episodes == collector.finished == collector.successes == 4
    assert not any(episode["next.success"][0] for episode in episodes_of(dataset))


def test_failures_are_dropped_unless_asked_for(env, tmp_path):
    """An expert that does nothing fails every episode."""

    class Idle:
        def reset(self, ids):
            pass

        def act(self):
            return np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0]), (NUM_ENVS, 1))

    dataset, collector = collect(
        env, tmp_path / "d", DemoConfig(max_steps=3, keep_failures=True), 4, expert=Idle()
    )
    assert dataset.meta.episodes["length"] == [3] * 4
    rows = dataset.hf_dataset.with_format("numpy")[:]
    assert rows["next.truncated"].tolist() == [False, False, True] * 4
    assert not rows["next.done"].any()
    assert (collector.successes, collector.finished) == (0, 4)
    with pytest.raises(RuntimeError, match="failed 200 times in a row"):
        collect(env, tmp_path / "e", DemoConfig(max_steps=1), 1, expert=Idle())


def test_the_row_of_a_failure_says_whether_its_task_was_ever_complete(env, tmp_path, monkeypatch):
    """Of four steps the task is complete after the second, in two streams."""
    step, steps = env.step, []

    def lose(actions):
        steps.append(step(actions))
        # The first step of an episode is at rest, and not recorded.
        steps[-1][4]["is_success"] = np.array([len(steps) == 3] * 2 + [False] * 2)
        return steps[-1]

    monkeypatch.setattr(env, "step", lose)
    config = DemoConfig(max_steps=4, steps_after_release=9, keep_failures=True)
    dataset, collector = collect(env, tmp_path / "d", config, 4)
    assert collector.successes == 0
    rows = dataset.meta.episodes["next.success"]
    assert rows == [episode["next.success"].any() for episode in episodes_of(dataset)]
    assert sum(rows) == 2


def test_the_command_records_resumes_and_overwrites(tmp_path, caplog):
    root = tmp_path / "d"
    record_demos(command(root, 2))
    with pytest.raises(FileExistsError, match="--resume=true"):
        record_demos(command(root, 3))
    with caplog.at_level(logging.INFO):
        record_demos(command(root, 3, resume=True))
    assert "3 episodes" in caplog.text
    dataset = LeRobotDataset("me/demos", root=root)
    assert dataset.num_episodes == 3
    assert dataset[0]["observation.images.front"].shape == (3, 64, 64)
    assert (dataset.meta.fps, dataset.meta.robot_type) == (5, "widowx")
    # What cannot be recorded deletes nothing.
    odd = command(root, 1, overwrite=True)
    odd.env = CronosEnvConfig(observation_height=65, observation_width=64)
    with pytest.raises(ValueError, match="65"):
        record_demos(odd)
    assert LeRobotDataset("me/demos", root=root).num_episodes == 3
    record_demos(command(root, 1, overwrite=True))
    assert LeRobotDataset("me/demos", root=root).num_episodes == 1
    record_demos(command(root, 2, resume=True))
    assert LeRobotDataset("me/demos", root=root).num_episodes == 2
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.tex").write_text("...")
    with pytest.raises(FileExistsError, match="is not a LeRobotDataset"):
        record_demos(command(tmp_path / "precious", 1, overwrite=True))


def test_demonstrations_stored_as_images(tmp_path):
    root = tmp_path / "d"
    record_demos(command(root, 2, video=False))
    record_demos(command(root, 3, resume=True, video=False))
    dataset = LeRobotDataset("me/demos", root=root)
    assert (dataset.num_episodes, dataset.meta.image_keys) == (3, ["observation.images.front"])
    assert len(load_dataset(str(root), split="train")) == len(dataset)
    assert check_dataset(root).kind == "demonstrations"
