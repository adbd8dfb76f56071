"""Figures, tables and videos of runs: `cronos-report`, and the pictures of the documentation."""
