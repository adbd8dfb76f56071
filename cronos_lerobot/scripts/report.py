"""`cronos-report`: curves, tables and videos of runs, as one HTML page."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

# Import late: --help and a wrong flag answer at once.
if TYPE_CHECKING:
    from cronos_lerobot.report.page import Report

EPILOG = """\
DIR is a run folder of cronos-train, an output folder of cronos-eval, or any folder above such ones.
Runs that differ only in the seed are drawn as one line, their mean and standard deviation.

examples:
  one run while it trains, or after it
      cronos-report outputs/train/eer
  episodic against reset-free, three seeds each
      cronos-report outputs/train/episodic_* outputs/train/eer_* --output=report
  what a training gained, measured by cronos-eval, with videos
      cronos-report outputs/train/eer --before outputs/eval/base --after outputs/eval/eer
  two policies on the same episodes: the difference, its interval and p (cronos-report compare --help)
      cronos-report compare outputs/eval/base outputs/eval/eer
  where everything lies at a start, to print (cronos-report starts --help)
      cronos-report starts --scene=so101_desk_2x2 --starts 0 1

OUTPUT/index.html is self-contained. Figures (PNG) and tables (CSV) lie beside it.
"""
COMPARE_EPILOG = """\
A and B are output folders of cronos-eval or run folders of cronos-train. A folder above several of them stands for
the seeds of one training. Episodes are paired by suite, split, task or ordering, configuration and sampling seed.
With fewer than three seeds on a side, the interval is that of these very policies.

examples:
  two policies
      cronos-report compare outputs/eval/base outputs/eval/eer
  two rows of a table, all seeds of each
      cronos-report compare outputs/reproduce/runs/kitchen_2x2_state_paper_small/{t80,t1280_eer}_307k

docs/design.md says how the intervals and p-values are computed.
"""
STARTS_EPILOG = """\
OUTPUT/<split>_<start>.png is the front camera's picture, with names. OUTPUT/<split>_<start>.pdf has the same
picture, a plan, and A4 sheets that show the arm's base and every object at true size.

example:
  cronos-report starts --scene=so101_desk_2x2 --split=held_out --starts 0 1 --output=outputs/starts
"""


def _parser(name: str, description: str, epilog: str) -> argparse.ArgumentParser:
    kind = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(name, description=description, epilog=epilog, formatter_class=kind)


def make_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-report`."""
    parser = _parser("cronos-report", "Curves, tables and videos of runs, as one HTML page.", EPILOG)

    def add_folders(flag: str, text: str) -> None:
        parser.add_argument(flag, nargs="+", type=Path, metavar="DIR", default=[], help=text)

    parser.add_argument("runs", nargs="*", type=Path, metavar="DIR", help="folders of runs and evaluations")
    add_folders("--before", "evaluations of the policy that the training began with")
    add_folders("--after", "evaluations of the policy that came out")
    parser.add_argument("--videos", nargs="+", type=Path, metavar="MP4", default=[], help="more videos to show")
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder to write (default: report)")
    parser.add_argument("--title", default="CRONOS report", help="headline of the page")
    return parser


def make_compare_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-report compare`."""
    text = "Two policies, or two ways to train, compared on the same episodes."
    parser = _parser("cronos-report compare", text, COMPARE_EPILOG)
    parser.add_argument("a", type=Path, metavar="A", help="folder of one side")
    parser.add_argument("b", type=Path, metavar="B", help="folder of the other side")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    return parser


def make_starts_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-report starts`."""
    text = "Where everything lies at the starts of a scene: pictures, and sheets to print."
    parser = _parser("cronos-report starts", text, STARTS_EPILOG)
    parser.add_argument("--scene", default="kitchen_2x2", help="name of the scene (default: kitchen_2x2)")
    parser.add_argument("--split", default="train", help="train or held_out (default: train)")
    parser.add_argument(
        "--starts", nargs="+", type=int, metavar="N", help="numbers of configurations (default: all of the split)"
    )
    parser.add_argument("--output", type=Path, default=Path("starts"), help="folder to write (default: starts)")
    return parser


def make_report(
    runs: Sequence[Path],
    *,
    before: Sequence[Path] = (),
    after: Sequence[Path] = (),
    videos: Sequence[Path] = (),
    title: str = "CRONOS report",
) -> Report:
    """Read the folders of a report: the flags of `cronos-report`.

    Raises:
        FileNotFoundError: a folder holds no run and no evaluation, or a video is missing.
        ValueError: nothing in them can be read.
    """
    from cronos_lerobot.report.load import Loaded, load
    from cronos_lerobot.report.page import Report

    if missing := [video for video in videos if not video.is_file()]:
        raise FileNotFoundError(f"no video {missing[0]}")
    loaded = [load(folders) if folders else Loaded() for folders in (runs, before, after)]
    return Report(*loaded, videos, title)


def compare(arguments: Sequence[str]) -> None:
    """Print the comparison that the arguments of `cronos-report compare` name."""
    args = make_compare_parser().parse_args(arguments)
    from cronos_lerobot.report.compare import compare_sides, read_side, to_json, to_text
    from cronos_lerobot.scripts.errors import ends_with_its_reader, error_line

    with error_line():
        (a, notes_a), (b, notes_b) = read_side(args.a), read_side(args.b)
        comparisons = compare_sides(a, b)
    notes = list(dict.fromkeys(notes_a + notes_b))
    for note in notes:
        print(f"left out: {note}", file=sys.stderr)
    with ends_with_its_reader():
        print(json.dumps(to_json(comparisons, notes), indent=2) if args.json else to_text(comparisons))


def draw_starts(arguments: Sequence[str]) -> None:
    """Draw the starts that the arguments of `cronos-report starts` name."""
    args = make_starts_parser().parse_args(arguments)
    from lerobot.utils.import_utils import register_third_party_plugins

    # Scenes of plugins.
    register_third_party_plugins()
    from lerobot_env_cronos import load_benchmark
    from lerobot_env_cronos.simulation.gl import RenderingError

    from cronos_lerobot.film.starts import write_starts
    from cronos_lerobot.scripts.errors import error_line

    with error_line(RenderingError):
        write_starts(load_benchmark(None, args.scene), args.split, args.starts, args.output)
    print(f"Starts: {args.output}")


def main() -> None:
    """Entry point of `cronos-report`."""
    if sys.argv[1:2] == ["compare"]:
        compare(sys.argv[2:])
        return
    if sys.argv[1:2] == ["starts"]:
        draw_starts(sys.argv[2:])
        return
    parser = make_parser()
    args = parser.parse_args()
    if not args.runs + args.before + args.after:
        parser.error("name at least one run folder; cronos-report --help has examples")
    if args.output.exists() and not args.output.is_dir():
        parser.error(f"--output={args.output} is a file; name a folder, new or of another report")
    from lerobot.utils.import_utils import register_third_party_plugins

    # Scenes of plugins.
    register_third_party_plugins()
    from cronos_lerobot.report.page import write_report
    from cronos_lerobot.report.tables import merged
    from cronos_lerobot.scripts.errors import error_line

    with error_line():
        report = make_report(**{name: value for name, value in vars(args).items() if name != "output"})
        page = write_report(report, args.output)
    for text in report.left_out:
        print(f"left out: {text}", file=sys.stderr)
    if len(gains := report.gains):
        print(merged(gains).to_string(index=False))
    print(f"Report: {page}")


if __name__ == "__main__":
    main()
