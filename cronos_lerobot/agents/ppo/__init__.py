"""Proximal policy optimisation over reset-free streams."""
