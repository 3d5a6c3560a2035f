"""What is believed of a parameter before the recordings: uniform, normal (also cut off) or log-normal."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtr, ndtri

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

from bayessim_jax.recordings.wording import hint, quote

__all__ = ["LogNormal", "Normal", "Prior", "Uniform", "read_prior"]

INF = math.inf


@dataclass(frozen=True)
class Uniform:
    """p(x) = 1 / (high − low) on [low, high], in the parameter's unit."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}; swap or widen them")

    @property
    def mean(self) -> float:
        """(low + high) / 2."""
        return (self.low + self.high) / 2

    @property
    def sd(self) -> float:
        """(high − low) / √12."""
        return (self.high - self.low) / math.sqrt(12)

    def log_prob(self, x: ArrayLike) -> np.ndarray:
        """Log density; −∞ outside."""
        x = np.asarray(x, float)
        return np.where((x >= self.low) & (x <= self.high), -math.log(self.high - self.low), -INF)

    def quantile(self, u: ArrayLike) -> np.ndarray:
        """The value below which a share `u` of the probability lies: of uniform numbers, draws."""
        return self.low + (self.high - self.low) * np.asarray(u, float)

    def __str__(self) -> str:
        return f"uniform, {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Normal:
    """N(loc, scale²) cut off to [low, high] and normalized there; without bounds the plain normal distribution."""

    loc: float
    scale: float
    low: float = -INF
    high: float = INF

    def __post_init__(self) -> None:
        if not self.scale > 0:
            raise ValueError(f"sd is {self.scale:g}; it must be above 0")
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}; swap or widen them")
        if not self._mass > 1e-12:
            raise ValueError(
                f"mean {self.loc:g} lies so far outside {self.low:g} to {self.high:g} that nothing is left between; "
                "move it or widen the bounds"
            )

    @property
    def _ends(self) -> tuple[float, float]:
        return (self.low - self.loc) / self.scale, (self.high - self.loc) / self.scale

    @property
    def _mass(self) -> float:
        a, b = self._ends
        return float(ndtr(b) - ndtr(a) if a < 0 else ndtr(-a) - ndtr(-b))

    @property
    def mean(self) -> float:
        """Mean after the cut: loc + scale · (φ(a) − φ(b)) / Z."""
        a, b = self._ends
        return self.loc + self.scale * (_phi(a) - _phi(b)) / self._mass

    @property
    def sd(self) -> float:
        """Standard deviation after the cut."""
        a, b = self._ends
        slope = (_times(a, _phi(a)) - _times(b, _phi(b))) / self._mass
        return self.scale * math.sqrt(max(1 + slope - ((_phi(a) - _phi(b)) / self._mass) ** 2, 0.0))

    def log_prob(self, x: ArrayLike) -> np.ndarray:
        """Log density; −∞ outside the bounds."""
        x = np.asarray(x, float)
        inside = -0.5 * ((x - self.loc) / self.scale) ** 2 - math.log(self.scale * math.sqrt(2 * math.pi) * self._mass)
        return np.where((x >= self.low) & (x <= self.high), inside, -INF)

    def quantile(self, u: ArrayLike) -> np.ndarray:
        """The value below which a share `u` of the probability lies: of uniform numbers, draws."""
        a, _ = self._ends
        u = np.asarray(u, float)
        if a > 0:  # the upper tail keeps its digits when seen from above
            return self.loc - self.scale * ndtri(ndtr(-a) - u * self._mass)
        return self.loc + self.scale * ndtri(ndtr(a) + u * self._mass)

    def probability_below(self, x: float) -> float:
        """Share of the probability below `x`."""
        a, _ = self._ends
        return float((ndtr((x - self.loc) / self.scale) - ndtr(a)) / self._mass)

    def __str__(self) -> str:
        cut = f", cut to {self.low:g} to {self.high:g}" if math.isfinite(self.low) or math.isfinite(self.high) else ""
        return f"normal, {self.loc:g} ± {self.scale:g}{cut}"


