"""How time is cut up and contacts are softened: the numbers that trade speed against honest physics."""

import mujoco

from lerobot_env_cronos.scene.scenes import CONTROL_HZ

TIMESTEP_S = 0.008
# With the implicit integrators what a hand holds slips up to three times as far at long time steps: they damp the
# arm after the contacts were solved.
INTEGRATOR = mujoco.mjtIntegrator.mjINT_EULER
SUBSTEPS = round(1 / (CONTROL_HZ * TIMESTEP_S))
"""Physics steps of a control step."""

RAMP_CHUNKS, RAMP_SHARE = 8, 0.9
"""The joint targets move linearly in 8 chunks over most of a control step. Without that, what is held slips."""
CHUNK_SUBSTEPS = round(RAMP_SHARE * SUBSTEPS / RAMP_CHUNKS)
"""Physics steps of one chunk of the ramp."""

SETTLE_CHUNK_S = 0.1
"""How often bodies that settle are looked at [s]."""
SETTLE_SUBSTEPS = round(SETTLE_CHUNK_S / TIMESTEP_S)

SOLREF = (2 * TIMESTEP_S, 1.0)
"""Time constant [s] and damping ratio of contacts: as stiff as the time step allows, 2 dt."""
