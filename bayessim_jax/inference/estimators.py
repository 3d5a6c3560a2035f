"""Estimators of q(θ | recordings): one network class, and the three compositions that the paper compares."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture, reduce
from bayessim_jax.contracts import Recording, Scalar
from bayessim_jax.inference.encoders import Encoder, glorot, lookup_encoder, transition_features
from bayessim_jax.inference.fit import FitInfo, Schedule, fit, systematic
from bayessim_jax.inference.heads import MixtureHead
from bayessim_jax.inference.summaries import FourierSummary, Summary

__all__ = [
    "EstimatorState",
    "MixtureDensity",
    "fourier_mixture",
    "recurrent_mixture",
    "summary_mixture",
]


@struct.dataclass
class EstimatorState:
    """Weights, and the units in which the network sees recordings and parameters."""

    params: Any
    """One set of weights for each member of the ensemble (leading axis)."""
    feature_mean: Float[Array, " features"]
    feature_scale: Float[Array, " features"]
    shift: Float[Array, " d"]
    scale: Float[Array, " d"]
    fitted: Bool[Array, ""]
    """Whether the feature units are set; they are taken from the first fit and kept."""


@struct.dataclass
class MixtureDensity:
    """Encoder, pooling over the recordings of a set, and mixture head, trained jointly.

    A set of recordings that share θ is embedded one by one and pooled by learned weights, e = Σ gᵢ eᵢ / Σ gᵢ with
    gᵢ = softplus(W eᵢ) channel by channel, so that an informative recording counts for more. The head then gives the
    posterior of the whole set: evidence is combined by what was learned on simulated sets of the same size, and
    nothing is multiplied or averaged.

    With few simulations a single network is over-confident. Several, each with another fold held out to stop it,
    average to a density that is better and close to calibrated, and together they give a held-out prediction for
    every pair.

    θ is standardized by the weighted mean and standard deviation of each fit's pairs; the head's last layer is
    rewritten for the new units, so warm weights keep their meaning.
    """

    encoder: Encoder = struct.field(pytree_node=False)
    head: MixtureHead = struct.field(pytree_node=False)
    schedule: Schedule
    members: int = struct.field(pytree_node=False, default=4)
    """Networks in the ensemble; the posterior is their average, merged to the head's number of components."""
    folds: int = struct.field(pytree_node=False, default=4)
    """Member m never trains on rows m, m + folds, m + 2 folds, …: they stop it early and judge it."""

    def init(self, key: PRNGKeyArray, example: Recording, d: int) -> EstimatorState:
        """Random weights for sets of recordings shaped like `example` (leading axis: the set)."""
        size, steps = example.valid.shape
        features = jax.eval_shape(jax.vmap(transition_features), example).shape[-1]
        encoder = self.encoder.init(key, steps, features)
        x, valid = jnp.zeros((1, steps, features)), jnp.ones((1, steps), bool)
        width = jax.eval_shape(self.encoder.apply, encoder, x, valid).shape[-1]

        def member(key: PRNGKeyArray) -> Any:
            encoder_key, pool_key, head_key = jax.random.split(key, 3)
            encoder = self.encoder.init(encoder_key, steps, features)
            params = {"encoder": encoder, "head": self.head.init(head_key, width, d)}
            return params | ({"gate": 0.1 * glorot(pool_key, width, width)} if size > 1 else {})

        return EstimatorState(
            params=jax.vmap(member)(jax.random.split(key, self.members)),
            feature_mean=jnp.zeros(features),
            feature_scale=jnp.ones(features),
            shift=jnp.zeros(d),
            scale=jnp.ones(d),
            fitted=jnp.array(False),
        )

    def _embed(self, params: Any, x: Float[Array, "n set steps features"], valid: Array) -> Float[Array, "n size"]:
        n, size = x.shape[:2]
        flat = self.encoder.apply(
            params["encoder"], x.reshape(n * size, *x.shape[2:]), valid.reshape(n * size, *valid.shape[2:])
        )
        each = flat.reshape(n, size, -1)
        if size == 1:
            return each[:, 0]
        gate = jax.nn.softplus(each @ params["gate"]) * valid.any(-1)[..., None] + 1e-6
        return (gate * each).sum(1) / gate.sum(1)

    def _log_prob(self, params: Any, inputs: Any, z: Float[Array, "n d"]) -> Float[Array, " n"]:
        return self.head.log_prob(params["head"], self._embed(params, *inputs), z)

    def _inputs(self, state: EstimatorState, recordings: Recording) -> tuple[Array, Array]:
        x = jax.vmap(jax.vmap(transition_features))(recordings)
        x = jnp.clip((x - state.feature_mean) / state.feature_scale, -10.0, 10.0)
        return jnp.where(recordings.valid[..., None], x, 0.0), recordings.valid

    def fit(
        self,
        key: PRNGKeyArray,
        state: EstimatorState,
        thetas: Float[Array, "n d"],
        recordings: Recording,
        weights: Float[Array, " n"],
    ) -> tuple[EstimatorState, FitInfo]:
        """Continue from `state`; scores in the Info are log densities per unit of θ."""
        fit_key, coverage_key = jax.random.split(key)
        weights = jnp.where(recordings.diverged.any(-1), 0.0, weights)
        state = self._set_units(state, thetas, recordings, weights)
        z = (thetas - state.shift) / state.scale
        inputs = self._inputs(state, recordings)
        rows = jnp.arange(z.shape[0]) % self.folds

        def member(args: Any) -> Any:
            index, key, params = args
            return fit(key, params, self._log_prob, inputs, z, weights, rows == index, self.schedule)

        # one after the other: batched small matrix products are slower than a loop on a CPU
        indices = jnp.arange(self.members)
        params, infos = jax.lax.map(member, (indices, jax.random.split(fit_key, self.members), state.params))
        info = infos.replace(
            log_q_train=infos.log_q_train.mean(),
            log_q_validation=infos.log_q_validation.mean(),
            best_epoch=infos.best_epoch.max(),
            epochs=infos.epochs.max(),
            overfit=infos.overfit.any(),
            nonfinite=infos.nonfinite.sum(),
        )
        state = state.replace(params=params)
        info = self._judge(coverage_key, state, info, inputs, z, weights)
        units = jnp.log(state.scale).sum()
        return state, info.replace(
            log_q_train=info.log_q_train - units, log_q_validation=info.log_q_validation - units
        )

    def posterior(self, state: EstimatorState, recordings: Recording) -> GaussianMixture:
        """The mixture q(θ | recordings), for one set, in the units of θ."""
        x, valid = self._inputs(state, jax.tree.map(lambda leaf: leaf[None], recordings))
        each = jax.vmap(lambda p: self.head.mixture(p["head"], self._embed(p, x, valid)[0]))(state.params)
        every = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), each)
        return reduce(every, self.head.components).affine(state.shift, state.scale)

    def _set_units(
        self, state: EstimatorState, thetas: Array, recordings: Recording, weights: Array
    ) -> EstimatorState:
        x = jax.vmap(jax.vmap(transition_features))(recordings)
        w = weights[:, None, None, None] * recordings.valid[..., None]
        total = jnp.maximum(w.sum(), 1e-12)
        mean = (w * x).sum((0, 1, 2)) / total
        scale = jnp.sqrt((w * (x - mean) ** 2).sum((0, 1, 2)) / total) + 1e-6
        shift = (weights[:, None] * thetas).sum(0) / weights.sum()
        spread = jnp.sqrt((weights[:, None] * (thetas - shift) ** 2).sum(0) / weights.sum())
        keep = lambda old, new: jnp.where(state.fitted, old, new)  # noqa: E731
        head = jax.vmap(self.head.change_units, (0, None, None))(
            state.params["head"], (shift - state.shift) / state.scale, spread / state.scale
        )
        head = jax.tree.map(lambda new, old: jnp.where(state.fitted, new, old), head, state.params["head"])
        return state.replace(
            params=state.params | {"head": head},
            feature_mean=keep(state.feature_mean, mean),
            feature_scale=keep(state.feature_scale, scale),
            shift=shift,
            scale=spread,
            fitted=jnp.array(True),
        )

    def _judge(
        self, key: PRNGKeyArray, state: EstimatorState, info: FitInfo, inputs: Any, z: Array, weights: Array
    ) -> FitInfo:
        """How often the 90 % credible set of the member that held a pair out holds the truth."""
        rows = jnp.arange(z.shape[0]) % self.folds
        draws = self.schedule.validation_draws

        def member(args: Any) -> Any:
            index, params = args
            shown = systematic(jax.random.fold_in(key, index), jnp.where(rows == index, weights, 0.0), draws)
            embeddings = self._embed(params, *jax.tree.map(lambda leaf: leaf[shown], inputs))
            return jax.vmap(lambda e: self.head.mixture(params["head"], e))(embeddings), z[shown]

        each = jax.lax.map(member, (jnp.arange(self.members), state.params))
        mixtures, truths = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), each)
        out = jnp.where(rows < self.members, weights, 0.0)

        effective = jnp.minimum(out.sum() ** 2 / jnp.maximum((out**2).sum(), 1e-12), truths.shape[0])
        coverage = (credible_level(key, mixtures, truths) <= 0.9).mean()
        chance = 3 * jnp.sqrt(0.9 * 0.1 / jnp.maximum(effective, 1.0))
        return info.replace(coverage90=coverage, overconfident=coverage < 0.8 - chance)


