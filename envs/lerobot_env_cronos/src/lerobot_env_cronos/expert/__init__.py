"""The scripted expert, and how often it succeeds."""
