"""What a model says of itself, against closed forms."""

import mujoco
import numpy as np

from bayessim_jax.mechanics import free_inertia

CART = """<mujoco><compiler angle="radian"/><worldbody>
<body><inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/><joint type="slide" axis="1 0 0" armature="0.5"/>
<body><inertial pos="0 0 -0.6" mass="0.5" diaginertia="0.02 0.02 0.02"/><joint type="hinge" axis="0 1 0"/></body>
</body></worldbody></mujoco>"""


def test_a_joint_shows_the_inertia_that_moves_while_the_others_are_free():
    """Of a cart with a pendulum M = [[M + m, m l cos q], [·, J + m l²]]; the others give way: a Schur complement."""
    model = mujoco.MjModel.from_xml_string(CART)
    for angle in (0.0, 0.7, np.pi / 2):
        coupling, cart, pole = 0.5 * 0.6 * np.cos(angle), 2.0 + 0.5 + 0.5, 0.02 + 0.5 * 0.6**2
        shown = free_inertia(model, mujoco.MjData(model), np.array([0.3, angle]))
        np.testing.assert_allclose(shown, [cart - coupling**2 / pole, pole - coupling**2 / cart], rtol=1e-12)
