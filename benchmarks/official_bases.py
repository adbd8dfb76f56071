"""Make the official base policies again: the same bits on the same kind of machine.

    python benchmarks/official_bases.py [--output_dir=outputs/bases]

The scripted expert demonstrates, `lerobot-train` clones, and `cronos-eval` evaluates. The checkpoint goes to
`cronos_lerobot/bases/<name>`, with a card. What is done already is not done again.
"""

import argparse
import json
import shutil
from pathlib import Path

from cronos_lerobot.bases import OFFICIAL
from cronos_lerobot.evaluation.policy_source import FILES
from cronos_lerobot.experiments.pipeline import Command, Runner, interrupt_on_signals
from cronos_lerobot.experiments.plan import POLICY, Options, base_commands, official_run
from cronos_lerobot.experiments.scales import OBS_TYPES, SCALES

SUITES = ("independent", "sequential")
ORIGIN = (
    "The official base policy of `kitchen_2x2` {seen}: a PocketVLA, cloned from {demos:,} demonstrations of the "
    "scripted expert. They begin all over the reach of the arm, and half of them after one to three other tasks."
)
CARD = """# {name}

{origin}

```bash
cronos-eval --policy.path={name} {flags}
```

| configurations | success [95 %] | chain length |
|---|---|---|
{rows}

n = 256 episodes and 640 chains. Fingerprint: `{fingerprint}`. `python benchmarks/official_bases.py` makes it.
Apache-2.0.
"""
SEEN = {"state": "with privileged-state observations", "pixels": "from pictures of 64 x 64 pixels"}


def main() -> None:
    """Make them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/bases"), help="demonstrations and clones")
    args = parser.parse_args()
    interrupt_on_signals()
    for kind in OBS_TYPES:
        make(kind, args.output_dir)


def make(kind: str, folder: Path) -> None:
    """Make the base that sees `kind`; what comes in between lies in `folder`."""
    run = official_run(Options(SCALES["small"], kind, folder))
    commands, name = base_commands(run), f"{run.experiment.scene}_{kind}"
    policy, evaluation = commands[-1].output / POLICY, folder / "eval" / name
    flag = f"--env.obs_type={OBS_TYPES[kind]}"
    words = ("cronos-eval", f"--policy.path={policy}", flag, "--eval.videos=0", f"--output_dir={evaluation}")
    # The bits depend on the number of threads.
    runner = Runner(threads=1, show=print, log=False)
    try:
        runner.run([*commands, Command(words, evaluation, resumes=True)])
    except KeyboardInterrupt:
        runner.stop()
        raise
    base = OFFICIAL / name
    base.mkdir(parents=True, exist_ok=True)
    for pattern in FILES:
        for file in policy.glob(pattern):
            if file.name != "train_config.json":
                shutil.copy(file, base)
    rows, fingerprint = [], ""
    for split, title in (("train", "training"), ("held_out", "held out")):
        single, chains = (
            json.loads((evaluation / f"{suite}_{split}" / "results.json").read_text()) for suite in SUITES
        )
        success = f"{single['success']:.3f} [{', '.join(f'{limit:.3f}' for limit in single['ci95'])}]"
        rows.append(f"| {title} | {success} | {chains['average_chain_length']['mean']:.2f} |")
        fingerprint = single["policy_files"]
    demos = json.loads((commands[0].output / "meta/info.json").read_text())["total_episodes"]
    table = "\n".join(rows)
    origin = ORIGIN.format(seen=SEEN[kind], demos=demos)
    card = CARD.format(name=name, origin=origin, flags=flag, rows=table, fingerprint=fingerprint)
    (base / "README.md").write_text(card)


if __name__ == "__main__":
    main()
