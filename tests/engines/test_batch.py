"""A batch compiled for all processors is the batch."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_jax.engines.batch import compile_batched, compile_spread, forward_jacobians, map_in_blocks
from bayessim_jax.engines.fields import find_writes, merge_writes
from bayessim_jax.engines.tree import TreeEngine
from tests.engines.mechanisms import MODELS

THETAS = np.random.default_rng(0).uniform([0.5, -11.0], [1.5, -9.0], (384, 2)).astype(np.float32)


@pytest.fixture(scope="module", params=["spatial_arm", "dry_arm"])
def last(request):
    """The last of 20 steps of an arm without and with dry friction, whose solver is a loop within a step."""
    model = mujoco.MjModel.from_xml_string(MODELS["spatial_arm"])
    if request.param == "dry_arm":
        model.dof_frictionloss[:] = 0.05
    paths = ["body/l1/mass", "option/gravity/2"]
    engine = TreeEngine(model, merge_writes([find_writes(model, [p], k) for k, p in enumerate(paths)]))

    def run(theta):
        start = engine.init(theta, jnp.full(3, 0.3), jnp.zeros(3))
        return engine.qpos(jax.tree.map(lambda x: x[-1], engine.replay(theta, start, jnp.ones((20, 3)))))

    return run


@pytest.mark.parametrize(
    ("size", "out_axes"),
    [pytest.param(131, 0, id="whole", marks=pytest.mark.slow), pytest.param(384, -1, id="in blocks")],
)
def test_a_spread_batch_is_the_batch(last, size, out_axes):
    compiled, placed = compile_batched(last, THETAS[:size], out_axes=out_axes)
    expected = jax.jit(jax.vmap(last, out_axes=out_axes))(THETAS[:size])
    np.testing.assert_allclose(compiled(*placed), expected, rtol=1e-5, atol=1e-6)


def test_barriers_hold_where_a_step_solves_for_friction(last, request):
    compiled, _ = compile_batched(last, THETAS[:8])
    assert ("opt-barrier" in compiled.as_text()) == ("dry_arm" in request.node.name)


@pytest.mark.slow
def test_jacobians_of_a_batch_are_those_of_each(last):
    compiled, placed = compile_spread(forward_jacobians(last, jnp.eye(2)), THETAS, out_axes=(0, 1))
    values, tangents = compiled(*placed)
    np.testing.assert_allclose(values, jax.jit(jax.vmap(last))(THETAS), rtol=1e-5, atol=1e-6)
    each = jax.jit(jax.vmap(jax.jacfwd(last)))(THETAS)
    np.testing.assert_allclose(jnp.moveaxis(tangents, 0, -1), each, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("size", [7, 90, 1230])
def test_blocks_are_the_whole_of_what_is_traced(size):
    """Also where there is nothing in a row, such as commands of a machine without motors."""
    x, none = jnp.arange(3.0 * size).reshape(size, 3), jnp.zeros((size, 0))
    found = jax.jit(lambda *rows: map_in_blocks(lambda a, b: jnp.append(a * 2.0, b.sum()), *rows))(x, none)
    np.testing.assert_array_equal(found, jnp.pad(2.0 * x, ((0, 0), (0, 1))))
