"""Systems as pure functions of θ, their tasks, and the registry that the command line reads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from bayessim_jax.spelling import find_named
from bayessim_jax.systems.acrobot import Acrobot as Acrobot
from bayessim_jax.systems.acrobot import Raise as Raise
from bayessim_jax.systems.cartpole import Balance as Balance
from bayessim_jax.systems.cartpole import CartPole as CartPole
from bayessim_jax.systems.cartpole import Centre as Centre
from bayessim_jax.systems.fetch import Fetch as Fetch
from bayessim_jax.systems.fetch import MoveTo as MoveTo
from bayessim_jax.systems.functional import from_functions as from_functions
from bayessim_jax.systems.hold import Hold as Hold
from bayessim_jax.systems.hopper import Hop as Hop
from bayessim_jax.systems.hopper import Hopper as Hopper
from bayessim_jax.systems.pendulum import Pendulum as Pendulum
from bayessim_jax.systems.pendulum import SwingUp as SwingUp
from bayessim_jax.systems.pendulum import Upswing as Upswing
from bayessim_jax.systems.skid_steer import FollowCircle as FollowCircle
from bayessim_jax.systems.skid_steer import SkidSteer as SkidSteer

if TYPE_CHECKING:
    from collections.abc import Callable

    from bayessim_jax.contracts import System, Task

__all__ = ["SYSTEMS", "Entry", "lookup"]


@dataclass(frozen=True)
class Entry:
    """A registered system: how to make it, its task, and the learner that is trained on it.

    `planned` is the task of planners, who need a cost that falls on the way to the goal; none plans without one.
    """

    system: Callable[..., System[Any]]
    task: Callable[..., Task[Any]]
    learner: str
    summary: str
    planned: Callable[..., Task[Any]] | None = None


SYSTEMS: dict[str, Entry] = {
    "cartpole": Entry(
        CartPole.create,
        Balance,
        "ppo",
        "keep a pole upright on a cart that is pushed left or right; length is half the pole's",
        Centre,
    ),
    "pendulum": Entry(
        Pendulum.create, SwingUp, "sac", "swing a rod up with a motor too weak to lift it at once", Upswing
    ),
    "acrobot": Entry(Acrobot.create, Raise, "ppo", "swing two links up with a motor at the elbow only"),
    "skid_steer": Entry(
        SkidSteer.create, FollowCircle, "mppi", "drive around a circle on wheels that slide sideways", FollowCircle
    ),
    "hopper": Entry(Hopper.create, Hop, "ppo", "hop forward on one leg; the simulator is Brax, the target MuJoCo"),
    "fetch_push": Entry(partial(Fetch.create, "push"), MoveTo, "her", "push a box to a place on a table with an arm"),
    "fetch_slide": Entry(partial(Fetch.create, "slide"), MoveTo, "her", "hit a puck so that it slides to a place"),
}


def lookup(name: str) -> Entry:
    """Find a registered system, or raise `ValueError` with the near miss."""
    return find_named(name, SYSTEMS, "unknown system")
