"""Beliefs over θ: uniform box, uniform ellipsoid, Gaussian mixture, truncated mixture, particles."""

from bayessim_jax.beliefs.algebra import product as product
from bayessim_jax.beliefs.algebra import quotient as quotient
from bayessim_jax.beliefs.algebra import reduce as reduce
from bayessim_jax.beliefs.box_probability import box_probability as box_probability
from bayessim_jax.beliefs.ellipsoid import Ellipsoid as Ellipsoid
from bayessim_jax.beliefs.mixture import GaussianMixture as GaussianMixture
from bayessim_jax.beliefs.mixture import moment_match as moment_match
from bayessim_jax.beliefs.particles import Particles as Particles
from bayessim_jax.beliefs.truncated import Truncated as Truncated
from bayessim_jax.beliefs.uniform import Uniform as Uniform

__all__ = [
    "Ellipsoid",
    "GaussianMixture",
    "Particles",
    "Truncated",
    "Uniform",
    "box_probability",
    "moment_match",
    "product",
    "quotient",
    "reduce",
]
