"""Engines: what steps a system, and the Gymnasium target."""
