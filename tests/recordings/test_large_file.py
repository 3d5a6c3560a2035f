"""A recording of ten million rows is checked within 4 GiB."""

import subprocess
import sys

import numpy as np
import pytest

from tests.recordings.made_up_case import write_case

ROWS = 10_000_000


@pytest.mark.slow
def test_ten_million_rows_are_checked_within_four_gibibytes(tmp_path):
    import pyarrow as pa
    from pyarrow import csv

    folder = write_case(tmp_path)
    time = np.arange(ROWS) * 0.001
    table = {"time": time, "joint/hinge/qpos": np.sin(time), "actuator/motor/ctrl": np.zeros(ROWS), "unused": time}
    csv.write_csv(pa.table(table), folder / "recordings" / "run1.csv")
    del table, time
    # of the command itself: what `resource` tells of a child includes the process that it was forked from
    peak = "print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    code = f"import sys\nfrom bayessim_jax.cli.main import main\ncode = main(sys.argv[1:])\n{peak}\nsys.exit(code)"
    done = subprocess.run(
        [sys.executable, "-c", code, "check", str(folder)], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert "10000000 rows, 1e+04 s at 1000 Hz" in done.stdout
    assert "unknown column 'unused' is not used" in done.stdout
    assert int(done.stdout.split("VmHWM:")[1].split()[0]) * 1024 < 4 * 2**30
