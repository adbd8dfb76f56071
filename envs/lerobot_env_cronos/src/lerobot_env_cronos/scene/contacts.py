"""What every contact of a scene has in common."""

CONTACT_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
"""Impedance of contacts; their time constant is the model's default (`model.SOLREF`)."""
