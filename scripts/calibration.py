"""Coverage and rank uniformity of the posterior, round by round, over many true θ* drawn from the prior.

    python scripts/calibration.py --runs 300 --rounds 10 --recordings 1

The target is simulated, with the stated sensor noise; actions are random. A calibrated 50 % set holds the truth in half
of the runs, a 90 % set in nine of ten.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np
from trials import gather, trials

from bayessim_jax import online
from bayessim_jax.inference import PROPOSALS
from bayessim_jax.inference.calibration import uniformity_test
from bayessim_jax.learning import Fixed, RandomPolicy
from bayessim_jax.systems import SYSTEMS, lookup


def main() -> None:
    """Run the trials and print one line per round."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--system", choices=SYSTEMS, default="cartpole")
    parser.add_argument("--proposal", choices=PROPOSALS, default="corrected")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--recordings", type=int, default=1, help="of the target, in each round")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()

    entry = lookup(args.system)
    system, task = entry.system(), entry.task()
    setup = online.Setup.create(
        system,
        Fixed(RandomPolicy(system.actions)),
        task,
        proposal=args.proposal,
        recordings=args.recordings,
        history=args.recordings * args.rounds,
        evaluations=0,
    )
    labels = {"system": args.system, "proposal": args.proposal, "recordings": args.recordings}
    made = trials(setup, args.runs, args.rounds, args.seed, out=args.out, labels=labels)
    results = gather(made, args.runs, "run")
    print()
    log_q, level, rank = (np.stack([r[name] for r in results]) for name in ("log_q", "level", "rank"))
    for t in range(args.rounds):
        bins = min(10, len(results) // 5)
        p = uniformity_test(jax.numpy.asarray(rank[:, t] * 512), 512, bins)[1] if bins > 1 else np.nan
        spread = log_q[:, t].std(ddof=1) / np.sqrt(len(results)) if len(results) > 1 else float("nan")
        print(
            f"round {t + 1:2d}: log q(θ*) {log_q[:, t].mean():6.2f} ± {spread:.2f}, "
            f"median {np.median(log_q[:, t]):6.2f}; "
            f"50 % sets {np.mean(level[:, t] <= 0.5):.2f}, 90 % sets {np.mean(level[:, t] <= 0.9):.2f}; "
            f"rank p {np.round(np.asarray(p), 3).tolist()}"
        )


if __name__ == "__main__":
    main()
