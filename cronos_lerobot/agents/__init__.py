"""Who learns: the interface that every agent and policy has, and PPO."""
