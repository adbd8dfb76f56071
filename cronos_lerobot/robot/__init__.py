"""Practice on one LeRobot robot, simulated or real: `--env.type=cronos_robot`."""
