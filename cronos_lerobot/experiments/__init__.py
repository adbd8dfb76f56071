"""The paper's tables and figures as experiments."""

from cronos_lerobot.experiments.definitions import Experiment, Row, register_experiment

__all__ = ["Experiment", "Row", "register_experiment"]
