"""Table I of the paper: log q(θ*) after the last round, over many true θ* drawn from the prior.

    python scripts/reproduce_table1.py --rows cartpole pendulum acrobot --columns default --runs 20
    python scripts/reproduce_table1.py --rows hopper fetch_push fetch_slide --rounds 10 --out runs/table1.jsonl
    python scripts/reproduce_table1.py --kept --out benchmarks/results/table1.jsonl

The paper's setting is 30 rounds of 200 trajectories of 50 steps, with the controller trained along the way. Columns:
`default` (recurrent network, truncated proposals), `paper` (the paper's proposals), `rff` and `epsilon_free` (summary
statistics, in the same loop). The targets of Hopper and Fetch are Gymnasium's environments, Hopper's simulator is Brax;
Fetch warms up on the prior, and all three calibrate on fewer sets, as `bayessim online` does. Scores are in raw units,
and in units of the prior's width, which is the gain over the prior; those of the acrobot's masses and lengths, and
their sets, are of the marginals. After ± stands the standard error. `--small` is the smallest setting that runs,
`--kept` prints what `--out` holds.

Source: Possas et al. 2020
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from trials import gather, kept, trials

from bayessim_jax import online
from bayessim_jax.cli.options import HABITS
from bayessim_jax.cli.plan import make_estimator
from bayessim_jax.engines.gymnasium import gymnasium_target
from bayessim_jax.inference import Schedule
from bayessim_jax.learning import DEFAULTS, LEARNERS
from bayessim_jax.systems import lookup

PAPER = {
    "cartpole": {"": (4.66, 2.68, 2.88)},
    "pendulum": {"": (4.08, 3.89, 3.33)},
    "acrobot": {", masses": (2.85, 1.53, 1.21), ", lengths": (2.25, 1.43, 1.01)},
    "hopper": {"": (3.25, 3.13, 3.38)},
    "fetch_push": {"": (2.09, 2.18, 2.10)},
    "fetch_slide": {"": (3.24, 3.12, 2.55)},
}
"""What the paper gives: online, RFF and epsilon-free; for each pair of axes that it judges."""
COLUMNS = {
    "default": ("", "truncated", 0),
    "paper": ("", "paper", 0),
    "rff": ("fourier", "truncated", 1),
    "epsilon_free": ("summary", "truncated", 2),
}
"""Encoder, or the system's default, proposals, and which of the paper's figures stands beside it."""
OF_OTHERS = ("hopper", "fetch_push", "fetch_slide")
"""Rows whose target is the environment as it comes, which this project's simulator only resembles."""

SMALL = {
    "ppo": {"episodes": 4, "episode_steps": 20, "envs": 4, "horizon": 20, "epochs": 1, "minibatches": 1},
    "sac": {"episodes": 4, "episode_steps": 20, "envs": 4, "horizon": 20, "updates": 2},
    "her": {"episodes": 2, "envs": 2, "updates": 2, "widths": (8,)},
}
TINY = {
    "simulations": 20,
    "steps": 10,
    "pool": 2,
    "history": 2,
    "calibrations": 8,
    "components": 2,
    "warmup": 0,
    "evaluations": 1,
}


def main() -> None:
    """Run the cells asked for and print a row of the table for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", choices=PAPER, default=list(PAPER))
    parser.add_argument("--columns", nargs="+", choices=COLUMNS, default=list(COLUMNS))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--rounds", type=int, help="by default 30, with Hopper 50")
    parser.add_argument("--small", action="store_true", help="a few simulations and policy steps: shows that it runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    parser.add_argument("--kept", action="store_true", help="run nothing: print the rows whose runs `--out` holds")
    args = parser.parse_args()
    if args.kept and args.out is None:
        parser.error("--kept: name the file that holds the runs with --out")
    print("| row | column | runs | log q(θ*) | gain | median gain | 50 % sets | 90 % sets | the paper |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in args.rows:
        entry, habits = lookup(row), dict(HABITS.get(row, {}))
        rounds = args.rounds or habits.pop("rounds", 30)
        habits.pop("rounds", None)
        usual = habits.pop("encoder", "pooled_lstm")
        system = entry.system(noise=habits.pop("noise", 0.01))
        task, box = entry.task(), system.parameters
        name, settings = DEFAULTS[row]
        learner = LEARNERS[name].create(system, task, **(settings | (SMALL[name] if args.small else {})))
        for column in args.columns:
            encoder, proposal, theirs = COLUMNS[column]
            schedule = Schedule(epochs=5) if args.small else None
            estimator = make_estimator(encoder or usual, system, schedule=schedule)
            sizes = habits | (TINY if args.small else {})
            setup = online.Setup.create(system, learner, task, estimator=estimator, proposal=proposal, **sizes)
            target = partial(gymnasium_target, row, noise=system.noise) if row in OF_OTHERS else None
            labels = {"row": row, "column": column, "small": args.small}
            if args.kept:
                results = kept(args.out, args.runs, labels | {"seed": args.seed, "rounds": rounds})
            else:
                made = trials(setup, args.runs, rounds, args.seed, out=args.out, labels=labels, target=target)
                results = gather(made, args.runs, f"{row} {column}")
            for index, (part, paper) in enumerate(PAPER[row].items() if results else ()):
                whole = len(PAPER[row]) == 1
                log_q, level = (
                    np.stack([r[name][-1] if whole else r[f"{name}_pairs"][-1][index] for r in results])
                    for name in ("log_q", "level")
                )
                width = np.asarray(box.width) if whole else np.asarray(box.width)[2 * index : 2 * index + 2]
                gain = log_q + np.log(width).sum()
                held = [np.mean(level <= a) for a in (0.5, 0.9)]
                print(
                    f"| {row}{part} | {column} | {len(results)} | {_spread(log_q)} | {_spread(gain)} | "
                    f"{np.median(gain):.2f} | {held[0]:.2f} | {held[1]:.2f} | {paper[theirs]:.2f} |"
                )


def _spread(values: np.ndarray) -> str:
    error = values.std(ddof=1) / np.sqrt(values.size) if values.size > 1 else float("nan")
    return f"{values.mean():.2f} ± {error:.2f}"


if __name__ == "__main__":
    main()
