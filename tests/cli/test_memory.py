"""What is freed goes back to the system."""

import subprocess
import sys

import pytest

SCRIPT = """
import numpy as np
from bayessim_jax.cli.memory import return_large_blocks

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096

assert return_large_blocks()
np.ones(3 * 2**20).sum()  # 24 MiB, freed: from here on the C library would take less than that from its heap
before = resident()
blocks, small = [], []
for _ in range(100):
    blocks.append(np.ones(2**18))  # 2 MiB
    small.append(bytearray(100_000))  # what lives on between them
del blocks
print((resident() - before) / 2**20)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux how much memory is held")
def test_freed_blocks_go_back_to_the_system():
    said = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert float(said.stdout) < 60.0
