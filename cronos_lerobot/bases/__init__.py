"""The official base policies, a folder each; `benchmarks/official_bases.py` makes them."""

from pathlib import Path

OFFICIAL = Path(__file__).parent


def official_bases() -> list[str]:
    """Their names."""
    return sorted(config.parent.name for config in OFFICIAL.glob("*/config.json"))


def official_base(name: str) -> str:
    """The folder of the official base policy of this name; any other name, and a folder's, as it is."""
    return str(OFFICIAL / name) if name in official_bases() and not Path(name).is_dir() else name
