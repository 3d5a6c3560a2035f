"""What is written between the rounds of a run, and how a run is taken up again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from bayessim_jax.contracts import System
from bayessim_jax.recordings.board import Board
from bayessim_jax.recordings.checkpoints import Checkpoints
from bayessim_jax.recordings.history import History
from bayessim_jax.recordings.posterior import read_history, write_posterior
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.recordings.summaries import metrics_line, summarize
from bayessim_jax.recordings.truths import Truths

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bayessim_jax.online import RoundInfo

__all__ = ["Journal"]

DRAWS = 1000
_summarize = jax.jit(jax.vmap(summarize, in_axes=(0, 0, 0, None)), static_argnums=3)


class Journal:
    """Keeps the folder of a run: after `write`, a round is on disk, and a kill at any moment loses at most that round.

    Every array of a round has a leading axis over the seeds. `truths` holds NaN where θ* is unknown. The checkpoint
    is written last, so what lies beyond it belongs to a round that did not finish, and `resume` drops it.
    """

    def __init__(
        self,
        folder: RunFolder,
        system: System[Any],
        seeds: Sequence[int],
        truths: Truths,
        settings: Mapping[str, Any],
        attributes: Mapping[str, Any],
        simulations: int,
    ) -> None:
        self.folder, self.system, self.seeds, self.truths = folder, system, list(seeds), truths
        self.settings, self.attributes, self.simulations = settings, attributes, simulations
        self.lines: list[dict[str, Any]] = []
        self.history: History | None = None
        self.checkpoints = Checkpoints(folder.path / "checkpoints")
        self.board: Board | None = None
        self.keys = jax.vmap(jax.random.key)(np.asarray(self.seeds, np.uint32))
        box = system.parameters
        uniform = np.random.default_rng(min(self.seeds)).uniform(size=(DRAWS, box.size))
        self.prior = (np.asarray(box.low) + uniform * np.asarray(box.width)).astype(np.float32)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.checkpoints.close()
        if self.board is not None:
            self.board.close()

    def begin(self, state: Any) -> None:
        """Put the state before the first round on disk, so that a run can be taken up from there too."""
        self.checkpoints.save(0, state, self.settings)

    def resume(self, like: Any) -> tuple[int, Any]:
        """Rounds done and the state after them; lines and draws beyond the last checkpoint are dropped."""
        state = self.checkpoints.restore(like)
        done = self.checkpoints.latest or 0
        if done == 0:
            return 0, state
        path, system = self.folder.path / "posterior.nc", self.system
        self.lines = self.folder.read_metrics(done)
        self.history = read_history(path, system.observations, system.actions).first(done)
        if len(self.lines) != done * len(self.seeds) or self.history.rounds != done:
            raise ValueError(
                f"{self.folder.path} holds {len(self.lines)} lines of metrics and {self.history.rounds} posteriors for "
                f"a checkpoint of {done} rounds of {len(self.seeds)} seeds; start again with another --out."
            )
        self.folder.write_metrics(self.lines)
        return done, state

    def write(self, index: int, infos: RoundInfo, state: Any, seconds: float) -> list[dict[str, Any]]:
        """Put round `index` (from 1) of all seeds on disk, the checkpoint last, and return its lines."""
        box = self.system.parameters
        keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(self.keys, index)
        summaries, infos = jax.device_get((_summarize(keys, infos.belief, self.truths.at(index), DRAWS), infos))
        at = lambda tree, i: jax.tree.map(lambda leaf: leaf[i], tree)  # noqa: E731
        total = self.simulations * len(self.seeds)
        lines = [
            metrics_line(index, seed, box, total, seconds, at(summaries, i), at(infos, i), self.truths.at(index)[i])
            for i, seed in enumerate(self.seeds)
        ]
        latest = History.of_round(summaries.draws, infos.recordings)
        self.history = latest if self.history is None else self.history.extend(latest)
        self.lines += lines
        self._write_posterior()
        self.folder.write_metrics(self.lines)
        if self.board is None:
            self.board = Board(self.folder.path / "tensorboard", self.seeds, done=index - 1)
        self.board.write(lines)
        self.checkpoints.save(index, state, self.settings)
        return lines

    def _write_posterior(self) -> None:
        assert self.history is not None
        write_posterior(
            self.folder.path / "posterior.nc",
            self.history,
            self.system.parameters,
            self.system.observations,
            self.system.actions,
            self.prior,
            self.seeds,
            self.truths.at(self.history.rounds),
            self.attributes,
        )
