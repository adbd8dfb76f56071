"""Evaluation of any LeRobot policy: single tasks, sequences, and streams that nobody resets."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "actors": "Actor ExpertActor load_actor make_actor",
        "chains": "Chain ChainRunner Rules",
        "config": "CronosEvalConfig SuitesConfig",
        "results": "find_results find_videos read_results",
        "runner": "Evaluation",
        "suites": "make_chains",
    },
)
