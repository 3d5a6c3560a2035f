"""Learning q(θ | recordings): encoders, mixture head, fit, evidence of several recordings, proposals, calibration."""

from bayessim_jax.inference.encoders import ENCODERS as ENCODERS
from bayessim_jax.inference.encoders import Lstm as Lstm
from bayessim_jax.inference.encoders import lookup_encoder as lookup_encoder
from bayessim_jax.inference.estimators import MixtureDensity as MixtureDensity
from bayessim_jax.inference.estimators import fourier_mixture as fourier_mixture
from bayessim_jax.inference.estimators import recurrent_mixture as recurrent_mixture
from bayessim_jax.inference.estimators import summary_mixture as summary_mixture
from bayessim_jax.inference.fit import Schedule as Schedule
from bayessim_jax.inference.heads import MixtureHead as MixtureHead
from bayessim_jax.inference.proposals import PROPOSALS as PROPOSALS
from bayessim_jax.inference.proposals import Corrected as Corrected
from bayessim_jax.inference.proposals import Paper as Paper
from bayessim_jax.inference.proposals import TruncatedPrior as TruncatedPrior
from bayessim_jax.inference.proposals import lookup_proposal as lookup_proposal

__all__ = [
    "ENCODERS",
    "PROPOSALS",
    "Corrected",
    "Lstm",
    "MixtureDensity",
    "MixtureHead",
    "Paper",
    "Schedule",
    "TruncatedPrior",
    "fourier_mixture",
    "lookup_encoder",
    "lookup_proposal",
    "recurrent_mixture",
    "summary_mixture",
]
