"""What there is: scenes, bodies, the robot, their model and looks."""
