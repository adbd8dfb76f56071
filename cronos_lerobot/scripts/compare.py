"""`cronos-report compare`: two policies, or two ways to train, compared on the same episodes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from cronos_lerobot.scripts.closed_pipe import ends_with_its_reader
from cronos_lerobot.scripts.errors import error_line

EPILOG = """\
A and B are output folders of cronos-eval, run folders of cronos-train, or folders above such ones: then all that
they hold are seeds of one training. Of several checkpoints of a run the last counts. Episodes are paired by suite,
split, task or ordering, configuration and sampling seed.

examples:
  two policies
      cronos-report compare outputs/eval/base outputs/eval/eer
  two rows of a table, all seeds of each
      cronos-report compare outputs/reproduce/runs/kitchen_2x2_state_small/t80_307k \\
          outputs/reproduce/runs/kitchen_2x2_state_small/t1280_eer_307k
  seeds that lie apart, as JSON
      cronos-report compare outputs/eval/eer_[123] --with outputs/eval/best_[123] --json

docs/evaluation.md says how the intervals and p-values are made.
"""


def make_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-report compare`."""
    parser = argparse.ArgumentParser(
        "cronos-report compare",
        description=(__doc__ or "").split("`: ")[1].capitalize(),
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="A and B, or with --with all of A")
    parser.add_argument("--with", nargs="+", type=Path, metavar="DIR", dest="others", help="all of B")
    parser.add_argument(
        "--power", type=float, default=0.8, help="with which a decision would be made (default: 0.8)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON in place of tables")
    return parser


def main(arguments: Sequence[str]) -> None:
    """Compare what the arguments name."""
    parser = make_parser()
    args = parser.parse_args(arguments)
    a, b = args.folders, args.others
    if b is None:
        if len(a) != 2:
            parser.error(f"name two folders, A and B, or --with: got {len(a)}")
        a, b = a[:1], a[1:]
    if not 0.5 <= args.power < 1:
        parser.error(f"--power must be at least 0.5 and below 1, got {args.power}")
    from cronos_lerobot.report.compared_sides import read_side
    from cronos_lerobot.report.paired_report import check_apart, compare_sides, to_json, to_text

    with error_line():
        sides = read_side(a), read_side(b)
        check_apart(*sides)
        suites = compare_sides(*sides, args.power)
    for note in dict.fromkeys(sides[0].notes + sides[1].notes):
        print(f"left out: {note}", file=sys.stderr)
    with ends_with_its_reader():
        if args.json:
            print(json.dumps(to_json(*sides, suites, args.power), indent=2))
        else:
            print(to_text(suites, args.power))
