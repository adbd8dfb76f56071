"""How time is cut up and contacts are softened: the numbers that trade speed against honest physics."""

from dataclasses import dataclass

import mujoco

from lerobot_env_cronos.scene.scenes import CONTROL_HZ

RAMP_CHUNKS, RAMP_SHARE = 8, 0.9
"""The joint targets move linearly in 8 chunks over most of a control step. Without that, what is held slips."""
SETTLE_CHUNK_S = 0.1
"""How often bodies that settle are looked at [s]."""


@dataclass(frozen=True)
class Physics:
    """A time step and an integrator; all else follows from the time step."""

    timestep_s: float
    integrator: mujoco.mjtIntegrator

    @property
    def substeps(self) -> int:
        """Physics steps of a control step."""
        return round(1 / (CONTROL_HZ * self.timestep_s))

    @property
    def chunk_substeps(self) -> int:
        """Physics steps of one chunk of the ramp."""
        return round(RAMP_SHARE * self.substeps / RAMP_CHUNKS)

    @property
    def settle_substeps(self) -> int:
        """Physics steps between two looks at bodies that settle."""
        return round(SETTLE_CHUNK_S / self.timestep_s)

    @property
    def solref(self) -> tuple[float, float]:
        """Time constant [s] and damping ratio of contacts: as stiff as the time step allows, 2 dt."""
        return 2 * self.timestep_s, 1.0


# With the implicit integrators what a hand holds slips up to three times as far at long time steps
# (`cronos_lerobot.studies.physics_check`): they damp the arm after the contacts were solved.
PHYSICS = Physics(0.008, mujoco.mjtIntegrator.mjINT_EULER)
"""That of the environments."""
PHYSICS_V0 = Physics(0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
"""That of the environments of version 0, to compare with."""
