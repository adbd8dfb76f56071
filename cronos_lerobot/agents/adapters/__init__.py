"""What makes LeRobot's own policies say how likely their decisions were."""
