"""The paper's tables and figures as named experiments: what to train, how to run it, how to draw it."""

from cronos_lerobot.experiments.definitions import CheckpointEvaluation, Experiment, Row, register_experiment

__all__ = ["CheckpointEvaluation", "Experiment", "Row", "register_experiment"]
