"""What makes LeRobot's own policies say how likely their decisions were; importing it registers all of them."""

from cronos_lerobot.agents.adapters import act, diffusion, pocketvla, vla

__all__ = ["act", "diffusion", "pocketvla", "vla"]
