"""The state of a run on disk: the last two rounds, each with the settings it belongs to."""

from __future__ import annotations

import gc
import logging
import warnings
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["Checkpoints"]


class Checkpoints:
    """Checkpoints of a run, by the number of rounds done; to be closed."""

    def __init__(self, path: Path, keep: int = 2) -> None:
        logging.getLogger("absl").setLevel(logging.ERROR)
        self.path = path.absolute()
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
        self.manager = ocp.CheckpointManager(self.path, options=options)

    def close(self) -> None:
        """Let go of the folder."""
        self.manager.close()

    @property
    def latest(self) -> int | None:
        """Rounds done at the last checkpoint, or nothing where there is none."""
        return self.manager.latest_step()

    def save(self, rounds: int, state: Any, settings: Mapping[str, Any]) -> None:
        """Write the state; on return it is on disk, whole."""
        about = {"settings": settings, "shapes": _shapes(state)}
        self.manager.save(
            rounds, args=ocp.args.Composite(state=ocp.args.StandardSave(_filled(state)), about=ocp.args.JsonSave(about))
        )
        self.manager.wait_until_finished()

    def settings(self) -> dict[str, Any]:
        """The settings of the last checkpoint; raises `ValueError` where it is damaged."""
        return self._restore(about=ocp.args.JsonRestore())["about"]["settings"]

    def restore(self, like: Any) -> Any:
        """The last state, in the structure of `like`; raises `ValueError` where it is damaged or of another shape."""
        stored, wanted = self._restore(about=ocp.args.JsonRestore())["about"]["shapes"], _shapes(like)
        for name in dict.fromkeys([*stored, *wanted]):
            there, here = stored.get(name), wanted.get(name)
            if there != here:
                raise ValueError(
                    f"checkpoint {self.path / str(self.latest)} holds another state: {name} is {there} there and "
                    f"{here} here; start again with another --out."
                )
        abstract = jax.tree.map(ocp.tree.to_shape_dtype_struct, _filled(like))
        restored = self._restore(state=ocp.args.StandardRestore(abstract))["state"]
        # tied to no device, as the arrays of a new run are: the same programs then serve both from the cache
        restored = jax.device_get(restored)
        return jax.tree.map(lambda empty, leaf: jnp.asarray(empty if leaf is None else leaf), like, restored)

    def _restore(self, **items: Any) -> Any:
        if self.latest is None:
            raise ValueError(f"no checkpoint in {self.path}; start again with another --out.")
        try:
            return self.manager.restore(self.latest, args=ocp.args.Composite(**items))
        except Exception as error:  # orbax raises whatever its storage layers raise
            reason = next(iter(str(error).splitlines()), type(error).__name__)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the reads that were not come to
            gc.collect()
        raise ValueError(
            f"checkpoint {self.path / str(self.latest)} is damaged ({reason[:160]}); "
            "delete that folder to continue from the one before, or start again with another --out."
        )


def _filled(state: Any) -> Any:
    """The state without its arrays of size zero, which orbax does not store."""
    return jax.tree.map(lambda leaf: leaf if leaf.size else None, state)


def _shapes(state: Any) -> dict[str, str]:
    """Type and shape of every leaf, by its path."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): f"{leaf.dtype}{list(leaf.shape)}" for path, leaf in leaves}
