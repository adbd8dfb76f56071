"""Drawing of pictures and videos."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "encode": "write_mp4",
        "overlay": "Status draw_status",
        "suites": "draw_suite",
    },
)
