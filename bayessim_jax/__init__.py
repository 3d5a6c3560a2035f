"""Bayesian inference of simulator parameters from recordings, composed with the learning of a controller, in JAX."""

import os

__version__ = "0.1.0"

# XLA's pool has as many threads as the machine has cores, unless NPROC says otherwise. The operations of small networks
# and time steps take less time than to hand them to it, and jaxlib's batched LAPACK kernels wait in it for each other,
# for ever where they hold all of its threads. With one thread both are done where they are called.
os.environ.setdefault("NPROC", "1")

# XLA hands the operations of a time step to its pool one by one, which costs several times what they do. With this a
# loop over less than 8 MB is one piece of code, not only one over less than 1 KB.
_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=8000000"
_flags = os.environ.get("XLA_FLAGS", "")
if "xla_backend_extra_options" not in _flags:
    os.environ["XLA_FLAGS"] = f"{_flags} {_LOOPS}".strip()
