"""The plugins in examples/ run, and do what they say."""

import json
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from forked_commands import run_forked

from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.protocol import LoopState

EXAMPLES = Path(__file__).parents[2] / "examples"
TINY = (
    "--policy.type=pocketvla", "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1",
    "--env.obs_type=environment_state_agent_pos", "--env.num_threads=1", "--num_envs=2", "--seed=1",
    "--protocol.task_switch_interval=4", "--protocol.update_interval=8", "--eval_freq=0", "--tensorboard=false",
)  # fmt: skip


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    return import_module


def run(folder, *flags):
    """Run cronos-train as the docstrings say; returns the updates of metrics.jsonl."""
    command = (
        f"import sys; sys.path.insert(0, {str(EXAMPLES)!r}); sys.argv = ['cronos-train', *sys.argv[1:]];"
        "from cronos_lerobot.scripts.train import main; main()"
    )
    run_forked([sys.executable, "-c", command, *TINY, f"--output_dir={folder}", *flags], check=True)
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [record for record in records if record["kind"] == "update"]


def test_an_order_by_values_and_resets_that_are_asked_for_run_together(tmp_path):
    updates = run(
        tmp_path / "run", "--env.type=cronos", "--steps=64", "--algorithm.minibatch_size=8",
        "--discover_packages_path=critic_order", "--protocol.discover_packages_path=asked_reset",
        "--protocol.task_order=critic", "--protocol.extra_resets=[asked]", "--protocol.reset_budget=4",
        "--protocol.scene_reset_interval=null",
    )  # fmt: skip
    # An untrained policy fails always. Two failures are known after 16 steps, when 1 of the 4 may be spent.
    assert [update["interventions_by_kind"]["scene_reset"] for update in updates] == [1, 2, 3, 3]


def test_help_is_executed_recorded_and_counted(tmp_path):
    updates = run(
        tmp_path / "run", "--env.discover_packages_path=scripted_help", "--env.type=cronos_helped", "--steps=64",
        "--algorithm.type=imitation", "--record.repo_id=me/helped", "--record.streams=all",
        "--protocol.scene_reset_interval=null",
    )  # fmt: skip
    # Both streams fail twice, the expert does a segment, the count begins anew: segments 2 and 5.
    assert [update["interventions_by_kind"]["help"] for update in updates] == [0, 2, 4, 4]
    (root,) = (path.parents[1] for path in (tmp_path / "run").rglob("meta/info.json"))
    streams = StreamDataset("me/helped", root)
    streams.check()
    assert [segment.helped for segment in streams.segments_of(0)] == [i in (2, 5) for i in range(8)]
    assert not {"cronos.log_prob", "cronos.value"} & set(streams.meta.features)


def test_tasks_are_drawn_by_how_uncertain_their_values_are(example):
    weigh = example("critic_order").weigh
    # V = 0.4 is p = 0.5: (0.25 + 0.02) ** 2. Hopeless and certain ones have the floor alone.
    values = np.array([[0.4, -1.0, 2.0, 0.4]])
    complete = np.array([[False, False, False, True]])
    np.testing.assert_allclose(weigh(values, complete), [[0.0729, 0.0004, 0.0004, 0.0]])
    np.testing.assert_allclose(weigh(values[:, :1], np.array([[True]])), [[0.0729]])


def test_a_stream_is_stuck_after_two_failures_since_its_reset(example):
    loop = LoopState(4, num_tasks=2)
    loop.recent_success[:, -2:] = [[0, 0], [1, 0], [0, 0], [-1, 0]]
    loop.segments_since_reset[:] = [2, 2, 1, 1]
    assert example("asked_reset").find_stuck(loop).tolist() == [0]
