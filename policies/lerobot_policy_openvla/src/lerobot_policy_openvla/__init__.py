"""OpenVLA for LeRobot."""
