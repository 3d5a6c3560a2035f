"""sbi's neural posterior estimation on given trajectories: its mixture network and its flows, behind a GRU."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.timing import now

__all__ = ["NpeResult", "fit_npe"]


@dataclass(frozen=True)
class NpeResult:
    """What one fit reached."""

    log_q: float
    """Mean log q(θ | trajectory) over the held-out pairs, θ in raw units."""
    seconds: float
    """Time of `train`, which stops by itself when its validation loss has not fallen for 20 epochs."""
    epochs: int


def fit_npe(
    model: str,
    theta: np.ndarray,
    rows: np.ndarray,
    held_theta: np.ndarray,
    held_rows: np.ndarray,
    seed: int = 0,
) -> NpeResult:
    """Train NPE with sbi's defaults on θ [n, d] and rows [n, steps, features]; 5 components where it is a mixture.

    `model` is one of sbi's density estimators: `mdn`, `maf`, `nsf`. The embedding is a GRU of 64 units, of which the
    last state is kept; θ and the rows are standardized by sbi.

    Source: Boelts et al. 2025
    """
    import torch
    from sbi.inference import NPE
    from sbi.neural_nets import posterior_nn

    class LastState(torch.nn.Module):
        def __init__(self, width: int, units: int = 64) -> None:
            super().__init__()
            self.gru = torch.nn.GRU(width, units, batch_first=True)

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return self.gru(x)[1][0]

    torch.manual_seed(seed)
    as_tensor = lambda array: torch.tensor(np.array(array), dtype=torch.float32)  # noqa: E731
    low, high = as_tensor(theta).min(0).values, as_tensor(theta).max(0).values
    mixture: dict[str, Any] = {"num_components": 5} if model == "mdn" else {}
    builder = posterior_nn(
        model,
        embedding_net=LastState(rows.shape[-1]),
        z_score_x="independent",
        **mixture,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        inference = NPE(
            torch.distributions.Independent(torch.distributions.Uniform(low, high), 1),
            density_estimator=builder,
            tracker=_Silent(),
            show_progress_bars=False,
        )
        inference.append_simulations(as_tensor(theta), as_tensor(rows))
        start = now()
        density = inference.train()
        seconds = now() - start
        with torch.no_grad():
            log_q = density.log_prob(as_tensor(held_theta)[None], as_tensor(held_rows))[0]
    return NpeResult(float(log_q.mean()), seconds, int(inference.summary["epochs_trained"][-1]))


class _Silent:
    """A tracker that keeps sbi from writing logs into the current folder."""

    log_dir = None

    def _ignore(self, *args: Any, **kwargs: Any) -> None:
        pass

    log_metric = log_metrics = log_params = add_figure = flush = _ignore
