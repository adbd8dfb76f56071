"""Write what is frozen of a scene into a file: its benchmark configurations, or its orderings of tasks.

    python -m lerobot_env_cronos.benchmark.freeze configurations kitchen_2x2
    python -m lerobot_env_cronos.benchmark.freeze orderings kitchen_2x2

For your own scenes, and for maintainers, when a new version is made.
"""

import argparse
from importlib import import_module
from pathlib import Path

from lerobot_env_cronos.benchmark.configurations import SEED, write_configurations
from lerobot_env_cronos.benchmark.orderings import write_orderings
from lerobot_env_cronos.scene.scenes import get_scene


def main() -> None:
    """Write one file of a scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("configurations", "orderings"))
    parser.add_argument("scene")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of configurations; default: {SEED}")
    parser.add_argument("--output", type=Path, default=Path("."), help="folder")
    parser.add_argument("--discover_packages_path", help="package to import first, which registers the scene")
    args = parser.parse_args()
    try:
        if args.discover_packages_path is not None:
            import_module(args.discover_packages_path)
        name = get_scene(args.scene).name
        if args.what == "orderings":
            path = write_orderings(name, args.output)
        else:
            path = write_configurations(name, args.output, args.seed)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        parser.error(str(error))
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
