"""Compile a function of one trajectory for a whole batch of them, for all processors of a CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

__all__ = ["CPU_OPTIONS", "TASKS", "WIDE", "compile_batched", "compile_spread", "forward_jacobians"]

TASKS = "cpu-parallel-task-assigner"
"""The pass of XLA that hands every operation of a time step to a pool of threads, which costs many times the operation
from some hundred simulations on."""
WIDE = {"xla_cpu_prefer_vector_width": "512"}
CPU_OPTIONS = {"xla_disable_hlo_passes": f"{TASKS},cse_barrier_expander,small-while-loop-hoisting", **WIDE}
"""No splitting of each small loop over threads, barriers that hold until code is made, and wide vectors.

The second pass would let the compiler repeat a step's equations for every joint; loops that hold barriers cannot be
made one piece of code, as those without them are (`docs/architecture.md`).
"""


def compile_batched(function: Callable[..., Any], *arguments: Any, out_axes: int = 0) -> tuple[Any, tuple[Any, ...]]:
    """`jax.vmap(function)` compiled for arguments with a leading batch axis, and the arguments, spread over devices.

    A CPU counts as as many devices as `jax_num_cpu_devices` says; the batch is cut over them if it can be evenly.
    Made for the tree engine: programs with callbacks stay on one device, whose callback has all processors.
    """
    return compile_spread(jax.vmap(function, out_axes=out_axes), *arguments)


def compile_spread(function: Callable[..., Any], *arguments: Any) -> tuple[Any, tuple[Any, ...]]:
    """The same for a function that takes the whole batch."""
    size = jax.tree.leaves(arguments)[0].shape[0]
    devices = np.array(jax.devices())
    if size % devices.size:
        devices = devices[:1]
    sharding = NamedSharding(Mesh(devices, ("batch",)), PartitionSpec("batch"))
    placed = jax.device_put(arguments, sharding)
    options: Any = CPU_OPTIONS if jax.default_backend() == "cpu" else None
    return jax.jit(function).lower(*placed).compile(compiler_options=options), placed


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
