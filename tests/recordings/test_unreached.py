"""Contacts that no recording makes are left out, and others are not."""

import pytest

from bayessim_jax.effects import EFFECTS
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model
from tests.recordings.made_up_case import MODEL, columns, write_case


def made(tmp_path, height, **options):
    model = MODEL.replace('pos="0 0 -2"', f'pos="0 0 {height}"')
    return case_model(load_case(write_case(tmp_path / "case", model=model, run1=columns())).check(), **options)


def test_a_floor_that_nothing_reaches_is_left_out_and_told(tmp_path):
    model = made(tmp_path, -2)
    assert model.engine_name == "tree"
    assert model.remarks == ("contacts are left out: nothing touches in the recordings",)
    assert EFFECTS["contact_friction"].places(model.compiled) == []


@pytest.mark.parametrize(("height", "options"), [(-0.45, {}), (-2, {"contacts": True}), (-2, {"engine": "mujoco"})])
def test_a_floor_that_is_touched_or_asked_for_stays(tmp_path, height, options):
    model = made(tmp_path, height, **options)
    assert model.engine_name == "mujoco"
    assert not model.remarks
    assert EFFECTS["contact_friction"].places(model.compiled)
