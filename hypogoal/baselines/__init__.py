"""Comparison agents with the primitive actions (Spec E7): stable-baselines3's PPO and DQN on an engine."""
