"""Tables, figures and videos of runs and evaluations: `cronos-report`."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "load": "load_evaluations load_metrics",
    },
)
