"""Paths to parameters, and values written through them against MJCF in which they were written by hand."""

import mujoco
import numpy as np
import pytest

from bayessim_jax.recordings.augment import write_values
from bayessim_jax.recordings.paths import FIELDS, element_names, find_target, nominal

TEMPLATE = """
<mujoco>
  <compiler angle="{angle}" {compiler}/>
  <option gravity="0 0 {gravity}"/>
  <worldbody>
    <body name="left/arm">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}" armature="{armature}" stiffness="{stiffness}"
        springref="{springref}" frictionloss="{frictionloss}"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.1 0 -0.4" size="{radius}" friction="{friction} 0.01 0.001"/>
      <body name="bob" pos="0 0 -0.4">
        <inertial pos="{com} 0 0.1" mass="{mass}" diaginertia="{ix} {iy} {iz}"/>
        <joint name="slide" type="slide" axis="1 0 0"/>
        <geom name="ball" type="sphere" size="0.05"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" gear="{gear}" ctrlrange="-{limit} {limit}"/>
    <position name="servo" joint="slide" kp="{kp}"/>
    <velocity name="speed" joint="slide" kv="{kv}"/>
  </actuator>
</mujoco>
"""
PLAIN = {
    "angle": "radian", "compiler": "", "gravity": -9.81, "damping": 0.1, "armature": 0.01, "stiffness": 2.0,
    "springref": 0.3, "frictionloss": 0.05, "radius": 0.02, "friction": 0.7, "com": 0.0, "mass": 0.5, "ix": 0.004,
    "iy": 0.003, "iz": 0.002, "gear": 3.0, "limit": 2.0, "kp": 5.0, "kv": 1.5,
}  # fmt: skip

WRITTEN = {
    # path: (value, what a person would write into the file)
    "body/bob/mass": (0.8, {"mass": 0.8, "ix": 0.0064, "iy": 0.0048, "iz": 0.0032}),
    "body/bob/ipos/0": (0.03, {"com": 0.03}),
    "joint/hinge/damping": (0.4, {"damping": 0.4}),
    "joint/hinge/armature": (0.03, {"armature": 0.03}),
    "joint/hinge/stiffness": (7.0, {"stiffness": 7.0}),
    "joint/hinge/springref": (-0.5, {"springref": -0.5}),
    "joint/hinge/frictionloss": (0.2, {"frictionloss": 0.2}),
    "geom/rod/friction/0": (0.3, {"friction": 0.3}),
    "geom/rod/size/0": (0.03, {"radius": 0.03}),
    "actuator/motor/gear": (4.0, {"gear": 4.0}),
    "actuator/motor/gear/0": (4.0, {"gear": 4.0}),
    "actuator/motor/ctrlrange": (3.0, {"limit": 3.0}),
    "actuator/servo/gain": (9.0, {"kp": 9.0}),
    "actuator/speed/gain": (2.5, {"kv": 2.5}),
    "option/gravity/2": (-1.62, {"gravity": -1.62}),
}


def fresh(**changes):
    return mujoco.MjModel.from_xml_string(TEMPLATE.format(**(PLAIN | changes)))


def spec(**changes):
    return mujoco.MjSpec.from_string(TEMPLATE.format(**(PLAIN | changes)))


def numeric_fields(model):
    names = [name for name in dir(model) if name.startswith(("body_", "dof_", "jnt_", "geom_", "actuator_", "qpos"))]
    return {name: np.asarray(getattr(model, name)) for name in names} | {"gravity": model.opt.gravity}


