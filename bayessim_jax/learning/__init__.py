"""Learners: PPO and SAC, jitted, θ redrawn from the belief at every episode."""
