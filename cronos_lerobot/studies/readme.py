"""The README's table of results, made from the files of the experiments that it shows.

    python -m cronos_lerobot.studies.readme          # write it anew
    python -m cronos_lerobot.studies.readme --check  # only say whether it is what the files say

The files are those that `cronos-reproduce` wrote, in docs/results; the table stands between two marks.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path
from typing import Any

RESULTS = Path("docs/results/few_resets_small_state")
ROWS = {
    "t80_wide": "episodic: a reset every 80 steps",
    "t1280_eer_wide": "a reset every 1280 steps",
    "t1280_eer_cl_hsr_wide": "the paper's best: curriculum, lost bodies put back",
    "t1280_eer_staggered_wide": "a reset every 1280 steps, at a time of each stream's own",
    "t1280_eer_critic_staggered_wide": "and the critic chooses the task",
    "tnone_eer_takeover_memory_wide": "no reset: an expert takes over after two failures and is learned from",
}
"""What the README calls them; rows without a finished run are left out."""
BEGIN, END = "<!-- few_resets: made by python -m cronos_lerobot.studies.readme -->", "<!-- end of few_resets -->"


def make_table(folder: Path) -> str:
    """The table in Markdown, of what `cronos-reproduce few_resets` wrote into a folder."""
    rows = {row["row"]: row for row in _read(folder / "few_resets.csv")}
    differences = {
        (found["row"], found["reference"]): found for found in _read(folder / "few_resets_differences.csv")
    }
    reference, *_ = ROWS
    lines = [
        "| training, from the wide base | interventions | success | seeds | minus episodic [95 %] |",
        "|---|---|---|---|---|",
    ]
    shown = [name for name in ROWS if rows.get(name, {}).get("success_train_mean")]
    for name in shown:
        row = rows[name]
        difference = differences.get((name, reference))
        cells = (
            ROWS[name],
            f"{float(row['interventions_mean']):,.0f}",
            _success(row),
            row["seeds"],
            _difference(difference) if difference else "",
        )
        lines.append(f"| {' | '.join(cells)} |")
    base = {rows[name]["base_success_mean"] for name in shown}
    settings = json.loads((folder / "few_resets.json").read_text())
    n = rows[shown[0]]["n_train"]
    before = " and ".join(f"{float(value):.3f}" for value in sorted(base))
    return "\n".join(
        [*lines, "", f"{settings['steps']:,} interaction steps; before training {before}; n = {n} for each seed."]
    )


def rewrite(readme: str, folder: Path) -> str:
    """The README with its table made anew.

    Raises:
        ValueError: it has not the marks.
    """
    if readme.count(BEGIN) != 1 or readme.count(END) != 1:
        raise ValueError(f"the README must have {BEGIN} and {END} once each")
    head, rest = readme.split(BEGIN)
    return f"{head}{BEGIN}\n{make_table(folder)}\n{END}{rest.split(END)[1]}"


def _success(row: dict[str, Any]) -> str:
    mean, std = float(row["success_train_mean"]), row["success_train_std"]
    ends = [row["success_train_ci95_low"], row["success_train_ci95_high"]]
    spread = f" ± {float(std):.3f}" if std else ""
    interval = " [{:.3f}, {:.3f}]".format(*map(float, ends)) if all(ends) else ""
    return f"{mean:.3f}{spread}{interval}"


def _difference(found: dict[str, Any]) -> str:
    ends = [found["ci95_low"], found["ci95_high"]]
    interval = " [{:+.3f}, {:+.3f}]".format(*map(float, ends)) if all(ends) else ""
    return f"{float(found['difference']):+.3f}{interval}"


def _read(path: Path) -> list[dict[str, Any]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readme", type=Path, default=Path("README.md"))
    parser.add_argument("--results", type=Path, default=RESULTS, help=f"default: {RESULTS}")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if it is not up to date")
    args = parser.parse_args()
    before = args.readme.read_text()
    after = rewrite(before, args.results)
    if args.check:
        sys.exit(
            "" if after == before else f"{args.readme} is not what {args.results} says: run it without --check"
        )
    args.readme.write_text(after)


if __name__ == "__main__":
    main()
