"""The WidowX's kinematics, and rotations, where packages that know one arm look for them."""

from lerobot_env_cronos.scene.arms.widowx.kinematics import forward_kinematics as forward_kinematics
from lerobot_env_cronos.scene.arms.widowx.kinematics import inverse_kinematics as inverse_kinematics
from lerobot_env_cronos.scene.rotations import matrix_to_rotation_vector as matrix_to_rotation_vector
from lerobot_env_cronos.scene.rotations import quaternion_to_matrix as quaternion_to_matrix
from lerobot_env_cronos.scene.rotations import rotation_vector_to_matrix as rotation_vector_to_matrix
