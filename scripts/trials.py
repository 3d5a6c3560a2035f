"""Many runs of the loop, each with its own seed and its own θ* drawn from the prior: what the tables are made of."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax import online
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.recordings.summaries import summarize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path


def trials(
    setup: online.Setup,
    runs: int,
    rounds: int,
    seed: int = 0,
    *,
    out: Path | None = None,
    labels: dict[str, Any] | None = None,
    draws: int = 512,
    target: Callable[[Any], Any] | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield, for each run, arrays over rounds: log q(θ*), the credible level and the ranks of θ*, pairs of its axes.

    The target is the setup's own system, or what `target(θ*)` makes. With `out` every run is appended to that file of
    JSON lines, and runs that it holds already under the same `labels`, seed and rounds are taken from there.

    `level` is the smallest highest-density credible level that holds θ*: uniform if calibrated. `rank` is the share of
    posterior draws below θ*, per axis. `log_q_pairs` and `level_pairs` are log q(θ*) and its credible level in the
    marginals of axes (0, 1), (2, 3), …, where there are more than two.
    """
    box = setup.system.parameters
    pairs = [tuple(range(i, min(i + 2, box.size))) for i in range(0, box.size, 2)] if box.size > 2 else []

    def one(key: Any) -> dict[str, Any]:
        truth_key, run_key, judge_key = jax.random.split(key, 3)
        truth = jax.random.uniform(truth_key, box.low.shape, minval=box.low, maxval=box.high)
        hidden = SimulatedTarget(setup.system, setup.task, truth) if target is None else target(truth)
        _, infos = online.run(run_key, setup, hidden, rounds=rounds)

        def judge(of: tuple[Any, Any]) -> dict[str, Any]:
            key, belief = of
            summary = summarize(key, belief, truth, draws)
            told = {"log_q": summary.log_prob_true, "level": summary.level_true, "rank": summary.rank_true}
            if not pairs:
                return told
            every = jnp.concatenate([truth[None], summary.draws])
            logs = jnp.stack([belief.marginal_log_prob(pair, every[:, jnp.array(pair)]) for pair in pairs])
            return told | {"log_q_pairs": logs[:, 0], "level_pairs": (logs[:, 1:] > logs[:, :1]).mean(1)}

        judged = jax.lax.map(judge, (jax.random.split(judge_key, rounds), infos.belief))
        return judged | {
            "truth": truth,
            "return_target": infos.return_target,
            "success_target": infos.success_target,
            "coverage50": infos.calibration.coverage50,
            "coverage90": infos.calibration.coverage90,
            "coverage90_network": infos.calibration.coverage90_network,
            "collapsed": infos.collapsed,
            "diverged": infos.diverged,
        }

    compiled = jax.jit(one, compiler_options=online.COMPILER_OPTIONS)

    def make(index: int) -> dict[str, Any]:
        return jax.tree.map(np.asarray, compiled(jax.random.fold_in(jax.random.key(seed), index)))

    yield from resume(make, runs, out, (labels or {}) | {"seed": seed, "rounds": rounds})


def resume(
    make: Callable[[int], dict[str, Any]], runs: int, out: Path | None, labels: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Yield `make(index)` of each run with its `run` and `seconds`; what the file `out` holds of them is not made.

    Runs that are made are appended to it, under their `labels`.
    """
    known = {result["run"]: result for result in load(out, labels)} if out else {}
    for index in range(runs):
        if index not in known:
            start = time.monotonic()
            known[index] = _rounded(make(index)) | {"run": index, "seconds": time.monotonic() - start}
            if out:
                save(out, labels | known[index])
        yield known[index]


def gather(results: Iterable[dict[str, Any]], runs: int, name: str = "") -> list[dict[str, Any]]:
    """All results, told one after the other in a line that is written over."""
    done = []
    for result in results:
        done.append(result)
        print(f"{name} {len(done)}/{runs}: {result['seconds']:.0f} s".lstrip(), end="\r", flush=True)
    return done


def _rounded(result: dict[str, Any]) -> dict[str, Any]:
    """Arrays to four decimals, so that a run that is read again is the run that was made; none that are all NaN."""
    return {
        name: np.round(value.astype(float), 4) if isinstance(value, np.ndarray) else value
        for name, value in result.items()
        if not (isinstance(value, np.ndarray) and np.isnan(value.astype(float)).all())
    }


def save(path: Path, result: dict[str, Any]) -> None:
    """Append one run as a line of JSON."""
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in result.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(plain) + "\n")


def load(path: Path, labels: dict[str, Any]) -> list[dict[str, Any]]:
    """The runs of a file that carry these labels."""
    if not path.exists():
        return []
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if all(row.get(name) == value for name, value in labels.items()):
            found.append({k: np.asarray(v) if isinstance(v, list) else v for k, v in row.items()})
    return found


def kept(path: Path, runs: int, labels: dict[str, Any]) -> list[dict[str, Any]]:
    """The first runs of a file that carry these labels, in their order; none is made."""
    return sorted(load(path, labels), key=lambda result: result["run"])[:runs]
