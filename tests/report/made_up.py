"""Runs made up for reports."""

import numpy as np

from bayessim_jax.report.evidence import OnlineRun

BOXES = {
    "length": ("m", 0.1, 1.0),
    "mass": ("kg", 0.1, 1.0),
    "friction": ("", 0.1, 2.0),
    "damping": ("N s/m", 0.0, 0.5),
}


def made_up(rounds=16, seeds=1, d=2, known=True, **changes):
    """A run whose posterior closes in on the truth as 1/round; `changes` overwrite numbers of every metrics line."""
    rng = np.random.default_rng(0)
    names = list(BOXES)[:d]
    units, low, high = zip(*(BOXES[n] for n in names), strict=True)
    low, high = np.array(low), np.array(high)
    truths = low + rng.uniform(0.2, 0.8, (seeds, d)) * (high - low)
    draws, lines = [], []
    for r in range(1, rounds + 1):
        sd = 0.25 * (high - low) / r
        centre = truths + sd * rng.normal(size=(seeds, d))
        mix = np.eye(d) + 0.5 * np.tri(d, k=-1)
        x = np.clip(centre[:, None] + (rng.normal(size=(seeds, 400, d)) @ mix.T) * sd, low, high)
        draws.append(x)
        for s in range(seeds):
            named = lambda v: dict(zip(names, v.tolist(), strict=True))  # noqa: E731
            log_prob = float(-np.log(sd).sum() - 0.5 * (((truths[s] - centre[s]) / sd) ** 2).sum() - d * 0.919)
            line = {
                "round": r,
                "seed": 3 + s,
                "log_prob_true": log_prob,
                "log_prob_true_scaled": log_prob + np.log(high - low).sum(),
                "gain_over_prior": log_prob + np.log(high - low).sum(),
                "return_target": 500 * (1 - np.exp(-r / 5)) + rng.normal(),
                "return_simulated": 450 * (1 - np.exp(-r / 6)) + rng.normal(),
                "seconds": 1.5,
                "simulations_per_second": 133.0,
                "diverged": 0,
                "diverged_target": 0,
                "masked": 0,
                "nonfinite": 0,
                "overfit": False,
                "overconfident": False,
                "collapsed": False,
                "strangeness": 0.3,
                "prior_share": 0.0,
                "log_q_train": 1.2 * r**0.5,
                "log_q_validation": r**0.5,
                "coverage90": 0.88 + 0.03 * rng.normal(),
                "coverage90_network": 0.7,
                "level_true": float(rng.uniform()),
                "rank_true": named(rng.uniform(size=d)),
                "mean": named(x[s].mean(0)),
                "sd": named(x[s].std(0)),
            }
            if not known:
                line |= dict.fromkeys(["log_prob_true", "log_prob_true_scaled", "gain_over_prior", "level_true"])
                line["rank_true"] = dict.fromkeys(names)
            lines.append(line | changes)
    settings = {
        "system": "cartpole", "target": "gymnasium", "rounds": rounds, "seed": 3, "seeds": seeds, "steps": 50,
        "simulations": 200, "proposal": "truncated", "encoder": "gated_linear",
        "prior": {n: [float(a), float(b)] for n, a, b in zip(names, low, high, strict=True)},
    }  # fmt: skip
    facts = {"versions": {"bayessim_jax": "0.1.0"}, "folder": "runs/cartpole-seed3", "status": "finished"}
    return OnlineRun(settings, facts, lines, np.stack(draws), names, units, low, high, truths if known else None)
