"""The paper's tables and figures as named experiments: what to train, how to run it, how to draw it."""
