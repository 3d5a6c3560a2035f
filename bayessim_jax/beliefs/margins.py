"""Independent priors of named parameters, each a smooth map from a standard normal variable: θ = F⁻¹(Φ(z))."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.special as jax_special
import numpy as np
import scipy.special as numpy_special
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Scalar

__all__ = ["Margin", "Margins", "log_normal", "log_uniform", "normal", "uniform", "values_between"]

Numbers = Array | np.ndarray
EDGE = 1e-12
"""Probabilities nearer than this to 0 and 1 have no finite z."""
STEP = 1e-5
"""Of z, for derivatives by differences."""


@struct.dataclass
class Margin:
    """One parameter's prior: `uniform` or `log_uniform` on [a, b], `normal` or `log_normal` of mean a and sd b.

    A normal prior may be cut to [low, high]; `log_normal` takes mean and sd of log θ.
    """

    kind: str = struct.field(pytree_node=False)
    a: float = struct.field(pytree_node=False)
    b: float = struct.field(pytree_node=False)
    low: float = struct.field(pytree_node=False, default=-float("inf"))
    high: float = struct.field(pytree_node=False, default=float("inf"))

    def value(self, z: Any) -> Any:
        """θ at a standard normal z: a JAX array, or a number or array of NumPy's, with which nothing is compiled."""
        if not self.is_cut:
            return _uncut(self.kind, self.a, self.b, z)
        xp, special = _library(z)
        first, last = self._shares
        return self.a + self.b * special.ndtri(xp.clip(first + (last - first) * special.ndtr(z), EDGE, 1 - EDGE))

    def slope(self, z: float) -> float:
        """dθ/dz of a number."""
        z = float(z)
        return (self.value(z + STEP) - self.value(z - STEP)) / (2 * STEP)

    def standard(self, value: Any) -> Any:
        """Z of a value, of JAX or NumPy; values outside of the support are taken to its edge."""
        xp, special = _library(value, self.a, self.b)
        if self.kind == "uniform":
            share = (value - self.a) / (self.b - self.a)
        elif self.kind == "log_uniform":
            share = xp.log(xp.maximum(value, 1e-300) / self.a) / xp.log(self.b / self.a)
        elif self.kind == "log_normal":
            return (xp.log(xp.maximum(value, 1e-300)) - self.a) / self.b
        elif not self.is_cut:
            return (value - self.a) / self.b
        else:
            first, last = self._shares
            share = (special.ndtr((value - self.a) / self.b) - first) / (last - first)
        edge = 10 * float(jnp.finfo(jnp.result_type(float)).eps)
        return special.ndtri(xp.clip(share, edge, 1 - edge))

    @property
    def is_cut(self) -> bool:
        """Whether it is a normal distribution on an interval."""
        return self.low > -float("inf") or self.high < float("inf")

    @property
    def _shares(self) -> tuple[float, float]:
        first, last = (float(numpy_special.ndtr((edge - self.a) / self.b)) for edge in (self.low, self.high))
        return first, last


def _library(*numbers: Any) -> tuple[Any, Any]:
    """NumPy and SciPy's functions for their numbers, JAX's for those of JAX."""
    jaxed = any(isinstance(x, jax.Array) for x in numbers)
    return (jnp, jax_special) if jaxed else (np, numpy_special)


def _uncut(kind: str, a: Any, b: Any, z: Any) -> Any:
    """θ at z of a margin of this kind, or of several."""
    xp, special = _library(z, a, b)
    if kind == "uniform":
        return a + (b - a) * special.ndtr(z)
    if kind == "log_uniform":
        return a * xp.exp(xp.log(b / a) * special.ndtr(z))
    return xp.exp(a + b * z) if kind == "log_normal" else a + b * z


def values_between(
    kinds: Sequence[str], a: Float[Numbers, " d"], b: Float[Numbers, " d"], z: Float[Numbers, " d"]
) -> Any:
    """Values at z of margins that are not cut and whose numbers may be traced, all of a kind at once.

    One by one they would be as many copies of the normal distribution's polynomials in a program.
    """
    distinct = list(dict.fromkeys(kinds))
    if len(distinct) < 2:
        return _uncut(distinct[0], a, b, z) if kinds else z
    rows = [np.flatnonzero([other == kind for other in kinds]) for kind in distinct]
    every = [_uncut(kind, a[own], b[own], z[own]) for kind, own in zip(distinct, rows, strict=True)]
    return _library(z, a, b)[0].concatenate(every)[np.argsort(np.concatenate(rows))]


def uniform(low: float, high: float) -> Margin:
    """Uniform on [low, high]."""
    return Margin("uniform", float(low), float(high))


def log_uniform(low: float, high: float) -> Margin:
    """A positive quantity whose logarithm is uniform."""
    return Margin("log_uniform", float(low), float(high))


def normal(mean: float, sd: float, low: float = -float("inf"), high: float = float("inf")) -> Margin:
    """N(mean, sd²), cut to [low, high] where they are finite."""
    return Margin("normal", float(mean), float(sd), float(low), float(high))


def log_normal(log_mean: float, log_sd: float) -> Margin:
    """A quantity whose logarithm is N(log_mean, log_sd²)."""
    return Margin("log_normal", float(log_mean), float(log_sd))


@struct.dataclass
class Margins:
    """Independent priors as one map: z ~ N(0, I) in, θ in raw units out.

    In z every prior has the same scale and no bounds, so that one solver and one sampler serve all of them.
    """

    names: tuple[str, ...] = struct.field(pytree_node=False)
    each: tuple[Margin, ...] = struct.field(pytree_node=False)
    units: tuple[str, ...] = struct.field(pytree_node=False)

    @classmethod
    def create(cls, names: Sequence[str], each: Sequence[Margin], units: Sequence[str] = ()) -> Margins:
        """Priors in the order of their names."""
        return cls(tuple(names), tuple(each), tuple(units) or ("",) * len(names))

    @property
    def size(self) -> int:
        """Number of parameters, d."""
        return len(self.names)

    @property
    def bounded(self) -> Bool[np.ndarray, " d"]:
        """Which of them are shares Φ(z) of an interval."""
        return np.array([m.kind in ("uniform", "log_uniform") for m in self.each], bool)

    def __add__(self, other: Margins) -> Margins:
        return Margins(self.names + other.names, self.each + other.each, self.units + other.units)

    def theta(self, z: Float[Numbers, " d"]) -> Any:
        """Parameters in raw units, of JAX or NumPy."""
        if any(m.is_cut for m in self.each):
            return _library(z)[0].stack([m.value(z[k]) for k, m in enumerate(self.each)])
        a, b = (np.array([getattr(m, side) for m in self.each], z.dtype) for side in "ab")
        return values_between([m.kind for m in self.each], a, b, z)

    def standard(self, theta: Float[Array, " d"]) -> Float[Array, " d"]:
        """The z of given parameters."""
        return jnp.stack([m.standard(theta[k]) for k, m in enumerate(self.each)]) if self.each else theta

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ."""
        return self.theta(jax.random.normal(key, (self.size,)))

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density in raw units: log φ(z) − Σ log dθ/dz."""
        z = self.standard(theta)
        slopes = jnp.stack([jax.grad(m.value)(z[k]) for k, m in enumerate(self.each)])
        return (-0.5 * z**2 - 0.5 * jnp.log(2 * jnp.pi) - jnp.log(slopes)).sum()