@dataclass(frozen=True)
class LogNormal:
    """A positive quantity whose logarithm is normal; `mean` and `sd` are those of the quantity itself, in its unit."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        if not self.mean > 0:
            raise ValueError(
                f"mean is {self.mean:g}; it must be above 0 (mean and sd are of the quantity, not of its logarithm)"
            )
        if not self.sd > 0:
            raise ValueError(f"sd is {self.sd:g}; it must be above 0")

    @property
    def low(self) -> float:
        """0."""
        return 0.0

    @property
    def high(self) -> float:
        """∞."""
        return INF

    @property
    def log_sd(self) -> float:
        """Standard deviation of log x: √log(1 + (sd / mean)²)."""
        return math.sqrt(math.log1p((self.sd / self.mean) ** 2))

    @property
    def log_mean(self) -> float:
        """Mean of log x."""
        return math.log(self.mean) - self.log_sd**2 / 2

    def log_prob(self, x: ArrayLike) -> np.ndarray:
        """Log density; −∞ at 0 and below."""
        x = np.asarray(x, float)
        log = np.log(np.where(x > 0, x, 1.0))
        inside = -0.5 * ((log - self.log_mean) / self.log_sd) ** 2 - log
        return np.where(x > 0, inside - math.log(self.log_sd * math.sqrt(2 * math.pi)), -INF)

    def quantile(self, u: ArrayLike) -> np.ndarray:
        """The value below which a share `u` of the probability lies: of uniform numbers, draws."""
        return np.exp(self.log_mean + self.log_sd * ndtri(np.asarray(u, float)))

    def __str__(self) -> str:
        return f"log-normal, mean {self.mean:g}, sd {self.sd:g}"


Prior = Uniform | Normal | LogNormal

KEYS = {
    "uniform": (("low", "high"), ()),
    "normal": (("mean", "sd"), ()),
    "lognormal": (("mean", "sd"), ()),
    "truncated normal": (("mean", "sd"), ("low", "high")),
}


def read_prior(table: Mapping[str, Any]) -> Prior:
    """A prior out of its table in `case.toml`; raises `ValueError` that says which key is wrong, and the remedy."""
    if "distribution" not in table:
        raise ValueError(f"key 'distribution' is missing; {hint('', KEYS)}")
    given = table["distribution"]
    name = str(given).strip().lower().replace("_", " ").replace("-", " ")
    name = {"log normal": "lognormal"}.get(name, name)
    if name not in KEYS:
        raise ValueError(f"unknown distribution {quote(given)}; {hint(name, KEYS)}")
    needed, optional = KEYS[name]
    for key in table:
        if key not in (*needed, *optional, "distribution"):
            raise ValueError(f"unknown key {quote(key)} for a {name} prior; {hint(key, (*needed, *optional))}")
    values = {}
    for key in (*needed, *optional):
        if key in table:
            values[key] = number(table[key], key)
        elif key in needed:
            raise ValueError(f"key {key!r} of the {name} prior is missing; add it")
    if name == "uniform":
        return Uniform(**values)
    if name == "lognormal":
        return LogNormal(**values)
    if name == "truncated normal" and len(values) == 2:
        raise ValueError("a truncated normal prior needs low or high; add one, or call it normal")
    return Normal(values.pop("mean"), values.pop("sd"), **values)


def number(value: Any, name: str) -> float:
    """A finite number out of TOML, or `ValueError`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{name} is {quote(value)}; it needs a finite number")
    return float(value)


def cut(prior: Normal, low: float) -> Normal:
    """The same belief without what lies below `low`."""
    return dataclasses.replace(prior, low=max(prior.low, low))


def _phi(x: float) -> float:
    return math.exp(-x * x / 2) / math.sqrt(2 * math.pi)


def _times(x: float, y: float) -> float:
    return x * y if y else 0.0
