"""Planners: MPPI under one model, DISCO under a belief over θ; and which settings a system takes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bayessim_jax.control.disco import USES as USES
from bayessim_jax.control.disco import Disco as Disco
from bayessim_jax.control.mppi import Mppi as Mppi
from bayessim_jax.control.mppi import MppiInfo as MppiInfo
from bayessim_jax.control.mppi import Plan as Plan
from bayessim_jax.control.noise import coloured_noise as coloured_noise
from bayessim_jax.control.noise import spline_noise as spline_noise
from bayessim_jax.control.noise import white_noise as white_noise
from bayessim_jax.control.planner import Planner as Planner
from bayessim_jax.control.planner import PlannerPolicy as PlannerPolicy
from bayessim_jax.control.risk import ConditionalValueAtRisk as ConditionalValueAtRisk
from bayessim_jax.control.risk import Mean as Mean
from bayessim_jax.control.risk import WorstCase as WorstCase
from bayessim_jax.control.unscented import sigma_points as sigma_points
from bayessim_jax.spelling import find_named

if TYPE_CHECKING:
    from bayessim_jax.contracts import Restartable, Task

__all__ = [
    "DEFAULTS",
    "PLANNERS",
    "USES",
    "ConditionalValueAtRisk",
    "Disco",
    "Mean",
    "Mppi",
    "MppiInfo",
    "Plan",
    "Planner",
    "PlannerPolicy",
    "WorstCase",
    "coloured_noise",
    "default_planner",
    "default_settings",
    "sigma_points",
    "spline_noise",
    "white_noise",
]

PLANNERS: dict[str, dict[str, Any]] = {"mppi": {"use": "mean"}, "disco": {"use": "particles", "particles": 4}}
"""What the planners are called: MPPI plans under the belief's mean, DISCO under draws of the belief.

At equal numbers of simulated model steps the mean costs least or nearly so (docs/control.md), so it is the default.
"""

DEFAULTS: dict[str, dict[str, Any]] = {
    "pendulum": {"horizon": 30, "samples": 500, "sigma": 0.5, "temperature": 10.0},
    "cartpole": {"horizon": 10, "samples": 512, "sigma": 0.5, "temperature": 10.0},
    "skid_steer": {
        "horizon": 80,
        "samples": 512,
        "sigma": 0.2,
        "temperature": 1.0,
        "share": 0.05,
        "control_cost": 0.0,
        "noise": "spline",
    },
    "diagnosed": {
        "horizon": 40,
        "samples": 256,
        "sigma": 0.4,
        "temperature": 1.0,
        "share": 0.05,
        "control_cost": 0.0,
        "noise": "spline",
    },
}
"""Settings of MPPI for each registered system that is planned for, and for what a diagnosis repaired; particles share
the samples among them.

The cart-pole is planned for by a fifth of a second, as by DISCO's authors: no row of pushes keeps poles of different
lengths upright for much longer, so that a plan for several θ, or under noise, would be judged by how it falls. The
skid-steer robot has to turn on the spot before it can follow the circle from the wrong side of it: a plan of less
than three seconds sees only that this costs more than to stand still.
"""


def default_settings(name: str, system_name: str) -> dict[str, Any]:
    """The settings of a planner for a registered system, or `ValueError` with the near miss."""
    use = find_named(name, PLANNERS, "unknown planner")
    chosen = {**use, **find_named(system_name, DEFAULTS, "no planner is registered for the system")}
    return {**chosen, "samples": chosen["samples"] // chosen.get("particles", 1)}


def default_planner(name: str, system_name: str, system: Restartable[Any], task: Task[Any], **settings: Any) -> Planner:
    """The planner of a registered system with other settings, or `ValueError` with the near miss."""
    return Planner.create(system, task, **{**default_settings(name, system_name), **settings})
