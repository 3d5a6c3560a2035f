"""Bayesian inference of simulator parameters from recordings, composed with the learning of a controller, in JAX."""

import os

__version__ = "0.1.0"

# XLA's pool has as many threads as the machine has cores, unless NPROC says otherwise. In it jaxlib's batched LAPACK
# kernels wait for each other: on a machine with two cores two of them at once wait for ever.
os.environ.setdefault("NPROC", str(max(os.cpu_count() or 1, 16)))
