"""Write what is frozen of a scene into a file: its benchmark configurations, or its orderings of tasks.

    python -m lerobot_env_cronos.benchmark.freeze configurations kitchen_2x2
    python -m lerobot_env_cronos.benchmark.freeze orderings kitchen_2x2

For scenes of one's own, and for maintainers, when a new version is made.
"""

import argparse
from pathlib import Path

from lerobot_env_cronos.benchmark.command_line import find_scene
from lerobot_env_cronos.benchmark.configurations import SEED, write_configurations
from lerobot_env_cronos.benchmark.orderings import write_orderings


def main() -> None:
    """Write one file of a scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("configurations", "orderings"))
    parser.add_argument("scene")
    parser.add_argument("--seed", type=int, help=f"of configurations; {SEED} by default")
    parser.add_argument("--output", type=Path, default=Path("."), help="folder")
    parser.add_argument("--discover_packages_path", help="package to import first, which registers the scene")
    args = parser.parse_args()
    if args.seed is not None and (args.what == "orderings" or args.seed < 0):
        parser.error(f"--seed is of configurations, and at least 0; got {args.what} {args.seed}")
    scene = find_scene(parser, args.scene, args.discover_packages_path)
    if not args.output.is_dir():
        parser.error(f"--output={args.output} is no folder")
    try:
        if args.what == "orderings":
            path = write_orderings(scene.name, args.output)
        else:
            path = write_configurations(scene.name, args.output, SEED if args.seed is None else args.seed)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
