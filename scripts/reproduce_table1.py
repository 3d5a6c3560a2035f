"""Table I of the paper: log q(θ*) after the last round, over many true θ* drawn from the prior.

    python scripts/reproduce_table1.py --rows cartpole pendulum acrobot --columns default --runs 20

The paper's setting is 30 rounds of 200 trajectories of 50 steps, with the controller trained along the way. Columns:
`default` (recurrent network, corrected proposals), `paper` (the paper's proposals), `rff` and `epsilon_free` (summary
statistics, in the same loop). Scores are in raw units, in units of the prior's width, and as gain over the prior; for
the acrobot the marginals of masses and lengths follow.

Source: Possas et al. 2020
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from trials import trials

from bayessim_jax import online
from bayessim_jax.inference import fourier_mixture, recurrent_mixture, summary_mixture
from bayessim_jax.learning import default_learner
from bayessim_jax.systems import lookup

PAPER = {"cartpole": "4.66", "pendulum": "4.08", "acrobot": "masses 2.85, lengths 2.25"}
COLUMNS = {
    "default": (recurrent_mixture, "corrected"),
    "paper": (recurrent_mixture, "paper"),
    "rff": (fourier_mixture, "corrected"),
    "epsilon_free": (summary_mixture, "corrected"),
}


def main() -> None:
    """Run the cells asked for and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", choices=PAPER, default=list(PAPER))
    parser.add_argument("--columns", nargs="+", choices=COLUMNS, default=list(COLUMNS))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()
    for row in args.rows:
        entry = lookup(row)
        system, task = entry.system(), entry.task()
        for column in args.columns:
            estimator, proposal = COLUMNS[column]
            setup = online.Setup.create(
                system, default_learner(row, system, task), task, estimator=estimator(), proposal=proposal
            )
            results = []
            labels = {"row": row, "column": column}
            for result in trials(setup, args.runs, args.rounds, args.seed, out=args.out, labels=labels):
                results.append(result)
                print(f"{row} {column} {len(results)}/{args.runs}: {result['seconds']:.0f} s", end="\r", flush=True)
            last = np.stack([r["log_q"][-1] for r in results])
            level = np.stack([r["level"][-1] for r in results])
            width = np.log(np.asarray(system.parameters.width)).sum()
            marginals = np.stack([r["log_marginals"][-1] for r in results])
            print(
                f"{row:9s} {column:13s} raw {_spread(last)}, prior-scaled and gain {_spread(last + width)}, "
                f"median {np.median(last):.2f}, pairs of axes {[_spread(m) for m in marginals.T]}; "
                f"50 % sets {np.mean(level <= 0.5):.2f}, 90 % sets {np.mean(level <= 0.9):.2f}; paper {PAPER[row]}"
            )


def _spread(values: np.ndarray) -> str:
    error = values.std(ddof=1) / np.sqrt(values.size) if values.size > 1 else float("nan")
    return f"{values.mean():.2f} ± {error:.2f}"


if __name__ == "__main__":
    main()