def credible_level(
    key: PRNGKeyArray, mixtures: GaussianMixture, truths: Float[Array, "n d"], draws: int = 128
) -> Float[Array, " n"]:
    """Smallest highest-density credible level that holds the truth, estimated from draws; uniform if calibrated."""

    def one(key: PRNGKeyArray, mixture: GaussianMixture, truth: Array) -> Scalar:
        samples = jax.vmap(mixture.sample)(jax.random.split(key, draws))
        return (jax.vmap(mixture.log_prob)(samples) > mixture.log_prob(truth)).mean()

    return jax.vmap(one)(jax.random.split(key, truths.shape[0]), mixtures, truths)


def recurrent_mixture(
    encoder: str | Encoder = "framed_lstm", components: int = 5, schedule: Schedule | None = None, **ensemble: int
) -> MixtureDensity:
    """The paper's estimator: a recurrent encoder and a mixture of Gaussians, trained jointly.

    Source: Possas et al. 2020
    """
    encoder = lookup_encoder(encoder) if isinstance(encoder, str) else encoder
    return MixtureDensity(encoder, MixtureHead(components), schedule or Schedule(), **ensemble)


def fourier_mixture(
    features: int = 300, actions: int = 1, components: int = 5, schedule: Schedule | None = None
) -> MixtureDensity:
    """BayesSim RFF: summary statistics, quasi-Monte-Carlo random Fourier features, outputs linear in them.

    Source: Ramos et al. 2019
    """
    return MixtureDensity(FourierSummary(features, actions), MixtureHead(components, hidden=0), schedule or Schedule())


def summary_mixture(
    hidden: int = 64, actions: int = 1, components: int = 5, schedule: Schedule | None = None
) -> MixtureDensity:
    """ε-free inference: summary statistics and a plain mixture density network.

    Source: Papamakarios and Murray 2016
    """
    return MixtureDensity(Summary(actions), MixtureHead(components, hidden), schedule or Schedule())
