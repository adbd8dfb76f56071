"""`cronos-report`: curves, tables and videos of runs, as one HTML page."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cronos_lerobot.scripts import compare

# What draws and what reads runs is imported where it is used: --help and a wrong flag are answered at once.
if TYPE_CHECKING:
    from cronos_lerobot.report.page import Report

EPILOG = """\
DIR is a run folder of cronos-train, an output folder of cronos-eval or lerobot-eval, or any folder above such
ones. Runs that differ in nothing but the seed are drawn as one line, their mean and standard deviation.

examples:
  one run while it trains, or after it
      cronos-report outputs/train/eer
  episodic against reset-free, three seeds each
      cronos-report outputs/train/episodic_* outputs/train/eer_* --output=report
  what a training came to, measured by lerobot-eval on both splits, with videos side by side
      cronos-report outputs/train/eer --before outputs/eval/base_* --after outputs/eval/eer_*
  all runs of an experiment
      cronos-reproduce table1 --scale=small; cronos-report outputs/reproduce/runs/kitchen_2x2_state_small

  two policies on the same episodes: the difference, its interval and p (cronos-report compare --help)
      cronos-report compare outputs/eval/base outputs/eval/eer

OUTPUT/index.html contains everything and can be sent as it is; figures (PNG) and tables (CSV) lie beside it.
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

    parser.add_argument("runs", nargs="*", type=Path, metavar="DIR", help="folders of runs")
    add_folders("--before", "lerobot-eval of the policy that the training began with")
    add_folders("--after", "lerobot-eval of the policy that came out")
    parser.add_argument("--videos", nargs="+", type=Path, metavar="MP4", default=[], help="more videos to show")
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder to write (default: report)")
    parser.add_argument(
        "--scene",
        help="of lerobot-eval's folders, which number the tasks and do not name the scene (default: that of "
        "--benchmark, or of the runs of cronos-train on the page, else kitchen_2x2)",
    )
    parser.add_argument(
        "--benchmark",
        metavar="NAME",
        help="of lerobot-eval's folders, as --env.benchmark named it (default: the package's)",
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
    benchmark: str | None = None,
) -> Report:
    """Read run folders and pair evaluations before with those after.

    Args:
        runs: folders of runs, or above them.
        before: of lerobot-eval, before a training.
        after: the same after it.
        videos: more to show.
        title: of the page.
        scene: of lerobot-eval's folders; by default that of `benchmark` or of the training runs.
        benchmark: of the same; the package's by default.

    Raises:
        FileNotFoundError: a folder holds no run, or a video is missing.
        ValueError: there is no such scene, or nothing of lerobot-eval in `before` or `after`.
    """
    from lerobot_env_cronos.benchmark.load import benchmark_scene, load_benchmark

    from cronos_lerobot.report.comparisons import at_their_end
    from cronos_lerobot.report.page import Report
    from cronos_lerobot.report.runs import FoundRuns, find_runs, group_runs, scene_of

    if benchmark and scene is None:
        scene = benchmark_scene(benchmark)
    if scene is not None:
        load_benchmark(benchmark, scene)
    nothing = FoundRuns([], [], [], [])
    found = find_runs(runs, scene, benchmark) if runs else nothing
    scene = scene or scene_of(found.training)
    old, new = (find_runs(folders, scene, benchmark) if folders else nothing for folders in (before, after))
    for flag, folders, read in (("--before", before, old), ("--after", after, new)):
        if folders and not read.evaluations:
            raise ValueError(
                f"{flag}={folders[0]}: nothing of lerobot-eval there, and no other evaluation is paired by task; "
                "cronos-report compare pairs those of cronos-eval and cronos-train episode by episode"
            )
    paired = {run.folder.resolve() for run in old.evaluations + new.evaluations}
    rest = [run for run in found.evaluations if run.folder.resolve() not in paired]
    for video in videos or []:
        if not video.is_file():
            raise FileNotFoundError(f"No video {video}.")
    left_out = list(dict.fromkeys(found.left_out + old.left_out + new.left_out))
    for group in group_runs(found.training, left_out):
        at_their_end(group.runs, left_out)
    return Report(
        found.training, rest, old.evaluations, new.evaluations, videos or [], title, found.suites, left_out
    )


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

    # Scenes that are installed by themselves.
    register_third_party_plugins()
    try:
        report = make_report(
            args.runs,
            before=args.before,
            after=args.after,
            videos=args.videos,
            title=args.title,
            scene=args.scene,
            benchmark=args.benchmark,
        )
    except (FileNotFoundError, ValueError) as error:
        sys.exit(f"error: {error}")
    from cronos_lerobot.report.page import write_report
    from cronos_lerobot.report.tables import comparison_text

    try:
        page = write_report(report, args.output)
    except OSError as error:
        sys.exit(f"error: the report was not written: {error}")
    for text in report.left_out:
        print(f"left out: {text}", file=sys.stderr)
    if report.comparisons:
        print(comparison_text(report.comparisons))
    print(f"Report: {page}")


if __name__ == "__main__":
    main()
