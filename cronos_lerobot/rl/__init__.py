"""Reinforcement learning: the policy's interface, rollouts, advantages, PPO."""
