"""CRONOS for LeRobot: reset-free multi-task reinforcement learning of robot policies.

What is listed in `__all__`, here and in the rooms below, is public.
"""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "agents": "ActionSample Adapter AgentConfig LearningAgent TrainablePolicy register_adapter register_agent",
        "data": "StreamDataset",
        "experiments": "Experiment Row register_experiment",
        "protocol": "Intervention LoopState ProtocolConfig ResetStrategy RunContext SceneReset SegmentEnd Step "
        "Streams TaskOrder Update register_reset register_task_order",
        "report": "load_evaluations load_metrics",
    },
)
