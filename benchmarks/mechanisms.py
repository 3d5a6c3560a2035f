"""Models for the benchmark of the engines, and which of their numbers are parameters."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

__all__ = ["CONTACT_MODELS", "SMOOTH_MODELS", "Mechanism", "all_parameters"]


@dataclass(frozen=True)
class Mechanism:
    """A model, and how many time steps a control is held."""

    xml: str
    substeps: int = 1

    def compile(self) -> mujoco.MjModel:
        """The compiled model."""
        return mujoco.MjModel.from_xml_string(self.xml)


def all_parameters(model: mujoco.MjModel) -> list[str]:
    """Every mass, damping, armature, length, centre of mass, gear, and gravity, where it is not zero."""
    paths = []
    for body in range(1, model.nbody):
        name = model.body(body).name
        paths.append(f"body/{name}/mass")
        for field, values in (("ipos", model.body_ipos[body]), ("pos", model.body_pos[body])):
            paths += [f"body/{name}/{field}/{k}" for k in range(3) if values[k] != 0.0]
    for joint in range(model.njnt):
        paths += [f"joint/{model.joint(joint).name}/{field}" for field in ("damping", "armature")]
    paths += [f"actuator/{model.actuator(i).name}/gear" for i in range(model.nu)]
    return [*paths, "option/gravity/2"]


def _smooth(body: str, joints: list[str]) -> Mechanism:
    motors = "".join(f'<motor name="{j}" joint="{j}" gear="{4 - 0.5 * i}"/>' for i, j in enumerate(joints))
    return Mechanism(
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        f'<default><joint damping="0.1" armature="0.01"/></default><worldbody>{body}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def _link(name: str, axis: str, pos: str, com: str, mass: float, inside: str = "", kind: str = "hinge") -> str:
    inertia = " ".join(f"{mass * x:.6g}" for x in (0.012, 0.011, 0.003))
    return (
        f'<body name="{name}" pos="{pos}"><joint name="{name}" type="{kind}" axis="{axis}"/>'
        f'<inertial pos="{com}" mass="{mass}" diaginertia="{inertia}"/>{inside}</body>'
    )


ROD = "0 0 -0.2"
SMOOTH_MODELS = {
    "pendulum": _smooth(_link("rod", "0 1 0", "0 0 0", ROD, 1.0), ["rod"]),
    "cart-pole": _smooth(
        _link("cart", "1 0 0", "0 0 0", "0 0 0", 1.0, _link("pole", "0 1 0", "0 0 0", ROD, 0.3), "slide"), ["cart"]
    ),
    "double pendulum": _smooth(
        _link("upper", "0 1 0", "0 0 0", ROD, 1.0, _link("lower", "0 1 0", "0 0 -0.4", ROD, 0.6)), ["upper", "lower"]
    ),
    "3-joint arm": _smooth(
        _link(
            "waist",
            "0 0 1",
            "0 0 0.1",
            "0 0 0.05",
            3.0,
            _link(
                "shoulder",
                "0 1 0",
                "0 0.12 0.16",
                "0.2 0 0",
                4.0,
                _link("elbow", "0 1 0", "0.42 -0.1 0", "0.18 0 0.02", 2.0),
            ),
        ),
        ["waist", "shoulder", "elbow"],
    ),
    "6-joint arm": _smooth(
        _link(
            "waist",
            "0 0 1",
            "0 0 0.1",
            "0 0.01 0.05",
            3.7,
            _link(
                "shoulder",
                "0 1 0",
                "0 0.13 0.06",
                "0 0 0.2",
                8.4,
                _link(
                    "elbow",
                    "0 1 0",
                    "0 -0.12 0.42",
                    "0 0 0.18",
                    2.3,
                    _link(
                        "wrist_1",
                        "0 1 0",
                        "0 0 0.39",
                        "0 0.12 0",
                        1.2,
                        _link(
                            "wrist_2",
                            "0 0 1",
                            "0 0.13 0",
                            "0 0 0.09",
                            1.2,
                            _link("wrist_3", "0 1 0", "0 0 0.1", "0 0.08 0", 0.25),
                        ),
                    ),
                ),
            ),
        ),
        ["waist", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3"],
    ),
}

HOPPER = """
<mujoco><option timestep="0.002" integrator="RK4"/>
<default><joint damping="1" armature="1"/><geom conaffinity="1" condim="1" contype="1" margin="0.001" friction="0.8"/>
<motor ctrllimited="true" ctrlrange="-0.4 0.4"/></default>
<worldbody><geom name="floor" type="plane" size="20 20 1" condim="3"/>
<body name="torso" pos="0 0 1.25">
  <joint name="rootx" type="slide" axis="1 0 0" armature="0" damping="0"/>
  <joint name="rootz" type="slide" axis="0 0 1" armature="0" damping="0"/>
  <joint name="rooty" axis="0 1 0" armature="0" damping="0"/>
  <geom type="capsule" fromto="0 0 0.2 0 0 -0.2" size="0.05"/>
  <body name="thigh" pos="0 0 -0.2"><joint name="hip" axis="0 -1 0" range="-150 0" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.45" size="0.05"/>
    <body name="leg" pos="0 0 -0.45"><joint name="knee" axis="0 -1 0" range="-150 0" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.04"/>
      <body name="foot" pos="0 0 -0.5"><joint name="ankle" axis="0 -1 0" range="-45 45" limited="true"/>
        <geom name="foot" type="capsule" fromto="-0.13 0 -0.1 0.26 0 -0.1" size="0.06" friction="2"/>
