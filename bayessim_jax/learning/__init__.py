"""Learners: PPO, SAC, DDPG with hindsight, θ redrawn from the belief at every episode; and which a system takes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bayessim_jax.learning.fixed import Fixed as Fixed
from bayessim_jax.learning.fixed import RandomPolicy as RandomPolicy
from bayessim_jax.learning.fixed import RecordedActions as RecordedActions
from bayessim_jax.learning.her import Her as Her
from bayessim_jax.learning.policies import NetworkPolicy as NetworkPolicy
from bayessim_jax.learning.ppo import Ppo as Ppo
from bayessim_jax.learning.sac import Sac as Sac
from bayessim_jax.spelling import find_named

if TYPE_CHECKING:
    from bayessim_jax.contracts import System, Task

__all__ = [
    "DEFAULTS",
    "LEARNERS",
    "Fixed",
    "Her",
    "NetworkPolicy",
    "Ppo",
    "RandomPolicy",
    "RecordedActions",
    "Sac",
    "default_learner",
]

LEARNERS: dict[str, Any] = {"ppo": Ppo, "sac": Sac, "her": Her}

DEFAULTS: dict[str, tuple[str, dict[str, Any]]] = {
    "cartpole": ("ppo", {"episodes": 30, "episode_steps": 500, "gamma": 0.998}),
    "pendulum": ("sac", {"episodes": 75, "episode_steps": 200, "entropy_target": -3.0}),
    "acrobot": ("ppo", {"episodes": 30, "episode_steps": 500, "gamma": 0.995}),
    "skid_steer": ("sac", {"episodes": 30, "episode_steps": 500}),
    "hopper": (
        "ppo",
        {
            "episodes": 30,
            "episode_steps": 500,
            "gamma": 0.995,
            "horizon": 100,
            "epochs": 10,
            "minibatches": 15,
            "learning_rate": 3e-4,
        },
    ),
    "fetch_push": ("her", {}),
    "fetch_slide": ("her", {}),
    "diagnosed": ("sac", {"episodes": 75, "episode_steps": 200}),
}
"""For each registered system, and for what a diagnosis repaired: its learner, and the settings that learn its task in
15,000 policy steps a round. With Fetch a round is five epochs of a hundred episodes, 25,000 steps.

Episodes are as long as the task's: in the 50 steps of a recording a pole never meets the end of its track and an
acrobot never reaches its line. The skid-steer robot is planned for by default: SAC learns here to stay near
the circle, but hardly to go around it.
"""


def default_learner(system_name: str, system: System[Any], task: Task[Any]) -> Ppo | Sac | Her:
    """The learner of a registered system, or `ValueError` with the near miss."""
    learner, settings = find_named(system_name, DEFAULTS, "no learner is registered for the system")
    return LEARNERS[learner].create(system, task, **settings)
