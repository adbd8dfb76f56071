"""The paper's protocol: Algorithm 1 (`cronos_lerobot.protocol.rf_mtrl`), resets, task orders, counters."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "config": "ProtocolConfig",
        "interventions": "COUNTED_INTERVENTIONS Intervention",
        "loop_state": "Event LoopState SegmentEnd Step Update",
        "resets": "ResetStrategy Resets SceneReset make_resets register_reset",
        "run_context": "RunContext",
        "streams": "Streams",
        "task_orders": "TaskOrder TaskSet make_task_order register_task_order",
    },
)
