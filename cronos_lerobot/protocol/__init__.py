"""The paper's protocol: Algorithm 1, resets, task orders, counting, areas."""