def assert_same(model, other, rtol=1e-9):
    theirs = numeric_fields(other)
    for name, mine in numeric_fields(model).items():
        if mine.dtype.kind in "fiub":
            np.testing.assert_allclose(mine, theirs[name], rtol=rtol, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("path", WRITTEN)
def test_a_value_written_through_a_path_is_that_of_a_file_with_it(path):
    value, changes = WRITTEN[path]
    before = spec()
    target = find_target(path, fresh())
    assert nominal(target, fresh()) != pytest.approx(value)
    model = write_values(before, {target: value})
    assert nominal(target, model) == pytest.approx(value, rel=1e-12)
    assert_same(model, fresh(**changes))
    assert_same(mujoco.MjModel.from_xml_string(before.to_xml()), model, rtol=1e-5)  # to_xml writes 6 digits


def test_several_values_are_written_at_once():
    values, changes = {}, {}
    for path in ("body/bob/mass", "body/bob/ipos/0", "joint/hinge/damping", "geom/rod/size/0", "option/gravity/2"):
        values[find_target(path, fresh())] = WRITTEN[path][0]
        changes |= WRITTEN[path][1]
    assert_same(write_values(spec(), values), fresh(**changes))


def test_a_spring_reference_is_in_radians_whatever_the_file_says():
    model = write_values(spec(angle="degree"), {find_target("joint/hinge/springref", fresh()): 0.8})
    assert model.qpos_spring[0] == pytest.approx(0.8)


def test_a_mass_from_geoms_scales_the_inertia_and_leaves_the_other_bodies_alone():
    before = fresh()
    target = find_target("body/left/arm/mass", before)
    i, bob = target.id(before), before.body("bob").id
    model = write_values(spec(), {target: 2 * before.body_mass[i]})
    np.testing.assert_allclose(model.body_inertia[i], 2 * before.body_inertia[i], rtol=1e-9)
    np.testing.assert_allclose(model.body_ipos[i], before.body_ipos[i], atol=1e-12)
    np.testing.assert_allclose(model.body_inertia[bob], before.body_inertia[bob], rtol=1e-9)
    assert model.body_mass[bob] == before.body_mass[bob]


@pytest.mark.parametrize("compiler", ['inertiafromgeom="true"', 'settotalmass="4"'])
def test_a_mass_is_written_where_the_compiler_would_set_it(compiler):
    before = fresh(compiler=compiler)
    target = find_target("body/bob/mass", before)
    model = write_values(spec(compiler=compiler), {target: 1.25})
    others = [i for i in range(model.nbody) if i != target.id(model)]
    assert nominal(target, model) == pytest.approx(1.25)
    np.testing.assert_allclose(model.body_mass[others], before.body_mass[others], rtol=1e-9)
    np.testing.assert_allclose(model.body_inertia[others], before.body_inertia[others], rtol=1e-9)


def test_the_length_of_a_capsule_given_by_its_ends():
    before = fresh()
    target = find_target("geom/rod/size/1", before)
    model = write_values(spec(), {target: 2 * before.geom("rod").size[1]})
    assert model.geom("rod").size[1] == pytest.approx(2 * before.geom("rod").size[1])
    np.testing.assert_allclose(model.geom("rod").pos, before.geom("rod").pos, atol=1e-12)


def test_a_range_that_is_not_symmetric_keeps_its_shape():
    model = write_values(
        mujoco.MjSpec.from_string(TEMPLATE.format(**PLAIN).replace('ctrlrange="-2.0 2.0"', 'ctrlrange="-1 2"')),
        {find_target("actuator/motor/ctrlrange", fresh()): 3.0},
    )
    np.testing.assert_allclose(model.actuator("motor").ctrlrange, [-1.5, 3.0])


def test_a_name_may_contain_slashes():
    target = find_target("body/left/arm/ipos/2", fresh())
    assert (target.name, target.field, target.index, str(target)) == ("left/arm", "ipos", 2, "body/left/arm/ipos/2")


def test_every_path_of_the_model_resolves_to_itself():
    model, count = fresh(), 0
    for kind, fields in FIELDS.items():
        for name in element_names(model, kind):
            for word, field in fields.items():
                path = "/".join(part for part in (kind, name, word, "0" if field.size else "") if part)
                try:
                    assert str(find_target(path, model)) == path
                    count += 1
                except ValueError as error:
                    assert "has to" in str(error) or "no ctrlrange" in str(error), path
    assert count > 25


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("body/world/mass", "no such body"),
        ("joint/hinge/damping/0", "damping is one number; leave out '/0'"),
        ("body/bob/mas", "did you mean 'body/bob/mass'?"),
        ("body/bob", "did you mean 'body/bob/mass'?"),
        ("Joint/hinge/damping", "did you mean 'joint/hinge/damping'"),
        ("option/gravity", "needs an index"),
        ("body/bob/ipos/x", "needs an index"),
        ("body/bob/ipos/²", "needs an index"),
        ("geom/ball/size/1", "has 1 sizes that can be set"),
        ("actuator/servo/ctrlrange", "no ctrlrange above 0 to scale"),
        ("", "unknown path ''"),
        ("\x1b[2J/x/y", r"'\x1b[2J/x/y'"),
    ],
)
def test_a_path_that_leads_nowhere(path, message):
    with pytest.raises(ValueError, match="path") as error:
        find_target(path, fresh())
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_value_that_the_compiler_changes_is_refused():
    bounded = spec(compiler='boundmass="1"')
    with pytest.raises(ValueError, match=r"body/bob/mass was set to 0\.5 but is 1"):
        write_values(bounded, {find_target("body/bob/mass", fresh()): 0.5})
