"""The adapters of this package; importing it registers them."""

from cronos_lerobot.agents.adapters import act, diffusion, pi0, pocketvla, smolvla

__all__ = ["act", "diffusion", "pi0", "pocketvla", "smolvla"]
