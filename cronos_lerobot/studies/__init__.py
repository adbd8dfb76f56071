"""Longer measurements, each a command."""
