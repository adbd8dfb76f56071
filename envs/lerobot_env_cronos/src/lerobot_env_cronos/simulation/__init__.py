"""How it moves and looks: physics, kinematics, observations, rendering."""
