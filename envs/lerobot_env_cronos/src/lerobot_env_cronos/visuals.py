"""How the scene looks: visual geometry without mass or contacts, materials, lights."""

import mujoco


def dress(spec: mujoco.MjSpec, bodies: dict[str, mujoco.MjsBody]) -> None:
    """Add visual geometry to everything in `spec`; changes no dynamics."""
