"""Films of streams: as many frames as control steps, resets where they belong, files that play."""

import os
import re
import sys
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from dummies import DummyEnv, identity_processors
from forked_commands import run_forked
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.scene.scenes import SCENES
from PIL import Image
from tiny_checkpoints import STATE, TINY_ACT, TOLD, save_policy

from cronos_lerobot.agents.adapters.registry import make_steerable
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.steering.steered import STEERING, SteeredPolicy, SteeringShape
from cronos_lerobot.evaluation.actors import ExpertActor, SelectingPolicy, Spectator
from cronos_lerobot.film import stream_video
from cronos_lerobot.film.encode import write_gif, write_mp4
from cronos_lerobot.film.overlay import FAILURE, SUCCESS, Status, draw_status
from cronos_lerobot.film.sheets import draw_task_sheet
from cronos_lerobot.film.stream_video import film_stream, open_stream
from cronos_lerobot.film.task_pictures import render_tasks
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.task_orders import TaskSet, make_task_order
from cronos_lerobot.training.seeding import NamedGenerators


@pytest.fixture(scope="module")
def film():
    """Three segments of 20 steps with a scene reset after the second, and what the overlay was told."""
    told = []

    def remember(frame, status):
        told.append((status.segment, status.instruction, status.interventions, status.notice))
        return draw_status(frame, status)

    env = CronosVectorEnv(1, obs_type="environment_state_agent_pos", render_size=(120, 160))
    protocol = ProtocolConfig(task_switch_interval=20, update_interval=20, scene_reset_interval=40)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream_video, "draw_status", remember)
        frames = list(film_stream(env, Spectator(ExpertActor(env), 1), protocol, num_segments=3))
    env.close()
    return frames, told


def test_a_policy_that_reads_no_instruction_is_told_the_task_in_its_state(tmp_path):
    env, agent = open_stream(str(save_policy(tmp_path, "act", TOLD, **TINY_ACT)))
    protocol = ProtocolConfig(task_switch_interval=6, update_interval=6, scene_reset_interval=None)
    frames = list(film_stream(env, agent, protocol, num_segments=2))
    env.close()
    assert [frame.shape for frame in frames] == [(480, 640, 3)] * 12


class Planner(torch.nn.Module):
    """Plans to do the number of the plan three times."""

    config = SimpleNamespace(type="planner", use_amp=False)
    plans = 0

    def reset(self):
        pass

    def predict_action_chunk(self, batch):
        self.plans += 1
        return torch.full((len(batch["task"]), 3, 7), float(self.plans))


def test_a_plan_ends_where_its_stream_is_cut_and_nowhere_else():
    """Three streams, of which the last one diverges in its second step; a segment ends after five."""
    env = DummyEnv(3, diverge_at={(1, 2)})
    agent = Spectator(SelectingPolicy(Planner(), PolicyProcessors(*identity_processors()), (dict, dict)), 3)
    protocol = ProtocolConfig(task_switch_interval=5, update_interval=5, scene_reset_interval=None)
    rng = NamedGenerators(0).for_numpy
    tasks = TaskSet.of(env.scene, protocol)
    order = make_task_order("heuristic", rng("task_order"), tasks)
    loop, resets = tasks.new_loop(3), make_resets(protocol, rng)
    events = rf_mtrl(env, tasks.all, agent, order, resets, protocol, loop, total_steps=3 * 7)
    played = [event.action.action[:, 0].tolist() for event in events if isinstance(event, Step)]
    # The third plan is that of the two that go on, made when theirs are played; the fourth that of the new task.
    assert np.transpose(played[:7]).tolist() == [
        [1, 1, 1, 3, 3, 4, 4],
        [1, 1, 1, 3, 3, 4, 4],
        [1, 1, 2, 2, 2, 4, 4],
    ]


def test_a_steered_checkpoint_is_played_steered(tmp_path):
    options = {"hidden_width": 16, "hidden_depth": 1, "flow_width": 16, "flow_depth": 1}
    save_policy(tmp_path, "pocketvla", STATE, head="flow", chunk_size=4, n_action_steps=2, **options)
    policy = get_policy_class("pocketvla").from_pretrained(tmp_path)
    steerable = make_steerable(policy)
    env = CronosVectorEnv(1, **STATE)
    observation, instructions = env.observe(), env.instructions
    env.close()
    columns = {"observation.state": "agent_pos", "observation.environment_state": "environment_state"}
    raw = {name: torch.from_numpy(observation[key]).float() for name, key in columns.items()}
    before, after = make_pre_post_processors(policy.config, str(tmp_path))
    batch = before(raw | {"task": instructions})
    shape = SteeringShape(steerable.observe(batch)[1].shape[1], "policy", 1.5, True, 8)
    steered = SteeredPolicy(steerable, shape)
    with torch.no_grad():
        # Whatever it sees, it chooses the greatest noise: tanh(20) = 1, with a deviation of e^-5 before tanh.
        steered.actor.head.bias[:7], steered.actor.head.bias[7:] = 20.0, -5.0
        expected = after(policy.predict_action_chunk(batch, noise=torch.full((1, 4, 7), 1.5)).flatten(0, 1))
    assert not plays(tmp_path, observation, instructions, expected)
    steered.save_pretrained(tmp_path)
    assert (tmp_path / STEERING).is_file()
    assert plays(tmp_path, observation, instructions, expected)


