"""Bayesian inference of simulator parameters from recordings, composed with the learning of a controller, in JAX."""

__version__ = "0.1.0"
