"""A training run: configuration, trainer, checkpoints, logs."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "config": "CronosTrainConfig",
    },
)
