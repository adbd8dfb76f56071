"""Who learns: the interface of policies and agents, adapters of LeRobot's policies, PPO, imitation, steering."""

from cronos_lerobot.lazy import lazy_exports

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "base": "ActionSample LearningAgent TrainablePolicy",
        "registry": "AgentConfig AgentContext register_agent",
        "adapters.registry": "Adapter AdapterOptions register_adapter",
        "processing": "observation_columns",
    },
)