</body></body></body></body></worldbody>
<actuator><motor name="hip" joint="hip" gear="200"/><motor name="knee" joint="knee" gear="200"/>
<motor name="ankle" joint="ankle" gear="200"/></actuator></mujoco>
"""


def _fetch() -> str:
    """A lift, seven joints, two fingers, a table and a free box: the size of a Fetch manipulating an object."""
    axes = ["0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"]
    arm = (
        '<geom type="box" size="0.05 0.07 0.03" contype="0" conaffinity="0"/>'
        '<body name="left" pos="0.08 0.05 0"><joint name="left" type="slide" axis="0 1 0" range="0 0.05" '
        'limited="true" damping="100"/><geom type="box" size="0.03 0.007 0.012" friction="1 0.05 0.01"/></body>'
        '<body name="right" pos="0.08 -0.05 0"><joint name="right" type="slide" axis="0 -1 0" range="0 0.05" '
        'limited="true" damping="100"/><geom type="box" size="0.03 0.007 0.012" friction="1 0.05 0.01"/></body>'
    )
    for i in reversed(range(7)):
        arm = (
            f'<body name="arm{i}" pos="0.13 0 0"><joint name="arm{i}" axis="{axes[i]}" damping="20" armature="0.1"/>'
            f'<geom type="capsule" fromto="0 0 0 0.12 0 0" size="0.05" contype="0" conaffinity="0"/>{arm}</body>'
        )
    servos = "".join(f'<position name="arm{i}" joint="arm{i}" kp="800"/>' for i in range(7))
    fingers = "".join(f'<position name="{f}" joint="{f}" kp="3000" ctrlrange="0 0.05"/>' for f in ("left", "right"))
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        '<geom type="plane" size="3 3 1"/><geom type="box" size="0.25 0.35 0.2" pos="1.1 0 0.2"/>'
        '<body name="lift" pos="0 0 0.35"><joint name="lift" type="slide" axis="0 0 1" damping="1000"/>'
        f'<geom type="box" size="0.2 0.2 0.1" contype="0" conaffinity="0"/>{arm}</body>'
        '<body name="box" pos="1.15 0 0.43"><freejoint/><geom type="box" size="0.025 0.025 0.025" mass="0.5"/></body>'
        f'</worldbody><actuator><position name="lift" joint="lift" kp="30000" kv="2000"/>{servos}{fingers}</actuator>'
        "</mujoco>"
    )


CONTACT_MODELS = {"hopper": Mechanism(HOPPER, 4), "Fetch-sized": Mechanism(_fetch(), 20)}
