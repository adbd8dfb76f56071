"""The whole life of a policy on the Hub, run for real: docs/hub_transcript.md is what this prints.

python tests/hub/life_of_a_policy.py --output=docs/hub_transcript.md

Against the stand-in of the tests, or with --hub against the Hub of HF_ENDPOINT, as the account of HF_TOKEN. Every
command is a process of its own; the last ones run in another folder with empty caches.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from hub_stand_in import serve

sys.path.insert(0, str(Path(__file__).parents[1]))
from transcripts import Act, perform

HEAD = (
    "# The whole life of a policy\n\n"
    "Printed by `python tests/hub/life_of_a_policy.py --output=docs/hub_transcript.md`, which runs every command"
    " against a [stand-in of the Hub](../tests/hub/hub_stand_in.py) on the same machine (`--hub` takes the real"
    " one), two CPU cores, no GPU. The last lines of each output are shown. The policy is small and its training"
    " short: this is about the way, not about the numbers. [hub.md](hub.md) explains the commands.\n"
)
PORT = 8787
STATE = "--env.obs_type=environment_state_agent_pos"


STORY = (
    Act("A benchmark of one's own, new layouts and chains of the kitchen",
        "cronos-publish benchmark --repo_id=USER/kitchen_small --scene=kitchen_2x2"
        " --seed=7 --num_configurations=16 --num_orderings=3"),
    Act("Anyone loads it in a line",
        """python -c '
from datasets import load_dataset
chains = load_dataset("USER/kitchen_small", "sequential", split="held_out")
print(chains.num_rows, chains[20])
'""", lines=1),
    Act("Demonstrations from random layouts, and a policy cloned from them with LeRobot",
        f"cronos-record-demos --env.type=cronos {STATE} --seed=1 --dataset.repo_id=USER/kitchen_demos"
        " --dataset.root=outputs/demos --dataset.num_episodes=400 --start.layouts=random"
        " --noise.share=0.75 --misses.share=0.25 --steps_after_release=8", lines=1),
    Act("", "lerobot-train --policy.type=pocketvla --policy.device=cpu --policy.push_to_hub=false"
        " --dataset.repo_id=USER/kitchen_demos --dataset.root=outputs/demos --batch_size=256 --steps=320"
        " --save_freq=320 --num_workers=0 --seed=1 --output_dir=outputs/clone", lines=1),
    Act("Both go to the Hub",
        "cronos-publish stream --root=outputs/demos --repo_id=USER/kitchen_demos"),
    Act("", "cronos-publish policy --path=outputs/clone --repo_id=USER/kitchen_base"),
    Act("The policy from the Hub learns on without resets, on the benchmark from the Hub, and is recorded",
        f"cronos-train --policy.path=USER/kitchen_base --env.type=cronos {STATE}"
        " --env.benchmark=USER/kitchen_small --protocol.num_configurations=16 --protocol.scene_reset_interval=320"
        " --protocol.end_effector_reset=true --steps=61440 --eval_freq=61440 --eval.n_episodes=16 --save_freq=0"
        " --seed=1 --record.repo_id=USER/kitchen_stream --record.streams=4 --output_dir=outputs/eer", lines=3),
    Act("Its streams and the policy, each with a card that tells how it came about",
        "cronos-publish stream --root=outputs/eer/streams --repo_id=USER/kitchen_stream"),
    Act("", "cronos-publish policy --path=outputs/eer --repo_id=USER/kitchen_eer"),
    Act("Evaluation of the published policy on the published benchmark, and its results beside it",
        "cronos-eval --policy.path=USER/kitchen_eer --env.benchmark=USER/kitchen_small --eval.videos=0"
        " --output_dir=outputs/eval", lines=24),
    Act("", "cronos-publish results --results=outputs/eval --repo_id=USER/kitchen_eer"),
    Act("Elsewhere, with nothing but the Hub, the streams in order",
        """python -c '
from cronos_lerobot.data.streams import StreamDataset
streams = StreamDataset("USER/kitchen_stream")
streams.check()
for segment in streams.segments_of(0)[:4]:
    print(segment.step, segment.task, segment.intervention.name, segment.success)
'""", lines=4, elsewhere=True),
    Act("The results", """python -c '
from huggingface_hub import hf_hub_download
print(open(hf_hub_download("USER/kitchen_eer", ".eval_results/cronos.yaml")).read())
'""", lines=8, elsewhere=True),
    Act("And the policy on the benchmark's chains, with LeRobot's own command, which samples its actions anew",
        f"lerobot-eval --policy.path=USER/kitchen_eer --policy.device=cpu --env.type=cronos {STATE}"
        " --env.benchmark=USER/kitchen_small --env.suite=sequential --env.split=held_out --eval.n_episodes=16"
        " --eval.batch_size=16 --output_dir=outputs/again", lines=0, elsewhere=True),
    Act("", """python -c '
import json
info = json.load(open("outputs/again/eval_info.json"))
print("average chain length", info["overall"]["avg_sum_reward"], "n", info["overall"]["n_episodes"])
'""", lines=1, elsewhere=True),
)  # fmt: skip


def main() -> None:
    """Run the story and write it down."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True, help="Markdown file to write")
    parser.add_argument("--hub", action="store_true", help="use HF_ENDPOINT and HF_TOKEN as they are")
    parser.add_argument("--user", default="me", help="account that the repositories belong to")
    args = parser.parse_args()
    environment = dict(os.environ)
    if not args.hub:
        hub, _ = serve(PORT)
        environment |= {"HF_ENDPOINT": hub.url, "HF_TOKEN": "any", "HF_HUB_DISABLE_XET": "1"}
    environment |= {"HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}
    parts = []
    with tempfile.TemporaryDirectory() as root:
        for name in ("here", "elsewhere"):
            (Path(root) / name).mkdir()
        for act in STORY:
            name = "elsewhere" if act.elsewhere else "here"
            home = {"HF_HOME": str(Path(root) / f"cache_{name}")}
            act = replace(act, command=act.command.replace("USER", args.user))
            parts.append(perform(act, Path(root) / name, environment | home))
    args.output.write_text("\n".join([HEAD, *parts]))


if __name__ == "__main__":
    main()
