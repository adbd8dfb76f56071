"""What recording costs: our writer beside LeRobot's own on the same frames, and its share of a training run.

    python -m cronos_lerobot.studies.recorder_speed [--skip train]

Frames/s are of wall time; on a machine with other work frames per CPU second compare better. Bytes are those of
the whole dataset, with its numbers and statistics.
"""

from __future__ import annotations

import argparse
import json
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
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.data.drawing import LateCamera
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

    def __str__(self) -> str:
        speed = f"{self.frames / self.wall_s:6.0f} frames/s  {self.frames / self.cpu_s:6.0f} per CPU second"
        return f"{speed}  {self.num_bytes / self.frames:6.0f} bytes a frame"


class Recording:
    """Steps of the expert in some streams, kept in memory, to be written again and again.

    Args:
        num_streams: how many.
        height: of the pictures [px].
        width: of the pictures [px].
        steps: of each stream; one segment.
    """

    def __init__(self, num_streams: int, height: int, width: int, steps: int) -> None:
        self.env = CronosVectorEnv(
            num_streams, observation_height=height, observation_width=width, render_size=(height, width)
        )
        self.camera = LateCamera(height, width, self.env.simulation.model.nq, self.env.render_positions)
        tasks = self.env.scene.tasks
        self.env.set_task(np.arange(num_streams), [tasks[i % len(tasks)] for i in range(num_streams)])
        expert = ScriptedExpert(self.env)
        expert.reset(np.arange(num_streams))
        observation, self.steps, self.positions = self.env.observe(), [], []
        for _ in range(steps):
            self.positions.append(self.env.positions(np.arange(num_streams)))
            action = expert.act().astype(np.float32)
            following, reward, *_, info = self.env.step(action)
            self.steps.append((observation, action, reward, info["is_success"]))
            observation = following

    def write(self, recorder: StreamRecorder, *, drawn: bool = True) -> None:
        """Hand all steps to a recorder, as the training loop does; if not `drawn`, states in place of pictures."""
        n = self.env.num_envs
        zeros, numbers, no = np.zeros(n, np.float32), np.zeros(n, np.int64), np.zeros(n, np.bool_)
        for t, (observation, action, reward, success) in enumerate(self.steps):
            if not drawn:
                observation = observation | {"pixels": dict.fromkeys(observation["pixels"], self.positions[t])}
            recorder.on_step(
                Step(
                    t, observation, self.env.instructions, ActionSample(action, zeros, zeros),
                    reward, success, diverged=no, cut=np.full(n, t == len(self.steps) - 1), piece=numbers,
                    segments_since_reset=numbers, interventions=numbers, policy_version=0,
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
        assert dataset.meta.episodes is not None
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


def compare_writers(
    num_streams: int, height: int, width: int, steps: int, folder: Path
) -> Iterator[tuple[str, Cost]]:
    """Write the same frames with the recorder, and with LeRobot's writer as it is and at its fastest."""
    recording = Recording(num_streams, height, width, steps)
    frames, ours = num_streams * steps, folder / "ours"
    recorder = StreamRecorder.open(recording.env, REPO_ID, ours, segment_length=steps)
    features, fps = recorder.writer.features, int(recording.env.metadata["render_fps"])
    yield "StreamRecorder", measure(frames, ours, partial(recording.write, recorder))
    late = StreamRecorder.open(
        recording.env, REPO_ID, folder / "drawn", segment_length=steps, cameras={"front": recording.camera}
    )
    write = partial(recording.write, late, drawn=False)
    yield "StreamRecorder, drawing too", measure(frames, folder / "drawn", write)
    segments = list(recording.segments(ours))
    names = ("LeRobot, its defaults", "LeRobot, streaming, our codec")
    for is_fast, name in enumerate(names):
        root = folder / name.replace(" ", "_")
        fast: dict[str, Any] = {"streaming_encoding": True, "rgb_encoder": fast_encoder()}
        # Its queue would drop frames that the encoder has no time for.
        fast |= {"encoder_queue_maxsize": steps}
        theirs = LeRobotDataset.create(REPO_ID, fps, features, root=root, **(fast if is_fast else {}))
        yield name, measure(frames, root, partial(_write_with_lerobot, theirs, segments))
    recording.env.close()


def _write_with_lerobot(dataset: LeRobotDataset, segments: list[tuple[str, list[dict[str, Any]]]]) -> None:
    for task, frames in segments:
        for frame in frames:
            dataset.add_frame(frame | {"task": task})
        dataset.save_episode()
    dataset.finalize()


def train(streams: str, filmed: int, steps: int) -> dict[str, float]:
    """A run of `cronos-train` from pixels with a frozen encoder: steps/s, and steps per CPU second.

    Args:
        streams: how many of its 64 streams are recorded; "0" for none.
        filmed: how many of them are filmed at 640 x 480 besides.
        steps: interaction steps of each stream; those until the first update are not counted.
    """
    from lerobot.policies import make_policy_config

    from cronos_lerobot.agents.ppo.config import PPOConfig
    from cronos_lerobot.scripts.train import train as run
    from cronos_lerobot.training.config import CronosTrainConfig
    from cronos_lerobot.training.record_config import RecordConfig

    policy = make_policy_config(
        "pocketvla", device="cpu", push_to_hub=False, critic_observation="environment_state", freeze_encoder=True
    )
    cpu = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        config = CronosTrainConfig(
            env=CronosEnvConfig(privileged_state=True),
            policy=policy,
            output_dir=Path(folder) / "run",
            steps=64 * steps,
            algorithm=PPOConfig(value_warmup_updates=0),
            record=RecordConfig() if streams == "0" else RecordConfig(REPO_ID, None, streams, filmed),
            eval_freq=0,
            save_checkpoint=False,
            tensorboard=False,
        )
        run(config)
        lines = [json.loads(line) for line in (Path(folder) / "run/metrics.jsonl").read_text().splitlines()]
    cpu = time.process_time() - cpu
    # The first update pays for what is built lazily.
    rows = [line for line in lines if line["kind"] == "update"][1:]
    return {
        "steps/s": float(np.mean([row["steps_per_s"] for row in rows])),
        "steps per CPU second": 64 * steps / cpu,
        "share of the loop": float(np.mean([row["time_share"]["record"] for row in rows])),
    }


def main() -> None:
    """Print one line for each measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=40, help="frames of each stream that the writers write")
    parser.add_argument("--train_steps", type=int, default=480, help="control steps of each stream in a training")
    parser.add_argument("--repeats", type=int, default=2, help="trainings of each kind, in turns")
    parser.add_argument("--skip", nargs="*", default=[], choices=["writers", "train"])
    args = parser.parse_args()
    register_third_party_plugins()
    datasets.disable_progress_bars()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    for size, shape in SIZES.items() if "writers" not in args.skip else ():
        with tempfile.TemporaryDirectory() as folder:
            for name, cost in compare_writers(*shape, args.steps, Path(folder)):
                print(f"{size}  {name:30s} {cost}", flush=True)
    kinds = {"nothing": ("0", 0), "64 streams": ("all", 0), "64 streams, 4 of them at 640 x 480 too": ("all", 4)}
    for _ in range(0 if "train" in args.skip else args.repeats):
        for name, kind in kinds.items():
            result = train(*kind, args.train_steps)
            print(f"recorded: {name:40s}", ", ".join(f"{k} {v:.3g}" for k, v in result.items()), flush=True)


if __name__ == "__main__":
    main()
