"""Contacts and limits that no recording reaches are left out, and others are not."""

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


@pytest.mark.parametrize(("height", "options"), [(-0.45, {}), (-2, {"whole": True}), (-2, {"engine": "mujoco"})])
def test_a_floor_that_is_touched_or_asked_for_stays(tmp_path, height, options):
    model = made(tmp_path, height, **options)
    assert model.engine_name == "mujoco"
    assert not model.remarks
    assert EFFECTS["contact_friction"].places(model.compiled)


@pytest.mark.parametrize(("z", "radius", "engine"), [(0.0, 0.02, "tree"), (-0.4, 0.05, "mujoco")])
def test_what_is_near_by_design_does_not_touch(tmp_path, z, radius, engine):
    """A ball 2 mm beside the pivot is as near at every angle; one 2 mm beside the lowest place of the bob is passed."""
    beside = f'<geom name="beside" type="sphere" size="0.03" pos="0 {0.032 + radius} {z}"/>'
    model = MODEL.replace("<worldbody>", "<worldbody>" + beside)
    case = load_case(write_case(tmp_path / "case", model=model, run1=columns())).check()
    assert case_model(case).engine_name == engine


@pytest.mark.parametrize(("low", "limited"), [(-170, False), (-58, True)])
def test_limits_that_no_recording_comes_near_are_left_out(tmp_path, low, limited):
    """The swing goes from −50 to 57 degrees: a limit at −58 is nearer than a tenth of that."""
    model = MODEL.replace('damping="0.05"', f'damping="0.05" limited="true" range="{low} 230"')
    case = load_case(write_case(tmp_path / "case", model=model, run1=columns())).check()
    found = case_model(case)
    assert found.compiled.jnt_limited.tolist() == [limited]
    assert ("limits of one joint are left out: the recordings do not come near" in found.remarks) == (not limited)
    assert case_model(case, whole=True).compiled.jnt_limited.tolist() == [True]
