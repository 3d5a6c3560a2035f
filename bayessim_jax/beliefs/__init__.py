"""Beliefs over θ: uniform box, Gaussian mixture, truncated mixture, particles."""
