"""The adapters of this package; importing it registers them."""

from cronos_lerobot.agents.adapters import act, pi0, pocketvla, smolvla

__all__ = ["act", "pi0", "pocketvla", "smolvla"]
