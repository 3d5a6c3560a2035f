"""One round of the paper's CartPole setting as it is put together from Stable-Baselines3 and PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.timing import Parts, now

__all__ = ["PeerRound", "Trajectories", "collect", "fit_density", "run_round"]


@dataclass(frozen=True)
class Trajectories:
    """θ [n, 2], observations [n, steps + 1, 4], actions [n, steps, 1] and which transitions happened [n, steps]."""

    theta: np.ndarray
    observations: np.ndarray
    actions: np.ndarray
    valid: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """(yₜ, yₜ₊₁ − yₜ, uₜ) of each transition [n, steps, 9]; zero after the end."""
        now, later = self.observations[:, :-1], self.observations[:, 1:]
        return np.concatenate([now, later - now, self.actions], -1) * self.valid[..., None]


@dataclass(frozen=True)
class PeerRound:
    """What one round took, and what it made."""

    parts: Parts
    policy: Any
    trajectories: Trajectories
    policy_steps: int
    """Environment steps of PPO: the wish rounded up to whole batches of 2,048."""


def run_round(seed: int, policy_steps: int = 15_000, count: int = 200, steps: int = 50, epochs: int = 200) -> PeerRound:
    """PPO with default parameters, `count` rollouts with its policy, `epochs` of LSTM(64) and 5 Gaussians.

    Source: Possas et al. 2020
    """
    from stable_baselines3 import PPO

    env = make_env(seed, steps)
    model = PPO("MlpPolicy", env, seed=seed, device="cpu")
    start = now()
    model.learn(policy_steps)
    learned = now()
    trajectories = collect(model, seed + 1, count, steps)
    collected = now()
    fit_density(trajectories, seed=seed, epochs=epochs)
    end = now()
    parts = Parts(policy=learned - start, rollouts=collected - learned, estimator=end - collected)
    return PeerRound(parts, model, trajectories, model.num_timesteps)


def make_env(seed: int, steps: int, noise: float = 0.01) -> Any:
    """Gymnasium's CartPole: length and mass of the pole uniform on [0.1, 1]² at each reset, noisy sensors."""
    import gymnasium

    class Randomized(gymnasium.Wrapper):
        def __init__(self) -> None:
            super().__init__(gymnasium.make("CartPole-v1", max_episode_steps=steps))
            self.draws = np.random.default_rng(seed)

        def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
            cart: Any = self.unwrapped
            cart.length, cart.masspole = self.draws.uniform(0.1, 1.0, 2)
            cart.polemass_length, cart.total_mass = cart.masspole * cart.length, cart.masspole + cart.masscart
            observation, info = self.env.reset(**options)
            return self._sense(observation), info

        def step(self, action: Any) -> Any:
            observation, *rest = self.env.step(action)
            return self._sense(observation), *rest

        def _sense(self, observation: np.ndarray) -> np.ndarray:
            return observation + noise * self.draws.standard_normal(4, np.float32)

    return Randomized()


def collect(model: Any, seed: int, count: int, steps: int) -> Trajectories:
    """Trajectories of the stochastic policy, θ redrawn at each."""
    env = make_env(seed, steps)
    made = Trajectories(
        theta=np.zeros((count, 2), np.float32),
        observations=np.zeros((count, steps + 1, 4), np.float32),
        actions=np.zeros((count, steps, 1), np.float32),
        valid=np.zeros((count, steps), bool),
    )
    for i in range(count):
        observation, _ = env.reset(seed=seed if i == 0 else None)
        made.theta[i] = env.unwrapped.length, env.unwrapped.masspole
        made.observations[i, 0] = observation
        for t in range(steps):
            action, _ = model.predict(observation)
            observation, _, terminated, truncated, _ = env.step(int(action))
            made.actions[i, t], made.observations[i, t + 1], made.valid[i, t] = action, observation, True
            if terminated or truncated:
                break
    return made


def fit_density(
    data: Trajectories,
    held_out: Trajectories | None = None,
    seed: int = 0,
    epochs: int = 200,
    batch: int = 50,
    components: int = 5,
    units: int = 64,
) -> list[tuple[float, float]]:
    """Train LSTM and mixture of full-covariance Gaussians with Adam at its default rate.

    With held-out pairs it returns, for each epoch, the seconds of training so far and the mean log q(θ | trajectory)
    over them in raw units; the scoring is not timed.
    """
    import torch
    from torch import distributions, nn

    torch.manual_seed(seed)
    theta, rows = torch.as_tensor(data.theta), torch.as_tensor(data.rows)
    held = held_out and (torch.as_tensor(held_out.theta), torch.as_tensor(held_out.rows))
    d = theta.shape[1]
    shift, scale = theta.mean(0), theta.std(0)
    row_shift, row_scale = rows.mean((0, 1)), rows.std((0, 1)) + 1e-6
    below = torch.tril_indices(d, d)
    sizes = [components, components * d, components * below.shape[1]]
    lstm, head = nn.LSTM(rows.shape[-1], units, batch_first=True), nn.Linear(units, sum(sizes))
    optimizer = torch.optim.Adam([*lstm.parameters(), *head.parameters()])

    def log_prob(theta: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        _, (last, _) = lstm((rows - row_shift) / row_scale)
        logits, means, packed = head(last[0]).split(sizes, -1)
        factor = torch.zeros(len(rows), components, d, d)
        factor[..., below[0], below[1]] = packed.reshape(len(rows), components, -1)
        diagonal = nn.functional.softplus(factor.diagonal(dim1=-2, dim2=-1)) + 1e-4
        factor = torch.tril(factor, -1) + torch.diag_embed(diagonal)
        mixture = distributions.MixtureSameFamily(
            distributions.Categorical(logits=logits, validate_args=False),
            distributions.MultivariateNormal(means.reshape(-1, components, d), scale_tril=factor, validate_args=False),
            validate_args=False,
        )
        return mixture.log_prob((theta - shift) / scale) - scale.log().sum()

    history, seconds = [], 0.0
    for _ in range(epochs):
        start = now()
        for picks in torch.randperm(len(theta)).split(batch):
            optimizer.zero_grad()
            (-log_prob(theta[picks], rows[picks]).mean()).backward()
            optimizer.step()
        seconds += now() - start
        if held is not None:
            with torch.no_grad():
                score = log_prob(*held).mean()
            history.append((seconds, float(score)))
    return history
