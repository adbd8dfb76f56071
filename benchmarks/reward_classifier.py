"""How often LeRobot's reward classifier is wrong, by the simulator's truth.

    cronos-record-demos --env.type=cronos --env.scene=so101_desk_2x2 --env.privileged_state=true \
        --env.observation_height=128 --env.observation_width=128 --dataset.video=false \
        --dataset.repo_id=local/pictures --dataset.root=outputs/judge/pictures --dataset.num_episodes=1200 \
        --seed=1 --steps_after_release=30 --start.layouts=reach --start.arm_pose=either \
        --start.occupied_receptacles=true --start.misplaced_objects=true --start.share=0.5
    python benchmarks/reward_classifier.py encoder --dataset=outputs/judge/pictures --output=outputs/judge/encoder

Then record two streams of a clone (docs/finetune.md, "On the SO-101") that does not learn, `train` and `other`:

    cronos-train --policy.path=<clone> --num_envs=16 --steps=153600 --env.type=cronos --env.scene=so101_desk_2x2 \
        --env.privileged_state=true --env.observation_height=128 --env.observation_width=128 \
        --env.task_observation=one_hot --algorithm.type=imitation --algorithm.warmup_segments=1000000 \
        --protocol.scene_reset_interval=1920 --protocol.end_effector_reset=true --protocol.update_interval=480 \
        --eval_freq=0 --record.repo_id=local/streams --record.streams=all --seed=5 --output_dir=outputs/judge/train

`other` has `--steps=61440 --seed=6`. Train a classifier for each task on `train` by docs/robot.md, "Let a model
judge", with `--reward_model.model_name=outputs/judge/encoder --steps=1500`, and measure them:

    python benchmarks/reward_classifier.py measure --dataset=outputs/judge/other/streams \
        --judge=outputs/judge/judges

`encoder` stands in for the Hub's pretrained encoders: a small one that says from a picture where the bodies are.
"""

import argparse
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import IMAGENET_STATS
from transformers import ResNetConfig, ResNetModel

from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.robot.person import Events
from cronos_lerobot.robot.reward_models import RewardModelJudge
from cronos_lerobot.statistics import wilson_interval

CAMERA, SIZE = "observation.images.front", 128
EVERY = 8
"""Frames from one picture that the encoder learns to the next."""
EARLY = 15
"""A verdict is too early if the truth follows later than this [control steps]."""


def train_encoder(dataset: Path, steps: int, output: Path) -> None:
    """A ResNet of 128 x 128 pictures, trained to say where the bodies are, and saved as transformers does."""
    torch.manual_seed(0)
    encoder = ResNetModel(
        ResNetConfig(embedding_size=32, hidden_sizes=[32, 64, 128, 128], depths=[1, 1, 1, 1], layer_type="basic")
    )
    pictures, places = _pictures_and_places(dataset)
    places = (places - places.mean(0)) / places.std(0).clamp(min=1e-3)
    held_out = len(pictures) // 20
    head = torch.nn.Linear(128 * 4 * 4, places.shape[1])
    optimizer = torch.optim.AdamW([*encoder.parameters(), *head.parameters()], lr=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, steps)

    def error(rows: torch.Tensor) -> torch.Tensor:
        features = encoder(_normalized(pictures[rows])).last_hidden_state
        return (head(features.flatten(1)) - places[rows]).square().mean()

    for step in range(steps):
        loss = error(torch.randint(held_out, len(pictures), (32,)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            print(f"step {step}: {loss.item():.3f} of the variance", flush=True)
    encoder.eval()
    with torch.no_grad():
        errors = [error(rows) for rows in torch.arange(held_out).split(64)]
    print(f"of episodes that it has not seen: {torch.stack(errors).mean():.3f} of the variance")
    encoder.save_pretrained(output)


def _pictures_and_places(dataset: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures (n, 128, 128, 3) uint8 and the bodies' positions (n, d) [m] of every EVERY-th frame."""
    frames = LeRobotDataset("local/pictures", dataset)
    rows = range(0, len(frames), EVERY)
    pictures = torch.empty(len(rows), SIZE, SIZE, 3, dtype=torch.uint8)
    places = []
    for i, row in enumerate(rows):
        frame = frames[row]
        pictures[i] = (255 * frame[CAMERA]).round().byte().permute(1, 2, 0)
        # Of 12 numbers a body: where it is, and where it is from the hand.
        bodies = frame["observation.environment_state"].reshape(-1, 12)
        places.append(bodies[:, [0, 1, 2, 9, 10, 11]].flatten())
    return pictures, torch.stack(places)


def _normalized(pictures: torch.Tensor) -> torch.Tensor:
    """Pictures (n, H, W, 3) as `lerobot-train` shows them to its models, (n, 3, H, W)."""
    mean, std = (torch.tensor(IMAGENET_STATS[name]) for name in ("mean", "std"))
    return (pictures.permute(0, 3, 1, 2) / 255 - mean) / std


def measure(dataset: Path, judges: Path) -> None:
    """Print how often the judges are wrong in a segment, and too early in one that succeeds.

    Segments that begin complete are left out.
    """
    streams = StreamDataset("local/streams", dataset)
    tasks = {text: SimpleNamespace(instruction=text) for text in sorted({one.task for one in streams.segments})}
    judge = RewardModelJudge(judges, tuple(tasks.values()), (), {"front": None})
    errors: dict[tuple[str, str], list[tuple[bool, bool]]] = {}
    for segment in streams.segments:
        # What a picture shows was true after the action before.
        truth = streams.columns(segment, ["next.success"])["next.success"][:-1].astype(bool).ravel()
        if truth[0]:
            continue
        judge.begin(tasks[segment.task])
        says = np.array([judge.judge({"front": one}, Events()) for one in streams.pixels(segment, CAMERA)[1:]])
        found = {"segment": (says.any(), truth.any())}
        if truth.argmax() > EARLY:
            found["segment, too early"] = (says[: truth.argmax() - EARLY].any(), False)
        for what, pair in found.items():
            for of in (segment.task, "all tasks"):
                errors.setdefault((of, what), []).append(pair)
    print("| task | of a | n | wrong, 95 % | false successes | missed successes |\n|---|---|---|---|---|---|")
    for (of, what), pairs in sorted(errors.items(), key=lambda one: one[0][0] != "all tasks"):
        said, true = np.array(pairs).T
        wrong, n = int((said != true).sum()), len(true)
        low, high = wilson_interval(wrong, n)
        print(
            f"| {of} | {what} | {n} | {wrong / n:.3f} ({low:.3f} to {high:.3f})"
            f" | {(said & ~true).sum()} of {(~true).sum()} | {(~said & true).sum()} of {true.sum()} |"
        )


def main() -> None:
    """One of the two commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("encoder")
    one.add_argument("--dataset", type=Path, required=True)
    one.add_argument("--steps", type=int, default=3000)
    one.add_argument("--output", type=Path, required=True)
    one = commands.add_parser("measure")
    one.add_argument("--dataset", type=Path, required=True)
    one.add_argument("--judge", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "encoder":
        train_encoder(args.dataset, args.steps, args.output)
    else:
        measure(args.dataset, args.judge)


if __name__ == "__main__":
    main()
