"""The paper's tables and figures, and few resets, as named experiments: what to train, how to run and draw it."""

from cronos_lerobot.experiments import few_resets as few_resets
from cronos_lerobot.experiments.definitions import CheckpointEvaluation, Experiment, Row, register_experiment

__all__ = ["CheckpointEvaluation", "Experiment", "Row", "register_experiment"]
