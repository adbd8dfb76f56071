"""Demonstrations and recorded streams as LeRobotDatasets."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "streams": "StreamDataset",
    },
)
