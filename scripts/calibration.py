"""Coverage and rank uniformity of the posterior over many true θ* drawn from the prior.

    python scripts/calibration.py --rounds 1 --recordings 1 4 16 --out runs/calibration.jsonl
    python scripts/calibration.py --rounds 10 --proposals corrected truncated paper --runs 60
    python scripts/calibration.py --kept --out benchmarks/results/calibration.jsonl

The target is simulated, with the stated sensor noise; actions are random. A calibrated 50 % set holds the truth in half
of the runs, a 90 % set in nine of ten, and the ranks of the truth among the posterior's draws are uniform: p is that of
the χ² test, the least over the parameters. `networks` is the coverage of 90 % sets before recalibration, on simulated
sets. After ± stands the standard error, where coverage is concerned that of a calibrated posterior. `least` is the log
q(θ*) of the worst run. `--kept` prints what `--out` holds.
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from trials import gather, kept, trials

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
    parser.add_argument("--proposals", nargs="+", choices=PROPOSALS, default=["truncated"])
    parser.add_argument("--recordings", type=int, nargs="+", default=[1, 4, 16], help="of the target, in each round")
    parser.add_argument("--rounds", type=int, nargs="+", default=[1, 10], help="after which the posterior is judged")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    parser.add_argument("--kept", action="store_true", help="run nothing: print the rows whose runs `--out` holds")
    args = parser.parse_args()
    if args.kept and args.out is None:
        parser.error("--kept: name the file that holds the runs with --out")
    measures = "50 % sets | 90 % sets | rank p | networks | log q(θ*) | least"
    print(f"| proposal | recordings a round | rounds | draws | {measures} |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for proposal, rounds, recordings in product(args.proposals, args.rounds, args.recordings):
        labels = {"system": args.system, "proposal": proposal, "recordings": recordings}
        if args.kept:
            results = kept(args.out, args.runs, labels | {"seed": args.seed, "rounds": rounds})
        else:
            setup = _setup(args.system, proposal, recordings, rounds)
            made = trials(setup, args.runs, rounds, args.seed, out=args.out, labels=labels, draws=DRAWS)
            results = gather(made, args.runs, proposal)
        if results:
            print(f"| {proposal} | {recordings} | {rounds} | {_row(results)} |")


def _setup(name: str, proposal: str, recordings: int, rounds: int) -> online.Setup:
    """Random actions; all recordings are remembered, but no more than a run remembers where nothing is asked for."""
    entry = lookup(name)
    system, task = entry.system(), entry.task()
    actor, history = Fixed(RandomPolicy(system.actions)), min(recordings * rounds, online.Setup.history)
    sizes = {"recordings": recordings, "history": history, "evaluations": 0}
    return online.Setup.create(system, actor, task, proposal=proposal, **sizes)


def _row(results: Sequence[dict[str, Any]]) -> str:
    """What n runs show of their last round."""
    n = len(results)
    log_q, level, rank, network = (
        np.stack([r[name][-1] for r in results]) for name in ("log_q", "level", "rank", "coverage90_network")
    )
    bins = min(10, n // 5)
    p = uniformity_test(jnp.asarray(rank * DRAWS).round(), DRAWS, bins)[1].min() if bins > 1 else float("nan")
    error = log_q.std(ddof=1) / np.sqrt(n) if n > 1 else float("nan")
    held = (f"{(level <= a).mean():.3f} ± {np.sqrt(a * (1 - a) / n):.3f}" for a in (0.5, 0.9))
    scores = f"{network.mean():.2f} | {log_q.mean():.2f} ± {error:.2f} | {log_q.min():.2f}"
    return f"{n} | {' | '.join(held)} | {p:.3f} | {scores}"


if __name__ == "__main__":
    main()
