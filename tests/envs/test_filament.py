"""MuJoCo's physically based renderer, where this machine has Vulkan, and what is said where it has not."""

import os
import subprocess
import sys

import numpy as np
import pytest
from forked_commands import run_forked
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.simulation import filament

needs_vulkan = pytest.mark.skipif(
    sys.platform == "linux" and not filament.count_vulkan_devices(),
    reason="no Vulkan (apt-get install mesa-vulkan-drivers)",
)
DRAW = """
import numpy as np
from lerobot_env_cronos import CronosVectorEnv
env = CronosVectorEnv(2, renderer="filament")
np.save({path!r}, env.observe()["pixels"]["front"])
"""


def centre_of_yellow(frame):
    """Column and row of the middle of the yellow plate."""
    red, green, blue = frame.astype(float).transpose(2, 0, 1)
    rows, columns = np.nonzero((red > 2.5 * blue) & (green > 2 * blue) & (red > 100))
    return columns.mean(), rows.mean()


@needs_vulkan
def test_both_renderers_show_the_same_scene_from_the_same_place():
    pictures = {}
    for renderer in ("classic", "filament"):
        env = CronosVectorEnv(3, camera_name="front,bridge", renderer=renderer)
        env.scene_reset(np.arange(3), np.array([3, 9, 20]))
        pictures[renderer] = env.observe()["pixels"]
        env.close()
    for camera in ("front", "bridge"):
        for plain, real in zip(pictures["classic"][camera], pictures["filament"][camera], strict=True):
            np.testing.assert_allclose(centre_of_yellow(real), centre_of_yellow(plain), atol=4.0)
            # Shadows and tones: it is another picture.
            assert np.abs(plain.astype(int) - real).mean() > 5


@needs_vulkan
def test_a_process_that_used_it_ends_cleanly_and_another_draws_the_same(tmp_path):
    """Up to the few values at edges that depend on how the renderer's threads fell."""
    path = tmp_path / "frames.npy"
    result = subprocess.run([sys.executable, "-c", DRAW.format(path=str(path))], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    env = CronosVectorEnv(2, renderer="filament")
    frames = np.load(path), env.observe()["pixels"]["front"]
    env.close()
    assert frames[0].shape == (2, 64, 64, 3)
    assert (frames[0] != frames[1]).mean() < 1e-3


def test_without_vulkan_the_error_names_the_package(monkeypatch):
    monkeypatch.setattr(filament, "count_vulkan_devices", lambda: 0)
    monkeypatch.setattr(sys, "platform", "linux")
    env = CronosVectorEnv(2, renderer="filament")
    with pytest.raises(RuntimeError, match=r"mesa-vulkan-drivers.*--env\.renderer=classic"):
        env.observe()


def test_without_a_driver_there_are_no_devices():
    nothing = {"VK_ICD_FILENAMES": "/nonexistent.json", "VK_DRIVER_FILES": "/nonexistent.json"}
    code = "from lerobot_env_cronos.simulation.filament import count_vulkan_devices; print(count_vulkan_devices())"
    assert run_forked([sys.executable, "-c", code], env=os.environ | nothing).stdout == "0\n"
