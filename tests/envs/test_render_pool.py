"""Drawing in processes of their own: the same frames, and nothing left behind."""

import os
import signal

import numpy as np
import pytest
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.simulation.render_pool import MIN_FRAMES, RenderPool
from lerobot_env_cronos.simulation.rendering import ClassicRenderer

SIZE = (48, 64)


@pytest.fixture(scope="module")
def simulation():
    env = CronosVectorEnv(2 * MIN_FRAMES, obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    return env.simulation


@pytest.fixture
def pool(simulation):
    model = simulation.render_model
    pool = RenderPool(model, *SIZE, model.camera("front").id, processes=2)
    yield pool
    pool.close()


def test_frames_are_those_of_one_process(simulation, pool):
    alone = ClassicRenderer(simulation.render_model, *SIZE, "front").render(simulation.qpos)
    assert len(np.unique(alone.reshape(-1, 3), axis=0)) > 50  # A picture, not an empty canvas.
    assert np.array_equal(pool.render(simulation.qpos), alone)
    assert np.array_equal(pool.render(simulation.qpos[3:]), alone[3:])


def test_what_is_broken_off_is_not_taken_for_what_comes_next(simulation, monkeypatch):
    """Ctrl-C between the request and the answer."""
    renderer = ClassicRenderer(simulation.render_model, *SIZE, "front", processes=2)
    if renderer._processes == 1:
        pytest.skip("drawn by a GPU, which needs no processes")
    states = [np.tile(simulation.qpos[i], (2 * MIN_FRAMES, 1)) for i in (0, 1)]
    expected = [renderer.render(qpos) for qpos in states]

    def interrupted(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(RenderPool, "_read", interrupted)
        with pytest.raises(KeyboardInterrupt):
            renderer.render(states[0])
    for _ in range(2):
        for qpos, frames in zip(states, expected, strict=True):
            assert np.array_equal(renderer.render(qpos), frames)
    renderer.close()


def test_a_picture_larger_than_the_models_buffer_is_whole(simulation):
    model = simulation.render_model
    model.vis.global_.offwidth, model.vis.global_.offheight = 64, 48
    small = ClassicRenderer(model, 48, 64, "front").render(simulation.qpos[:1])
    large = ClassicRenderer(model, 192, 256, "front").render(simulation.qpos[:1])
    blocks = large[0].reshape(48, 4, 64, 4, 3).mean((1, 3))
    # The same picture but for edges.
    assert np.median(np.abs(blocks - small[0])) < 3


def test_a_killed_process_is_an_error_and_not_a_wait(simulation, pool):
    os.kill(pool._processes[1].pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match=r"a rendering process ended \(-9\)"):
        pool.render(simulation.qpos)


def test_a_process_that_cannot_draw_says_why(simulation, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no such platform")
    model = simulation.render_model
    with pytest.raises(RuntimeError, match="no such platform"):
        RenderPool(model, *SIZE, model.camera("front").id, processes=1)
