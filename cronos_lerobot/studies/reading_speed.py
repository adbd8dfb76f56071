"""How fast a LeRobotDataset's pictures are read, with each decoder: at random as training reads, and in order.

    python -m cronos_lerobot.studies.reading_speed --root outputs/demos [--repo_id me/demos] [--frames 1000]

Frames are counted per CPU second of one process, so that other work on the machine does not change them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable

import numpy as np
from lerobot.datasets import LeRobotDataset

BACKENDS = ("torchcodec", "pyav")
"""LeRobot's decoders."""


def frames_per_cpu_second(dataset: LeRobotDataset, order: Iterable[int]) -> float:
    """Frames/s of `dataset[i]` for all i of `order`, by the clock of this process."""
    start = time.process_time()
    count = 0
    for i in order:
        dataset[int(i)]
        count += 1
    return count / (time.process_time() - start)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--root", required=True, help="folder of the dataset")
    parser.add_argument("--repo_id", default="me/dataset", help="its name")
    parser.add_argument("--frames", type=int, default=1000, help="how many to read")
    args = parser.parse_args()
    if args.frames < 1:
        parser.error(f"--frames must be at least 1, got {args.frames}")
    for backend in BACKENDS:
        dataset = LeRobotDataset(args.repo_id, root=args.root, video_backend=backend, return_uint8=True)
        shuffled = np.random.default_rng(0).permutation(len(dataset))[: args.frames]
        first = range(min(args.frames, len(dataset)))
        try:
            dataset[0]
        except (ImportError, OSError, RuntimeError):
            print(f"{backend:10s}  cannot be loaded here: are FFmpeg's libraries installed?")
            continue
        random, in_order = (frames_per_cpu_second(dataset, order) for order in (shuffled, first))
        print(f"{backend:10s}  {random:6.0f} frames per CPU second at random  {in_order:6.0f} in order")


if __name__ == "__main__":
    main()
