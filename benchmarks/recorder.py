"""What recording costs: our writer beside LeRobot's own on the same frames.

    python benchmarks/recorder.py

Prints frames/s of wall time and per CPU second, bytes a frame, and how many times LeRobot's defaults that is. On a
machine with other work, compare frames per CPU second. Bytes are those of the whole dataset.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import datasets
import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import DEFAULT_FEATURES
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.video import fast_encoder
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import Step

SIZES = {"128 x 128": (64, 128, 128), "640 x 480": (4, 480, 640)}
"""Streams, height and width [px] of the frames to write."""
REPO_ID = "benchmark/streams"


@dataclass
class Cost:
    """What writing some frames took."""

    frames: int
    wall_s: float
    cpu_s: float
    num_bytes: int

    def text(self, theirs: Cost) -> str:
        """Speeds and size, beside those of another writer."""
        per_cpu, their_per_cpu = (cost.frames / cost.cpu_s for cost in (self, theirs))
        speed = f"{self.frames / self.wall_s:6.0f} frames/s  {per_cpu:6.0f} per CPU second"
        return (
            f"{speed}  {self.num_bytes / self.frames:6.0f} bytes a frame  {per_cpu / their_per_cpu:5.1f} x LeRobot"
        )


class Recording:
    """Steps of the expert in some streams, kept in memory, to be written again and again.

    Args:
        num_streams: how many.
        height: of the pictures [px].
        width: of the pictures [px].
        steps: of each stream; one segment.
    """

    def __init__(self, num_streams: int, height: int, width: int, steps: int) -> None:
        self.env = CronosVectorEnv(num_streams, observation_height=height, observation_width=width)
        tasks = self.env.scene.tasks
        self.env.set_task(np.arange(num_streams), [tasks[i % len(tasks)] for i in range(num_streams)])
        expert = ScriptedExpert(self.env)
        expert.reset(np.arange(num_streams))
        observation, self.steps = self.env.observe(), []
        for _ in range(steps):
            action = expert.act().astype(np.float32)
            following, reward, *_, info = self.env.step(action)
            self.steps.append((observation, action, reward, info["is_success"]))
            observation = following

    def write(self, recorder: StreamRecorder) -> None:
        """Hand all steps to a recorder, as the training loop does."""
        n = self.env.num_envs
        zeros, numbers, no = np.zeros(n, np.float32), np.zeros(n, np.int64), np.zeros(n, np.bool_)
        for t, (observation, action, reward, success) in enumerate(self.steps):
            recorder.on_step(
                Step(
                    t, observation, self.env.instructions, ActionSample(action, zeros, zeros),
                    reward, success, diverged=no, cut=np.full(n, t == len(self.steps) - 1), piece=numbers,
                    segments_since_reset=numbers, interventions=numbers, policy_version=0, intervened=no,
                    preceded_by=np.full(n, Intervention.NONE if t else Intervention.INITIAL),
                )
            )  # fmt: skip
        recorder.close()

    def segments(self, root: Path) -> Iterator[tuple[str, list[dict[str, Any]]]]:
        """The recording in `root` as LeRobot's writer wants it: a list of frames for each segment."""
        dataset = LeRobotDataset(REPO_ID, root=root)
        columns = dataset.hf_dataset.with_format("numpy")[:]
        names = [key for key in dataset.features if key in columns and key not in DEFAULT_FEATURES]
        dtypes = {name: dataset.features[name]["dtype"] for name in names}
        for stream, episode in enumerate(dataset.meta.episodes):
            frames = []
            for t, row in enumerate(range(episode["dataset_from_index"], episode["dataset_to_index"])):
                # NumPy's format of the datasets library widens int8.
                frame = {name: np.atleast_1d(columns[name][row]).astype(dtypes[name]) for name in names}
                pixels = self.steps[t][0]["pixels"]
                frames.append(frame | {f"observation.images.{name}": p[stream] for name, p in pixels.items()})
            yield episode["tasks"][0], frames


def measure(frames: int, root: Path, write: Callable[[], None]) -> Cost:
    """Time `write`, which makes the dataset in `root`."""
    wall, cpu = time.perf_counter(), time.process_time()
    write()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    num_bytes = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    return Cost(frames, wall, cpu, num_bytes)


def compare_writers(num_streams: int, height: int, width: int, steps: int, folder: Path) -> dict[str, Cost]:
    """Write the same frames with the recorder, and with LeRobot's writer as it is and at its fastest."""
    recording = Recording(num_streams, height, width, steps)
    frames, ours = num_streams * steps, folder / "ours"
    recorder = StreamRecorder.open(recording.env, REPO_ID, ours, segment_length=steps)
    features, fps = recorder.writer.features, int(recording.env.metadata["render_fps"])
    costs = {"StreamRecorder": measure(frames, ours, partial(recording.write, recorder))}
    segments = list(recording.segments(ours))
    # A longer queue: with its own, LeRobot drops frames that the encoder has no time for.
    fast = {"streaming_encoding": True, "rgb_encoder": fast_encoder(), "encoder_queue_maxsize": steps}
    for name, options in {"LeRobot, its defaults": {}, "LeRobot, streaming, our codec": fast}.items():
        root = folder / name.replace(" ", "_")
        theirs = LeRobotDataset.create(REPO_ID, fps, features, root=root, **options)
        costs[name] = measure(frames, root, partial(_write_with_lerobot, theirs, segments))
    recording.env.close()
    return costs


def _write_with_lerobot(dataset: LeRobotDataset, segments: list[tuple[str, list[dict[str, Any]]]]) -> None:
    for task, frames in segments:
        for frame in frames:
            dataset.add_frame(frame | {"task": task})
        dataset.save_episode()
    dataset.finalize()


def main() -> None:
    """Print one line for each measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=40, help="frames of each stream")
    args = parser.parse_args()
    datasets.disable_progress_bars()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    for size, shape in SIZES.items():
        with tempfile.TemporaryDirectory() as folder:
            costs = compare_writers(*shape, args.steps, Path(folder))
            for name, cost in costs.items():
                print(f"{size}  {name:30s} {cost.text(costs['LeRobot, its defaults'])}", flush=True)


if __name__ == "__main__":
    main()
