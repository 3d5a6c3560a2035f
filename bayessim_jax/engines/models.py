"""MuJoCo models with θ written in, kept for as long as they are likely to be asked for again."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Sequence

import mujoco
import numpy as np

from bayessim_jax.engines.fields import Write, write_into

__all__ = ["ModelBank"]

BATCHES = 4
"""Batches of θ whose models are kept, where there is room for them."""
MEMORY = 1e9
"""Bytes of models that are kept beside the newest batch's: an arm with meshes takes two million each."""


class ModelBank:
    """Makes a model for each row of a batch of θ, derived quantities included, and remembers the last batches."""

    def __init__(self, model: mujoco.MjModel, writes: Sequence[Write], spec: mujoco.MjSpec | None = None) -> None:
        self.model = model
        self.sizes = [w for w in writes if w.field == "geom_size"]
        self.others = [w for w in writes if w.field != "geom_size"]
        self.spec = spec
        self.scratch = mujoco.MjData(model)
        self.room = int(MEMORY / mujoco.mj_sizeModel(model))
        self.rows: OrderedDict[bytes, mujoco.MjModel] = OrderedDict()
        self.batches: OrderedDict[bytes, list[mujoco.MjModel]] = OrderedDict()
        self._check_sizes()

    def batch(self, thetas: np.ndarray) -> list[mujoco.MjModel]:
        """One model for each row."""
        if not self.others and not self.sizes:
            return [self.model] * len(thetas)
        key = thetas.tobytes()
        models = self.batches.get(key)
        if models is None:
            models = [self._row(row) for row in thetas]
            kept = min(BATCHES * len(thetas) + 64, max(len(thetas), self.room))
            while len(self.rows) > kept:
                self.rows.popitem(last=False)
            while self.batches and (len(self.batches) >= BATCHES or self._held() + len(thetas) > self.room):
                self.batches.popitem(last=False)
            self.batches[key] = models
        self.batches.move_to_end(key)
        return models

    def build(self, theta: np.ndarray) -> mujoco.MjModel:
        """A new model with θ written in; a geom's size can change its body's inertia, so it is compiled anew."""
        theta = np.asarray(theta, np.float64)
        model = self._compile(theta) if self.sizes else copy.copy(self.model)
        write_into(model, self.others, theta)
        mujoco.mj_setConst(model, self.scratch)
        return model

    def _held(self) -> int:
        return sum(len(models) for models in self.batches.values())

    def _row(self, theta: np.ndarray) -> mujoco.MjModel:
        key = theta.tobytes()
        if key not in self.rows:
            self.rows[key] = self.build(theta)
        self.rows.move_to_end(key)
        return self.rows[key]

    def _compile(self, theta: np.ndarray) -> mujoco.MjModel:
        assert self.spec is not None
        spec = self.spec.copy()
        for write in self.sizes:
            geom, component = write.index
            spec.geom(self.model.geom(geom).name).size[component] = write.factor * theta[write.parameter]
        model = spec.compile()
        model.opt.disableflags = self.model.opt.disableflags
        return model

    def _check_sizes(self) -> None:
        """A size that something else in the file decides, as `fromto` does, cannot be a parameter."""
        if not self.sizes:
            return
        if self.spec is None:
            raise ValueError(
                "a geom's size is a parameter: give the model as MJCF or MjSpec, so that it compiles anew."
            )
        count = 1 + max(w.parameter for w in self.sizes)
        theta = np.zeros(count)
        for write in self.sizes:
            theta[write.parameter] = 1.01 * self.model.geom_size[write.index]
        model = self._compile(theta)
        for write in self.sizes:
            if not np.isclose(model.geom_size[write.index], theta[write.parameter], rtol=1e-6):
                path = f"geom/{self.model.geom(write.index[0]).name}/size/{write.index[1]}"
                raise ValueError(f"{path} cannot be a parameter: fromto or a mesh decides it.")
