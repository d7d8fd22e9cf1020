"""Comparison agents with the primitive actions: stable-baselines3's PPO and DQN on an engine."""
