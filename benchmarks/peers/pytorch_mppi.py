"""The peer's side: one control step of `pytorch_mppi` on the same pendulum, cost, horizon and samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from pytorch_mppi import MPPI

__all__ = ["pendulum_step"]


def pendulum_step(seed: int, samples: int = 500, horizon: int = 30) -> Callable[[], Any]:
    """A function that plans once; the plan is carried on from call to call, as it is in control."""
    torch.manual_seed(seed)
    length, mass = 0.55, 0.55

    def dynamics(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        angle, rate = state[:, 0:1], state[:, 1:2]
        torque = torch.clamp(action, -2.0, 2.0)
        acceleration = 15.0 / length * torch.sin(angle) + 3.0 / (mass * length**2) * torque
        rate = torch.clamp(rate + 0.05 * acceleration, -8.0, 8.0)
        return torch.cat((angle + 0.05 * rate, rate), dim=1)

    def cost(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return 50.0 * (torch.cos(state[:, 0]) - 1.0) ** 2 + state[:, 1] ** 2

    planner = MPPI(
        dynamics,
        cost,
        nx=2,
        noise_sigma=torch.eye(1),
        num_samples=samples,
        horizon=horizon,
        lambda_=10.0,
        u_min=torch.tensor([-2.0]),
        u_max=torch.tensor([2.0]),
    )
    start = torch.tensor([math.pi - 0.05, 0.3])
    return lambda: planner.command(start).numpy()
