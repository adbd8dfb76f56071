"""Imitation of a stream's own successes."""
