"""What one recording of a run's policy tells of θ, by the number of simulations that the networks are fitted to.

    bayessim online fetch_push --rounds 30 --out runs/push
    python scripts/read_recordings.py runs/push

θ is drawn from the prior and simulated under the run's last policy. The estimator is fitted to the first N of the
simulations, from the start each time, and log q(θ | recording) is averaged over 400 others: with what the system says
that networks read of a transition (`features`), and with the plain observations, their differences and the action; and
with each of the encoders named.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax import online
from bayessim_jax.cli.config_file import settings_from
from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.plan import make_plan
from bayessim_jax.inference.encoders import ENCODERS, features_of, transition_features
from bayessim_jax.recordings.checkpoints import Checkpoints

AT_ONCE = 200
"""Rollouts in one compiled call."""


def main() -> None:
    """Print a line for each reading and each number of simulations."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder of bayessim online")
    parser.add_argument("--simulations", type=int, nargs="+", default=[200, 600, 2000, 4000])
    parser.add_argument("--encoders", nargs="+", choices=sorted(ENCODERS), help="of the networks; else the run's")
    parser.add_argument("--held-out", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    settings, setup, policy = _restore(args.run)
    box, key = setup.system.parameters, jax.random.key(args.seed)
    draw_key, simulate_key, init_key, fit_key = jax.random.split(key, 4)
    count = -(-(max(args.simulations) + args.held_out) // AT_ONCE) * AT_ONCE
    thetas = jax.random.uniform(draw_key, (count, len(box.names)), minval=box.low, maxval=box.high)
    simulate = jax.jit(lambda key, thetas: online.simulate(key, setup, policy, thetas))
    parts = [simulate(jax.random.fold_in(simulate_key, i), thetas[i : i + AT_ONCE]) for i in range(0, count, AT_ONCE)]
    seen = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:, None], *parts)
    held = jax.tree.map(lambda leaf: leaf[-args.held_out :], (thetas, seen))
    print(f"prior: {-float(jnp.log(box.high - box.low).sum()):.2f}")
    readings: dict[str, Any] = {"plain": transition_features, "of the system": features_of(setup.system)}
    encoders = {name: ENCODERS[name] for name in args.encoders or ()} or {settings.encoder: setup.estimator.encoder}
    for (reading, features), (name, encoder) in itertools.product(readings.items(), encoders.items()):
        estimator: Any = replace(setup.estimator, features=features, encoder=encoder)
        blank = estimator.init(init_key, jax.tree.map(lambda leaf: leaf[0], seen), thetas.shape[1])
        for n in args.simulations:
            some = jax.tree.map(lambda leaf: leaf[:n], (thetas, seen))  # noqa: B023
            fitted, _ = jax.jit(estimator.fit)(fit_key, blank, *some, jnp.ones(n))
            scores = np.asarray(jax.jit(_score, static_argnums=0)(estimator.posterior, fitted, *held))
            error = scores.std() / len(scores) ** 0.5
            print(f"{reading}, {name}, {n} simulations: log q {scores.mean():.2f} ± {error:.2f}", flush=True)


def _score(posterior: Any, state: Any, thetas: Any, seen: Any) -> Any:
    """Log q(θ | one recording) of every pair."""
    return jax.vmap(lambda theta, one: posterior(state, one, jnp.ones(1, bool)).log_prob(theta))(thetas, seen)


def _restore(run: Path) -> tuple[Settings, online.Setup, Any]:
    """Settings and setup of a run, and its policy after the last round kept, from a copy: one that goes on is left."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copytree(run / "checkpoints", Path(folder) / "checkpoints"))
        checkpoints = Checkpoints(copy)
        plan = make_plan(Settings(**settings_from(checkpoints.settings(), str(run))))
        state = jax.tree.map(lambda leaf: leaf[0], checkpoints.restore(plan.start()))
        checkpoints.close()
    return plan.settings, plan.setup, plan.setup.learner.policy(state.learner)


if __name__ == "__main__":
    main()
