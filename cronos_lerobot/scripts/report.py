"""`cronos-report`: curves, tables and videos of runs, as one HTML page."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cronos_lerobot.scripts import compare

# Import late: --help and a wrong flag answer at once.
if TYPE_CHECKING:
    from cronos_lerobot.report.page import Report

EPILOG = """\
DIR is a run folder of cronos-train, an output folder of cronos-eval or lerobot-eval, or any folder above such
ones. Runs that differ only in the seed are drawn as one line, their mean and standard deviation.

examples:
  one run while it trains, or after it
      cronos-report outputs/train/eer
  episodic against reset-free, three seeds each
      cronos-report outputs/train/episodic_* outputs/train/eer_* --output=report
  what a training gained, measured by lerobot-eval on both splits, with videos
      cronos-report outputs/train/eer --before outputs/eval/base_* --after outputs/eval/eer_*
  two policies on the same episodes: the difference, its interval and p (cronos-report compare --help)
      cronos-report compare outputs/eval/base outputs/eval/eer

OUTPUT/index.html is self-contained. Figures (PNG) and tables (CSV) lie beside it.
"""


def make_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-report`."""
    parser = argparse.ArgumentParser(
        "cronos-report",
        description=(__doc__ or "").split("`: ")[1].capitalize(),
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    def add_folders(flag: str, text: str) -> None:
        parser.add_argument(flag, nargs="+", type=Path, metavar="DIR", default=[], help=text)

    parser.add_argument("runs", nargs="*", type=Path, metavar="DIR", help="folders of runs and evaluations")
    add_folders("--before", "evaluations of the policy that the training began with")
    add_folders("--after", "evaluations of the policy that came out")
    parser.add_argument("--videos", nargs="+", type=Path, metavar="MP4", default=[], help="more videos to show")
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder to write (default: report)")
    parser.add_argument(
        "--scene",
        help="names the tasks of lerobot-eval's folders (default: the scene of the runs, or kitchen_2x2)",
    )
    parser.add_argument("--title", default="CRONOS report", help="headline of the page")
    return parser


def make_report(
    runs: list[Path],
    *,
    before: list[Path] | None = None,
    after: list[Path] | None = None,
    videos: list[Path] | None = None,
    title: str = "CRONOS report",
    scene: str | None = None,
) -> Report:
    """Read the folders of a report.

    Args:
        runs: folders of runs and evaluations, or above them.
        before: evaluations of the policy that a training began with.
        after: evaluations of the policy that came out.
        videos: more to show.
        title: of the page.
        scene: names the tasks of lerobot-eval's folders.

    Raises:
        FileNotFoundError: a folder holds no run and no evaluation, or a video is missing.
        ValueError: nothing in them can be read, or there is no such scene.
    """
    from cronos_lerobot.report.load import Loaded, load
    from cronos_lerobot.report.page import Report

    if missing := [video for video in videos or [] if not video.is_file()]:
        raise FileNotFoundError(f"no video {missing[0]}")
    loaded = load(runs, scene) if runs else Loaded()
    old, new = (load(folders, scene) if folders else None for folders in (before, after))
    left_out = [text for one in (loaded, old, new) if one for text in one.left_out]
    return Report(loaded, old, new, videos or [], title, list(dict.fromkeys(left_out)))


def main() -> None:
    """Entry point of `cronos-report`."""
    if sys.argv[1:2] == ["compare"]:
        compare.main(sys.argv[2:])
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
        report = make_report(
            args.runs,
            before=args.before,
            after=args.after,
            videos=args.videos,
            title=args.title,
            scene=args.scene,
        )
        page = write_report(report, args.output)
    for text in report.left_out:
        print(f"left out: {text}", file=sys.stderr)
    if len(gains := report.gains):
        print(merged(gains).to_string(index=False))
    print(f"Report: {page}")


if __name__ == "__main__":
    main()
