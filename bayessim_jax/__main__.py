"""`python -m bayessim_jax` is the command `bayessim`."""

import sys

from bayessim_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
