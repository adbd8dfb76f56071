"""The folder of an evaluation: one process at a time, and what breaks in it is made again."""

import json

import numpy as np
import pytest
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.evaluation.chains import Trajectory
from cronos_lerobot.evaluation.config import CronosEvalConfig, SuitesConfig
from cronos_lerobot.evaluation.outcomes import read_outcomes
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.evaluation.store import ResultStore
from cronos_lerobot.locks import FolderInUseError

ENVIRONMENT = {"environment": "lerobot_env_cronos/kitchen_2x2-v1"}


class Idle:
    """An actor that stands still, the gripper open."""

    is_per_environment, temperature, drew = True, None, False

    def seed(self, seed):
        """Draws nothing."""

    def begin(self, ids):
        """Has no state."""

    def act(self, observation, instructions, uniform, ids):
        return np.tile(np.float32([0, 0, 0, 0, 0, 0, 1]), (len(ids), 1))


def begin(folder, make_actor=None):
    suites = SuitesConfig("independent", "train", n_episodes=1, batch_size=4, videos=0)
    config = CronosEvalConfig(CronosEnvConfig(obs_type="environment_state_agent_pos"), None, suites)
    config.expert, config.output_dir = True, folder
    return Evaluation(config, make_actor or (lambda env: Idle()))


def stop(*args):
    raise KeyboardInterrupt


def test_a_second_one_is_refused_and_takes_nothing_away(tmp_path):
    first = begin(tmp_path / "out")
    with pytest.raises(FolderInUseError, match="is being written by process"):
        begin(tmp_path / "out")
    assert (tmp_path / "out/evaluation.json").is_file()
    first.close()
    # A policy that cannot be loaded leaves the folder to another one.
    with begin(tmp_path / "out", stop_with_error) as failing, pytest.raises(ValueError, match="no memory"):
        failing.prepare()
    assert begin(tmp_path / "out").run()["independent"]["train"]["n"] == 4


def stop_with_error(env):
    raise ValueError("no memory")


def test_results_are_never_of_other_parts_than_lie_beside_them(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    begin(folder).run()
    part = folder / "parts/independent_train.json"
    content = json.loads(part.read_text())
    content["made_by"]["versions"]["mujoco"] = "0.1"
    part.write_text(json.dumps(content))
    with monkeypatch.context() as patch:
        patch.setattr(Evaluation, "_run_part", stop)
        with pytest.raises(KeyboardInterrupt):
            begin(folder).run()
    with pytest.raises(FileNotFoundError, match=r"no results\.json"):
        read_outcomes(folder)
    begin(folder).run()
    assert len(read_outcomes(folder).lengths) == 4


def test_a_damaged_part_is_made_again(tmp_path, caplog):
    begin(tmp_path / "out").run()
    part = tmp_path / "out/parts/independent_train.json"
    whole = json.loads(part.read_text())
    part.write_text(part.read_text()[:40])
    begin(tmp_path / "out").run()
    assert "part independent_train in " in caplog.text
    assert "is damaged" in caplog.text
    assert json.loads(part.read_text())["chains"] == whole["chains"]


@pytest.mark.parametrize("left", [b"", b"PK\3\4", None])
def test_states_that_cannot_be_read_are_none(tmp_path, left):
    store = ResultStore(tmp_path / "out", ENVIRONMENT)
    trajectory = Trajectory(np.zeros((2, 3)), np.zeros(2, int), np.zeros((2, 1), bool))
    store.write("a", {}, {"0_0": trajectory})
    assert store.has_trajectories("a")
    states = tmp_path / "out/parts/a.npz"
    if left is None:
        states.unlink()
    else:
        states.write_bytes(left)
    assert not store.has_trajectories("a")


def test_what_a_full_disk_has_left_of_the_first_file_takes_no_folder(tmp_path):
    (tmp_path / ".evaluation.json.partial").touch()
    (tmp_path / ".lock").touch()
    assert ResultStore(tmp_path, ENVIRONMENT).names() == []
    (tmp_path / "evaluation.json").unlink()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(FileExistsError, match="is not empty and not of an evaluation"):
        ResultStore(tmp_path, ENVIRONMENT)
