"""Films of streams: as many frames as control steps, resets where they belong, files that play."""

import av
import numpy as np
import pytest
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_env_cronos.scene.scenes import SCENES
from PIL import Image

from cronos_lerobot.film.encode import write_gif, write_mp4
from cronos_lerobot.film.overlay import FAILURE, SUCCESS, Status, draw_status
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.report import stream_video
from cronos_lerobot.report.stream_video import ExpertSpectator, film_stream, make_spectator
from cronos_lerobot.report.task_pictures import draw_sheet, render_tasks


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
        frames = list(film_stream(env, ExpertSpectator(env), protocol, num_segments=3))
    env.close()
    return frames, told


def test_a_policy_acts_in_the_scene_of_its_training_and_sees_what_it_knows(tmp_path):
    register_third_party_plugins()
    options = {"camera_name": "bridge", "observation_height": 32, "observation_width": 48}
    config = make_policy_config("pocketvla", device="cpu", push_to_hub=False, observation="image")
    make_policy(config, env_cfg=CronosEnvConfig(**options)).save_pretrained(tmp_path)
    for processor in make_pre_post_processors(config):
        processor.save_pretrained(tmp_path)
    (tmp_path / "train_config.json").write_text('{"env": {"scene": "playroom_2x2"}}')
    env_config, _ = make_spectator(str(tmp_path))
    assert {name: getattr(env_config, name) for name in options} == options
    assert (env_config.scene, env_config.obs_type) == ("playroom_2x2", "pixels_agent_pos")
    assert make_spectator(str(tmp_path), scene="kitchen_3x3")[0].scene == "kitchen_3x3"


def test_one_frame_for_each_control_step(film):
    frames, told = film
    assert len(frames) == len(told) == 60
    assert {(frame.shape, frame.dtype) for frame in frames} == {((120, 160, 3), np.dtype("uint8"))}
    assert not np.array_equal(frames[0], frames[10])


def test_overlay_follows_the_protocol(film):
    _, told = film
    tasks = [task.instruction for task in SCENES["kitchen_2x2"].tasks]
    assert [entry[:3] for entry in told[::20]] == [(0, tasks[0], 0), (1, tasks[1], 0), (2, tasks[2], 1)]
    assert [entry[3] for entry in told[::20]] == [
        Intervention.INITIAL,
        Intervention.END_EFFECTOR_RESET,
        Intervention.SCENE_RESET,
    ]
    assert told[7][3] == Intervention.INITIAL
    assert told[8][3] == Intervention.NONE


def test_overlay_shows_outcomes():
    status = Status("put the cloth away", 2, 3, succeeded=False, interventions=0, outcomes=[True, False])
    drawn = draw_status(np.zeros((480, 640, 3), np.uint8), status)
    bottom = {tuple(int(c) for c in color) for color in drawn[460, 560:]}
    assert {SUCCESS, FAILURE} <= bottom
    assert SUCCESS not in {tuple(int(c) for c in color) for color in drawn[20, 560:]}


def test_mp4_plays_every_frame(film, tmp_path):
    frames, _ = film
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


def test_sheet_has_every_task_from_both_cameras():
    pictures = render_tasks("kitchen_2x2")
    assert [instruction for instruction, _ in pictures] == [t.instruction for t in SCENES["kitchen_2x2"].tasks]
    frames = [frame for _, cameras in pictures for frame in cameras]
    assert len(frames) == 8
    assert len({frame.tobytes() for frame in frames}) == 8
    sheet = draw_sheet(pictures)
    assert sheet.size == (2 * 654 + 14, 2 * 288 + 14)
