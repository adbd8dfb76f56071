"""The SO-101 with LeRobot's own features: joints in degrees, absolute targets, 30 Hz."""
