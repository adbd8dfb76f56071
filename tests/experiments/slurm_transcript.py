"""A run that a cluster's time limit stops again and again, beside one that nothing stops.

python tests/experiments/slurm_transcript.py --output=docs/slurm_transcript.md

On a Slurm of one node (Debian's slurm-wlm and munge), every command a process of its own. At the end both runs
must have the same weights and the same log.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from slurm_cluster import SlurmCluster, missing
from transcripts import Act, perform

HEAD = (
    "# A run that its time limit stops\n\n"
    "Printed by `python tests/experiments/slurm_transcript.py --output=docs/slurm_transcript.md`, which starts a"
    " Slurm of one node on this machine (two CPU cores) and runs every command. Slurm holds a requeued job back"
    " for two minutes; here for two seconds (`scontrol update JobId=... StartTime=now`). The last lines of each"
    " output are shown. [cluster.md](cluster.md) explains the commands.\n"
)
SAME = """python -c '
import json, sys
from pathlib import Path
from safetensors.torch import load_file

def run(root):
    folder, = Path(root).glob("runs/*/*/seed1/train/checkpoints/last/pretrained_model")
    log = (folder.parents[2] / "metrics.jsonl").read_text().splitlines()
    counted = [{k: v for k, v in json.loads(line).items() if k not in TIMES} for line in log]
    return load_file(folder / "model.safetensors"), counted

TIMES = ("time", "steps_per_s", "time_share")
(weights, log), (other_weights, other_log) = run("unbroken"), run("cluster")
same = all(weights[name].equal(other_weights[name]) for name in weights)
print(f"the same weights: {same}, the same log but for its times: {log == other_log}")
sys.exit(not (same and log == other_log))
'"""


def story(scale: str, time_limit: str, warning_s: int) -> tuple[Act, ...]:
    """The commands, at this scale and with this limit for an element of an array."""
    row = f"cronos-reproduce table1 --scale={scale} --rows t80 --seeds=1,"
    slurm = f"--launcher=slurm --slurm.partition=main --slurm.time={time_limit} --slurm.warning_s={warning_s}"
    return (
        Act("A row of Table 1, one seed, with nothing that stops it", f"{row} --root=unbroken", lines=1),
        Act("The cluster", "sinfo", lines=2),
        Act(
            f"The same row there, where nothing may take longer than {time_limit} minutes",
            f"{row} --root=cluster {slurm}",
            30,
        ),
        Act("What has become of it", "cronos-reproduce status --root=cluster", lines=12),
        Act("Slurm's own words", "cat cluster/slurm/logs/*.out | grep -v '^$'", lines=20),
        Act("Both have", SAME, lines=1),
    )


def main() -> None:
    """Run the story and write it down."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True, help="Markdown file to write")
    parser.add_argument("--scale", default="small", help="of cronos-reproduce")
    parser.add_argument("--time", default="4", help="limit of an element [min]")
    parser.add_argument("--warning_s", type=int, default=60)
    args = parser.parse_args()
    if lacks := missing():
        sys.exit(f"not here: {', '.join(lacks)}; .ci/system-packages tests installs them")
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    # The commands, and what the cluster starts, are those of this Python.
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    try:
        (folder / "slurm").mkdir()
        with SlurmCluster(folder / "slurm") as cluster:
            (folder / "here").mkdir()
            environment["SLURM_CONF"] = os.environ["SLURM_CONF"]
            acts = story(args.scale, args.time, args.warning_s)
            with cluster.sparing_the_wait():
                parts = [perform(act, folder / "here", environment) for act in acts]
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    args.output.write_text("\n".join([HEAD, *parts]))


if __name__ == "__main__":
    main()
