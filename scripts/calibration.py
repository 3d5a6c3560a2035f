"""Coverage and rank uniformity of the posterior over many true θ* drawn from the prior.

    python scripts/calibration.py --rounds 1 --recordings 1 4 16 --out runs/calibration.jsonl
    python scripts/calibration.py --rounds 10 --proposals corrected truncated paper --runs 60

The target is simulated, with the stated sensor noise; actions are random. A calibrated 50 % set holds the truth in half
of the runs, a 90 % set in nine of ten, and the ranks of the truth among the posterior's draws are uniform: p is that of
the χ² test, the least over the parameters. `networks` is the coverage of 90 % sets before recalibration, on simulated
sets. After ± stands the standard error, where coverage is concerned of a posterior that is calibrated.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from trials import gather, trials

from bayessim_jax import online
from bayessim_jax.inference import PROPOSALS
from bayessim_jax.inference.calibration import uniformity_test
from bayessim_jax.learning import Fixed, RandomPolicy
from bayessim_jax.systems import SYSTEMS, lookup

if TYPE_CHECKING:
    from collections.abc import Sequence

DRAWS = 512


def main() -> None:
    """Run the trials and print a row for each proposal and size of the sets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--system", choices=SYSTEMS, default="cartpole")
    parser.add_argument("--proposals", nargs="+", choices=PROPOSALS, default=["corrected"])
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--recordings", type=int, nargs="+", default=[1], help="of the target, in each round")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--each", action="store_true", help="a row for every round, not only for the last one")
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()

    entry = lookup(args.system)
    system, task = entry.system(), entry.task()
    header = (
        "proposal",
        "recordings a round",
        "round",
        "draws",
        "50 % sets",
        "90 % sets",
        "rank p",
        "networks",
        "log q(θ*)",
    )
    print(f"| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for proposal in args.proposals:
        for recordings in args.recordings:
            setup = online.Setup.create(
                system,
                Fixed(RandomPolicy(system.actions)),
                task,
                proposal=proposal,
                recordings=recordings,
                history=recordings * args.rounds,
                evaluations=0,
            )
            labels = {"system": args.system, "proposal": proposal, "recordings": recordings}
            made = trials(setup, args.runs, args.rounds, args.seed, out=args.out, labels=labels, draws=DRAWS)
            results = gather(made, args.runs, proposal)
            for t in range(args.rounds) if args.each else (args.rounds - 1,):
                print(f"| {proposal} | {recordings} | {t + 1} | {_row(results, t)} |")


def _row(results: Sequence[dict[str, Any]], t: int) -> str:
    """What n runs show of one round."""
    n = len(results)
    log_q, level, rank, network = (
        np.stack([r[name][t] for r in results]) for name in ("log_q", "level", "rank", "coverage90_network")
    )
    bins = min(10, n // 5)
    p = uniformity_test(jnp.asarray(rank * DRAWS).round(), DRAWS, bins)[1].min() if bins > 1 else float("nan")
    error = log_q.std(ddof=1) / np.sqrt(n) if n > 1 else float("nan")
    held = (f"{(level <= a).mean():.3f} ± {np.sqrt(a * (1 - a) / n):.3f}" for a in (0.5, 0.9))
    return f"{n} | {' | '.join(held)} | {p:.2f} | {network.mean():.2f} | {log_q.mean():.2f} ± {error:.2f}"


if __name__ == "__main__":
    main()
