"""Benchmarks: each prints its ratio against a peer, measured in one run."""
