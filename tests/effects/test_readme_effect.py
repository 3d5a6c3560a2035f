"""The effect of one's own that the README shows works as it stands there."""

import re
from pathlib import Path

import numpy as np

from bayessim_jax.effects import EFFECTS, effect_places
from tests.effects.benches import pendulum, run, system

README = Path(__file__).parent.parent.parent / "README.md"


def test_the_readme_s_effect_is_registered_and_acts():
    (code,) = re.findall(r"```py\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in code.splitlines() if line]) < 20
    try:
        exec(compile(code, "README.md", "exec"), {})
        base = system(pendulum(), "bob")
        assert effect_places(EFFECTS["magnet"], base) == ["joint/hinge"]
        free, held = (run(base, [("magnet", "joint/hinge")], [k], np.zeros((100, 1)), 0.3, 0.0) for k in (0.0, 1.0))
        assert np.abs(np.asarray(free - held)).max() > 0.01
    finally:
        EFFECTS.pop("magnet", None)
