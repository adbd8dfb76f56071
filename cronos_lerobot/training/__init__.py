"""Everything around Algorithm 1: configuration, checkpoints, logs, evaluation."""
