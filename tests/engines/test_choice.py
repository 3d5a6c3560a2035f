"""Which engine is taken, what the tree engine refuses and how it says so."""

import mujoco
import pytest

from bayessim_jax.engines.choice import choose_engine
from bayessim_jax.engines.fields import find_writes, merge_writes
from bayessim_jax.engines.tree import TreeEngine, find_refusals
from tests.engines.mechanisms import HOPPER, MODELS, link, wrap

BALL = '<body name="b"><joint name="b" type="ball"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
TWO = link("l0", link("l1", pos="0 0 -0.4"))
REFUSED = {
    "joint/b is a ball joint": wrap(BALL),
    "joint/b is a free joint": wrap(BALL.replace('type="ball"', 'type="free"')),
    "joint/l0 has nonlinear damping": wrap(link("l0", joint='damping="1 2"')),
    "option/integrator is implicit": wrap(link("l0"), integrator="implicit"),
    "option/density is not zero": wrap(link("l0")).replace("<option ", '<option density="1" '),
    "body/l0 has gravity compensation": wrap(link("l0").replace('<body name="l0"', '<body name="l0" gravcomp="1"')),
    "equality/e is active": wrap(TWO, extra='<equality><joint name="e" joint1="l0" joint2="l1"/></equality>'),
    "the model has a tendon": wrap(TWO, extra='<tendon><fixed name="t"><joint joint="l0" coef="1"/></fixed></tendon>'),
    "actuator/a has a state of its own": wrap(link("l0"), '<general name="a" joint="l0" dyntype="filter"/>'),
    "actuator/a is neither": wrap(
        link("l0"), '<general name="a" joint="l0" gaintype="affine" gainprm="1 1 1" biastype="affine"/>'
    ),
    "geom/a and geom/b can touch": wrap(
        '<geom name="a" size="0.1"/>' + link("l0", '<geom name="b" size="0.1" mass="0"/>')
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_the_tree_engine_refuses_by_name(message):
    model = mujoco.MjModel.from_xml_string(REFUSED[message])
    assert any(r.startswith(message) for r in find_refusals(model))
    with pytest.raises(ValueError, match=message):
        TreeEngine(model)
    choice = choose_engine(model)
    assert choice.engine.name == "mujoco"
    assert message in choice.reason


def test_bodies_that_cannot_touch_are_taken():
    """Parent and child, geoms of one body, masks that do not meet, and excluded bodies."""
    geom = '<geom name="{0}" size="0.1" mass="0"/>'
    kin = link("l0", geom.format("a") + link("l1", geom.format("b")))
    assert find_refusals(mujoco.MjModel.from_xml_string(wrap(kin))) == []
    masked = '<geom size="0.1" contype="2" conaffinity="2"/>' + link("l0", geom.format("b"))
    assert find_refusals(mujoco.MjModel.from_xml_string(wrap(masked))) == []
    apart = link("l0", geom.format("a")) + link("l1", geom.format("b"))
    exclude = '<contact><exclude body1="l1" body2="l0"/></contact>'
    assert find_refusals(mujoco.MjModel.from_xml_string(wrap(apart, extra=exclude))) == []
    assert find_refusals(mujoco.MjModel.from_xml_string(wrap(apart))) == ["geom/a and geom/b can touch"]


def test_the_engine_asked_for_is_taken_or_refused():
    model = mujoco.MjModel.from_xml_string(MODELS["pendulum"])
    assert choose_engine(model).reason == "tree, which takes every element of this model"
    assert choose_engine(model, engine="mujoco").engine.name == "mujoco"
    with pytest.raises(ValueError, match=r"the tree engine does not take this model: .*can touch"):
        choose_engine(mujoco.MjModel.from_xml_string(HOPPER), engine="tree")
    with pytest.raises(ValueError, match="engine 'bullet': choose one of auto, tree, mujoco, mjx"):
        choose_engine(model, engine="bullet")
    assert choose_engine(model, sensors=["imu"]).reason.endswith("sensor/imu is observed")


def test_a_size_that_decides_an_inertia_is_left_to_the_compiler():
    xml = wrap(link("l0").replace("<inertial", '<geom name="g" size="0.1"/><!--').replace('0.002"/>', '0.002"/>-->'))
    spec = mujoco.MjSpec.from_string(xml)
    model = spec.compile()
    writes = merge_writes([find_writes(model, ["geom/g/size/0"], 0)])
    choice = choose_engine(model, writes, spec=spec)
    assert (choice.engine.name, "geom/g/size decides the inertia" in choice.reason) == ("mujoco", True)
    spec = mujoco.MjSpec.from_string(wrap(link("l0", '<geom name="g" size="0.1"/>')))
    model = spec.compile()
    writes = merge_writes([find_writes(model, ["geom/g/size/0"], 0)])
    assert choose_engine(model, writes, spec=spec).engine.name == "tree"
