"""Steering: a small actor chooses the initial noise of a frozen policy (DSRL, Wagenmaker et al., 2025)."""
