"""Small models that every engine is tried on."""

OPTION = '<compiler angle="radian"/><option timestep="0.002" integrator="{integrator}"/>'


def wrap(body, actuator="", integrator="implicitfast", extra=""):
    return (
        f"<mujoco>{OPTION.format(integrator=integrator)}<worldbody>{body}</worldbody>"
        f"<actuator>{actuator}</actuator>{extra}</mujoco>"
    )


def link(name, inner="", pos="0 0 0", axis="0 1 0", kind="hinge", joint="", inertial=None, quat="1 0 0 0"):
    inertial = inertial or 'pos="0 0 -0.2" mass="0.8" diaginertia="0.012 0.011 0.002"'
    return (
        f'<body name="{name}" pos="{pos}" quat="{quat}"><joint name="{name}" type="{kind}" axis="{axis}" {joint}/>'
        f"<inertial {inertial}/>{inner}</body>"
    )


OBLIQUE = 'pos="0.02 -0.03 0.1" mass="1.1" fullinertia="0.02 0.03 0.018 0.002 -0.003 0.001"'


def arm(joints):
    axes = ["0 0 1", "0 1 0", "0.6 0.8 0", "1 0 0", "0 1 0", "1 0 0"]
    body = ""
    for i in reversed(range(joints)):
        quat = "1 0 0 0" if i % 2 == 0 else "0.9238795325112867 0.3826834323650898 0 0"
        joint = 'damping="0.15" armature="0.02"'
        body = link(f"l{i}", body, "0.03 0.02 0.25", axes[i], joint=joint, inertial=OBLIQUE, quat=quat)
    motors = "".join(f'<motor name="m{i}" joint="l{i}" gear="{3 - 0.3 * i}"/>' for i in range(joints))
    return wrap(body, motors)


PENDULUM = wrap(link("l0", joint='damping="0.05"'), '<motor name="m0" joint="l0" gear="2"/>')
MODELS = {
    "pendulum": PENDULUM,
    "cart_pole": wrap(
        link("cart", link("pole"), kind="slide", axis="1 0 0", joint='damping="0.3" armature="0.1"'),
        '<motor name="push" joint="cart" ctrllimited="true" ctrlrange="-2 2" gear="3"/>',
    ),
    "double_pendulum": wrap(
        link("l0", link("l1", pos="0 0 -0.4")), '<motor name="m0" joint="l0"/><motor name="m1" joint="l1"/>'
    ),
    "spatial_arm": arm(3),
    "six_joint_arm": arm(6),
    "springs": wrap(
        link(
            "l0",
            link("l1", pos="0 0 -0.4", axis="1 0 0", joint='stiffness="3" damping="0.2"'),
            joint='stiffness="5" springref="0.4" ref="0.1" pos="0.05 0 0.1"',
        )
        + link("l2", pos="1 0 0", axis="0 -1 0", joint='armature="0.3"'),
        '<position name="servo" joint="l0" kp="20" kv="2" forcelimited="true" forcerange="-4 4"/>'
        '<velocity name="speed" joint="l1" kv="1.5"/>',
    ),
    "two_joints_per_body": wrap(
        '<body name="puck"><joint name="x" type="slide" axis="1 0 0" damping="0.4"/>'
        '<joint name="y" type="slide" axis="0.6 0.8 0"/><joint name="turn" axis="0 0 1" pos="0.1 0.05 0"/>'
        f'<inertial {OBLIQUE}/><body name="fixed" pos="0.1 0 0.2" quat="0.8 0.6 0 0"><inertial {OBLIQUE}/>'
        + link("l0", pos="0 0.1 0", axis="1 1 0")
        + "</body></body>",
        '<motor name="push" joint="x"/><motor name="spin" joint="turn" gear="0.5"/>',
        integrator="Euler",
    ),
    "limits": wrap(
        link("l0", link("l1", pos="0 0 -0.4", joint='range="-0.3 0.5" limited="true" margin="0.02"'))
        + link(
            "l2",
            pos="1 0 0",
            joint='range="-0.2 0.2" limited="true" solreflimit="-900 -40" solimplimit="0.8 0.9 0.01 0.4 3"',
        ),
        '<motor name="m0" joint="l0" gear="2"/><motor name="m1" joint="l1"/>',
    ),
    "dry_friction": wrap(
        link(
            "l0",
            link("l1", link("l2", pos="0 0 -0.4", axis="1 0 0", joint='frictionloss="0.2"'), pos="0 0 -0.4"),
            joint='frictionloss="0.8" damping="0.1" range="-0.7 0.4" limited="true"',
        ),
        '<motor name="m0" joint="l0" gear="4"/><motor name="m2" joint="l2" gear="0.5"/>',
        integrator="Euler",
    ),
    "coupled_constraints": arm(4).replace("damping=", 'frictionloss="0.5" range="-0.9 0.9" limited="true" damping='),
    "runge_kutta": wrap(link("l0", link("l1", pos="0 0 -0.4")), '<motor name="m0" joint="l0"/>', integrator="RK4"),
}

HOPPER = wrap(
    '<geom name="floor" type="plane" size="5 5 1"/>'
    '<body name="torso" pos="0 0 1.2"><joint name="rootx" type="slide" axis="1 0 0"/>'
    '<joint name="rootz" type="slide" axis="0 0 1"/><joint name="rooty" axis="0 1 0"/>'
    '<geom name="torso" type="capsule" size="0.05 0.2" friction="0.9"/>'
    '<body name="leg" pos="0 0 -0.2"><joint name="hip" axis="0 -1 0" range="-2 0.1" limited="true" damping="1"/>'
    '<geom name="leg" type="capsule" size="0.04 0.25" pos="0 0 -0.25"/>'
    '<body name="foot" pos="0 0 -0.5"><joint name="ankle" axis="0 -1 0" damping="1" armature="0.1"/>'
    '<geom name="foot" type="capsule" size="0.06 0.2" quat="0.7071 0 0.7071 0" pos="0.05 0 -0.1"/>'
    "</body></body></body>",
    '<motor name="hip" joint="hip" gear="50"/><motor name="ankle" joint="ankle" gear="50"/>',
    extra='<sensor><accelerometer name="imu" site="s"/><jointpos name="hip" joint="hip"/></sensor>',
).replace('<geom name="torso"', '<site name="s"/><geom name="torso"')
"""It touches the ground: for the engines that take contacts."""
