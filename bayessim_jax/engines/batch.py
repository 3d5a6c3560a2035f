"""Compile a function of one trajectory for a whole batch of them, for all processors of a CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxprs_in_params
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from bayessim_jax.engines.tree.constraints import SOLVER

__all__ = ["TASKS", "WIDE", "compile_batched", "compile_spread", "forward_jacobians", "map_in_blocks"]

TASKS = "cpu-parallel-task-assigner"
"""The pass of XLA that hands every operation of a time step to a pool of threads, which costs many times the operation
from some hundred simulations on."""
WIDE = {"xla_cpu_prefer_vector_width": "512"}
LOOPS: Any = {"xla_disable_hlo_passes": TASKS, **WIDE}
"""No splitting of each small loop over threads, and wide vectors: a loop over time steps is one piece of code."""
SOLVERS: Any = {"xla_disable_hlo_passes": f"{TASKS},cse_barrier_expander,small-while-loop-hoisting", **WIDE}
"""For steps with the solver of dry friction and joint limits, a loop of its own: barriers that hold until code is made
keep the compiler from repeating the step's equations in that loop for every joint, which is twice as quick from two
joints on. Loops that hold barriers cannot be made one piece of code (`docs/architecture.md`)."""
BLOCK = 128
"""Simulations that go through all their time steps together: what one step of so many needs stays in a core's cache."""


def compile_batched(function: Callable[..., Any], *arguments: Any, out_axes: Any = 0) -> tuple[Any, tuple[Any, ...]]:
    """`jax.vmap(function)` compiled for arguments with a leading batch axis, and the arguments, spread over devices.

    `out_axes` as in `jax.vmap`; `compile_spread` says what is done.
    """
    return compile_spread(jax.vmap(function, out_axes=out_axes), *arguments, out_axes=out_axes)


def compile_spread(function: Callable[..., Any], *arguments: Any, out_axes: Any = 0) -> tuple[Any, tuple[Any, ...]]:
    """The same for a function that takes a whole batch, whatever its size; `out_axes` says where its outputs have it.

    A CPU counts as as many devices as `jax_num_cpu_devices` says; the batch is cut over them if it can be evenly, and
    on each into blocks of some 128, one after the other. Made for the tree engine: programs with callbacks stay on one
    device, whose callback has all processors.
    """
    size = jax.tree.leaves(arguments)[0].shape[0]
    devices = np.array(jax.devices())
    if size % devices.size:
        devices = devices[:1]
    mesh = Mesh(devices, ("batch",))
    placed = jax.device_put(arguments, NamedSharding(mesh, PartitionSpec("batch")))
    if jax.default_backend() != "cpu":
        return jax.jit(function).lower(*placed).compile(), placed
    outputs = jax.eval_shape(function, *arguments)
    axes = jax.tree.map(lambda x, k: k % x.ndim, outputs, jax.tree_util.tree_broadcast(out_axes, outputs))
    share = partial(_in_blocks, function, axes=axes, block=_block(size // devices.size))
    specs = jax.tree.map(lambda k: PartitionSpec(*[None] * k, "batch"), axes)
    spread = jax.shard_map(share, mesh=mesh, in_specs=PartitionSpec("batch"), out_specs=specs, check_vma=False)
    traced = jax.jit(spread).trace(*placed)
    return traced.lower().compile(compiler_options=SOLVERS if _solves(traced.jaxpr) else LOOPS), placed


def map_in_blocks(function: Callable[..., Any], *batch: Any) -> Any:
    """`jax.vmap(function)` over a leading axis while tracing: on a CPU blocks of some 128 follow each other."""
    size = jax.tree.leaves(batch)[0].shape[0]
    if jax.default_backend() != "cpu":
        return jax.vmap(function)(*batch)
    axes = jax.tree.map(lambda _: 0, jax.eval_shape(function, *jax.tree.map(lambda x: x[0], batch)))
    return _in_blocks(jax.vmap(function), *batch, axes=axes, block=_block(size))


def _block(size: int) -> int:
    """The divisor of a batch's size that is nearest to `BLOCK` in proportion; all of it where none is near."""
    near = [k for k in range(BLOCK // 2, 2 * BLOCK + 1) if size % k == 0]
    return min(near, key=lambda k: max(k / BLOCK, BLOCK / k), default=size)


def _in_blocks(function: Callable[..., Any], *batch: Any, axes: Any, block: int) -> Any:
    """A function of a batch, block by block."""
    size = jax.tree.leaves(batch)[0].shape[0]
    if block == size:
        return function(*batch)
    # of what is empty, such as the commands of a machine without motors, no size can be left to be inferred
    cut = jax.tree.map(lambda x: x.reshape(size // block, block, *x.shape[1:]), batch)
    found = jax.lax.map(lambda one: function(*one), cut)
    return jax.tree.map(lambda x, k: _joined(jnp.moveaxis(x, 0, k), k), found, axes)


def _joined(x: Array, axis: int) -> Array:
    return x.reshape(*x.shape[:axis], x.shape[axis] * x.shape[axis + 1], *x.shape[axis + 2 :])


def _solves(jaxpr: Any) -> bool:
    """Whether a program holds the solver of dry friction and joint limits."""
    return any(
        SOLVER in str(equation.source_info.name_stack) or any(map(_solves, jaxprs_in_params(equation.params)))
        for equation in jaxpr.eqns
    )


def forward_jacobians(function: Callable[..., Any], directions: Float[Array, "k d"]) -> Callable[..., Any]:
    """From f(θ, …) of one trajectory, the values and derivatives along directions of θ for a batch (leading axis: k).

    Directions come before the batch, so that values are shared and the batch stays what vectors are made of.
    """

    def over_batch(thetas: Float[Array, "n d"], *rest: Any) -> tuple[Any, Any]:
        def along(direction: Float[Array, " d"]) -> tuple[Any, Any]:
            tangents = jnp.broadcast_to(direction, thetas.shape)
            return jax.jvp(lambda t: jax.vmap(function)(t, *rest), (thetas,), (tangents,))

        return jax.vmap(along, out_axes=(None, 0))(directions)

    return over_batch
