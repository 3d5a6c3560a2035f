"""A real free-swinging arm: the length that the loop infers agrees with the one that the period gives."""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
CASES = Path(os.environ.get("BAYESSIM_CASES", ROOT.parent / "shared" / "data" / "cases"))
RECORDINGS = CASES / "multiarm_single" / "recordings"


@pytest.mark.slow
@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the recordings of the real arm are not here; set BAYESSIM_CASES")
def test_length_of_a_real_arm_agrees_with_its_period():
    spec = importlib.util.spec_from_file_location("real_pendulum", ROOT / "scripts" / "real_pendulum.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    paths = sorted(RECORDINGS.glob("*.csv"))
    reference = float(np.mean([script.length_from_period(path) for path in paths]))
    _, trace = script.infer([w for path in paths for w in script.windows(path)[:3]])
    mean, sd, _ = trace[-1]
    assert abs(mean / reference - 1) < 0.03
    assert sd < trace[0][1]
