"""The wheels build, and work in an empty environment outside the checkout."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WHEELS = ("cronos_lerobot", "lerobot_env_cronos", "lerobot_policy_openvla", "lerobot_policy_pocketvla")

USE_THEM = """
import sys
from importlib.metadata import entry_points
import numpy as np
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
assert "cronos" in EnvConfig.get_known_choices()
assert get_policy_class("pocketvla").__name__ == "PocketVLAPolicy"
assert get_policy_class("openvla").__name__ == "OpenVLAPolicy"
from lerobot_env_cronos import CronosVectorEnv
env = CronosVectorEnv(2, obs_type="environment_state_agent_pos")
env.reset(seed=0)
env.step(np.zeros((2, 7)))
import cronos_lerobot, cronos_lerobot.scripts.train
from cronos_lerobot.hub.cards import PACKAGED
assert (PACKAGED / "policy.md").is_file()
print(cronos_lerobot.__file__)
sys.argv = ["cronos-train", "--help"]
(script,) = entry_points(group="console_scripts", name="cronos-train")
script.load()()
"""


def find_uv() -> str:
    """The uv of the Makefile, or the one on the PATH."""
    local = ROOT / ".uv/bin/uv"
    found = str(local) if local.is_file() else shutil.which("uv")
    assert found, "uv is needed to build wheels; `make setup` installs it"
    return found


@pytest.fixture(scope="module")
def wheels(tmp_path_factory) -> Path:
    dist = tmp_path_factory.mktemp("dist")
    subprocess.run([find_uv(), "build", "--all-packages", "--wheel", "-q", "-o", dist], cwd=ROOT, check=True)
    return dist


def test_every_distribution_has_a_wheel(wheels):
    names = sorted(path.name.split("-")[0] for path in wheels.glob("*.whl"))
    assert names == sorted(WHEELS)


def test_wheels_work_in_an_empty_environment(wheels, tmp_path):
    uv = find_uv()
    locked = subprocess.run(
        [uv, "export", "--frozen", "--no-emit-workspace", "--no-dev", "--no-hashes", "-q",
         "--extra=openvla"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    (tmp_path / "locked.txt").write_text(locked)
    python = tmp_path / "venv/bin/python"
    subprocess.run([uv, "venv", "-q", "--python", sys.executable, tmp_path / "venv"], check=True)
    install = [uv, "pip", "install", "-q", "--python", python, "-c", tmp_path / "locked.txt"]
    subprocess.run([*install, *sorted(wheels.glob("*.whl"))], check=True)
    result = subprocess.run([python, "-c", USE_THEM], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert str(tmp_path) in result.stdout
    assert "--protocol.scene_reset_interval" in result.stdout
    assert (tmp_path / "venv/bin/cronos-train").is_file()
