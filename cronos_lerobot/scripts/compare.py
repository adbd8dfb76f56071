"""`cronos-report compare`: two policies, or two ways to train, compared on the same episodes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

EPILOG = """\
A and B are output folders of cronos-eval or run folders of cronos-train. A folder above several of them stands for
the seeds of one training. Episodes are paired by suite, split, task or ordering, configuration and sampling seed.
With fewer than three seeds on a side, the interval is that of these very policies.

examples:
  two policies
      cronos-report compare outputs/eval/base outputs/eval/eer
  two rows of a table, all seeds of each
      cronos-report compare outputs/reproduce/table1/t80 outputs/reproduce/table1/t1280_eer

docs/evaluation.md says how the intervals and p-values are computed.
"""


def make_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-report compare`."""
    parser = argparse.ArgumentParser(
        "cronos-report compare",
        description=(__doc__ or "").split("`: ")[1].capitalize(),
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("a", type=Path, metavar="A", help="folder of one side")
    parser.add_argument("b", type=Path, metavar="B", help="folder of the other side")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    return parser


def main(arguments: Sequence[str]) -> None:
    """Compare what the arguments name."""
    args = make_parser().parse_args(arguments)
    from cronos_lerobot.report.compare import compare_sides, read_side, to_json, to_text
    from cronos_lerobot.scripts.closed_pipe import ends_with_its_reader
    from cronos_lerobot.scripts.errors import error_line

    with error_line():
        (a, notes_a), (b, notes_b) = read_side(args.a), read_side(args.b)
        comparisons = compare_sides(a, b)
    notes = list(dict.fromkeys(notes_a + notes_b))
    for note in notes:
        print(f"left out: {note}", file=sys.stderr)
    with ends_with_its_reader():
        print(json.dumps(to_json(comparisons, notes), indent=2) if args.json else to_text(comparisons))