def plays(folder, observation, instructions, expected):
    """Whether a checkpoint plays the first two steps of `expected`, a chunk of four, (4, 7)."""
    env, agent = open_stream(str(folder), seed=3)
    env.close()
    first = agent.act(observation, instructions).action
    agent.store(None, [], None, None, None, np.zeros(1, bool), None)
    played = np.concatenate([first, agent.act(observation, instructions).action])
    return np.allclose(played, expected[:2], rtol=0, atol=1e-5)


def test_one_frame_for_each_control_step(film):
    frames, told = film
    assert len(frames) == len(told) == 60
    assert {(frame.shape, frame.dtype) for frame in frames} == {((120, 160, 3), np.dtype("uint8"))}
    assert not np.array_equal(frames[0], frames[10])


def test_overlay_follows_the_protocol(film):
    _, told = film
    tasks = [task.instruction for task in SCENES["kitchen_2x2"].tasks]
    assert [entry[:3] for entry in told[::20]] == [(0, tasks[0], 0), (1, tasks[1], 0), (2, tasks[2], 1)]
    notices = [Intervention.INITIAL, Intervention.END_EFFECTOR_RESET, Intervention.SCENE_RESET]
    assert [entry[3] for entry in told[::20]] == notices
    assert (told[7][3], told[8][3]) == (Intervention.INITIAL, Intervention.NONE)


def test_overlay_shows_outcomes():
    status = Status("put the cloth away", 2, 3, succeeded=False, interventions=0, outcomes=[True, False])
    drawn = draw_status(np.zeros((480, 640, 3), np.uint8), status)
    bottom = {tuple(int(c) for c in color) for color in drawn[460, 560:]}
    assert {SUCCESS, FAILURE} <= bottom
    assert SUCCESS not in {tuple(int(c) for c in color) for color in drawn[20, 560:]}


def test_mp4_plays_every_frame(film, tmp_path):
    frames, _ = film
    with pytest.raises(ValueError, match="frames must be uint8"):
        write_mp4(tmp_path / "a/stream.mp4", [frame.astype(float) for frame in frames], fps=20)
    assert not (tmp_path / "a/stream.mp4").exists()
    write_mp4(tmp_path / "a/stream.mp4", frames, fps=20)
    with av.open(str(tmp_path / "a/stream.mp4")) as container:
        decoded = list(container.decode(video=0))
        assert container.streams.video[0].average_rate == 20
    assert len(decoded) == 60
    error = np.abs(decoded[30].to_ndarray(format="rgb24").astype(int) - frames[30])
    assert error.mean() < 6


def test_gif_keeps_to_its_size(film, tmp_path):
    frames, _ = film
    full = write_gif(tmp_path / "full.gif", frames)
    small = write_gif(tmp_path / "small.gif", frames, max_bytes=full // 2)
    assert small <= full // 2
    with Image.open(tmp_path / "full.gif") as gif:
        assert gif.size == (320, 240)
        duration = 0
        for number in range(gif.n_frames):
            gif.seek(number)
            duration += gif.info["duration"]
    # Every second of 60 steps, at 10 frames/s.
    assert duration == 3000


@pytest.mark.parametrize(
    ("flag", "said"), [("--segments=0", "--segments"), ("--fps=20", "model.safetensors .* is damaged")]
)
def test_wrong_flags_and_damaged_weights_are_one_line(flag, said, tmp_path, monkeypatch, capsys):
    checkpoint = save_policy(tmp_path / "policy", "act", TOLD, **TINY_ACT)
    weights = checkpoint / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    arguments = [f"--policy.path={checkpoint}", flag, f"--output={tmp_path / 'stream.mp4'}"]
    monkeypatch.setattr("sys.argv", ["stream_video", *arguments])
    with pytest.raises(SystemExit, match="2"):
        stream_video.main()
    assert re.search(f"error: .*{said}", capsys.readouterr().err.splitlines()[-1])


OWN_MODULE = """
from lerobot_env_cronos import Body, Scene, register_scene
from cronos_lerobot.protocol.task_orders import TASK_ORDERS

register_scene(
    Scene("one_task", objects=("block of ones own",), receptacles=("coaster of ones own",)),
    bodies=[
        Body("block of ones own", (0.030, 0.060, 0.020), 600, "box", colour=(0.85, 0.30, 0.35)),
        Body("coaster of ones own", (0.100, 0.100, 0.005), 900, "disc", colour=(0.10, 0.30, 0.80)),
    ],
)
TASK_ORDERS["of_ones_own"] = TASK_ORDERS["heuristic"]
"""


def test_a_scene_and_an_order_of_ones_own_are_filmed(tmp_path):
    (tmp_path / "own_module.py").write_text(OWN_MODULE)
    command = [sys.executable, "-m", "cronos_lerobot.film.stream_video", "--policy=expert", "--segments=1"]
    command += ["--scene=one_task", "--task_order=of_ones_own", f"--output={tmp_path / 'stream.mp4'}"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = run_forked([*command, "--discover_packages_path=own_module"], env=environment)
    assert (done.returncode, "80 frames" in done.stdout) == (0, True), done.stderr
    done = run_forked([*command, "--discover_packages_path=no_module"], env=environment)
    assert done.returncode == 2
    assert done.stderr.endswith("error: No module named 'no_module'\n")


def test_sheet_has_every_task_from_both_cameras():
    pictures = render_tasks("kitchen_2x2")
    assert [instruction for instruction, _ in pictures] == [t.instruction for t in SCENES["kitchen_2x2"].tasks]
    frames = [frame for _, cameras in pictures for frame in cameras]
    assert len(frames) == 8
    assert len({frame.tobytes() for frame in frames}) == 8
    assert draw_task_sheet(pictures).size == (2 * 654 + 14, 2 * 288 + 14)
