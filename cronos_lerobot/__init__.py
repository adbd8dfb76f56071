"""CRONOS for LeRobot: reset-free multi-task reinforcement learning of robot policies."""
