"""The WidowX-250S, with its published kinematics and the Bridge set-up's home pose, camera and actions."""
