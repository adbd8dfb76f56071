"""Evaluation of any LeRobot policy on the benchmark's two suites; see docs/evaluation.md."""
