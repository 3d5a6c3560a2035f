"""Estimators of q(θ | recordings): one network class, and the three compositions that the paper compares."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture, moment_match
from bayessim_jax.contracts import Box, Recording, Scalar
from bayessim_jax.inference.encoders import Encoder, Features, lookup_encoder, transition_features
from bayessim_jax.inference.evidence import combine_evidence
from bayessim_jax.inference.fit import FitInfo, Schedule, fit
from bayessim_jax.inference.heads import MixtureHead
from bayessim_jax.inference.readout import Readout, read_sets
from bayessim_jax.inference.recalibration import (
    CalibrationInfo,
    Recalibration,
    by_number,
    credible_levels,
    judge,
    nearness,
    recalibrate,
)
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
    correction: Recalibration | Readout
    """What sets that no network has seen say of the posterior of one recording, or of several."""
    fitted: Bool[Array, ""]
    """Whether the feature units are set; they are taken from the first fit and kept."""


@struct.dataclass
class MixtureDensity:
    """Encoder and mixture head, trained jointly; an ensemble of them; evidence of a set; recalibration.

    The networks learn q(θ | one recording). With few simulations a single network is over-confident: several, each with
    another fold held out to stop it early, are averaged. The evidence of several recordings adds up to a Gaussian
    (`combine_evidence`) that counts the error that networks make at one θ for every recording alike as often as there
    are recordings; the posterior given it is learned from simulated sets of the same size that these networks were not
    trained on (`read_sets`). That of a single recording is their mixture, moved and stretched (`recalibrate`).

    θ is standardized by the weighted mean and standard deviation of each fit's pairs; the head's last layer is
    rewritten for the new units, so warm weights keep their meaning.
    """

    encoder: Encoder = struct.field(pytree_node=False)
    head: MixtureHead = struct.field(pytree_node=False)
    schedule: Schedule
    members: int = struct.field(pytree_node=False, default=4)
    """Networks in the ensemble."""
    folds: int = struct.field(pytree_node=False, default=5)
    """Draws of θ are dealt to folds in turn; member m never trains on fold m."""
    features: Features = struct.field(pytree_node=False, default=transition_features)
    """What the encoder reads of a recording."""

    def __post_init__(self) -> None:
        if not 1 <= self.members <= self.folds or self.folds < 2:
            raise ValueError(f"MixtureDensity: {self.members} members need as many folds, and at least two.")

    def init(self, key: PRNGKeyArray, example: Recording, d: int) -> EstimatorState:
        """Random weights for sets of recordings shaped like `example` (leading axis: the set)."""
        steps = example.valid.shape[-1]
        features = jax.eval_shape(jax.vmap(self.features), example).shape[-1]

        def member(key: PRNGKeyArray) -> dict[str, Any]:
            encoder_key, head_key = jax.random.split(key)
            encoder = self.encoder.init(encoder_key, features)
            x, valid = jnp.zeros((1, steps, features)), jnp.ones((1, steps), bool)
            width = jax.eval_shape(self.encoder.apply, encoder, x, valid).shape[-1]
            return {"encoder": encoder, "head": self.head.init(head_key, width, d)}

        return EstimatorState(
            params=jax.vmap(member)(jax.random.split(key, self.members)),
            feature_mean=jnp.zeros(features),
            feature_scale=jnp.ones(features),
            shift=jnp.zeros(d),
            scale=jnp.ones(d),
            correction=Recalibration.none(d) if example.diverged.shape[0] == 1 else Readout.none(d),
            fitted=jnp.array(False),
        )

    def fit(
        self,
        key: PRNGKeyArray,
        state: EstimatorState,
        thetas: Float[Array, "n d"],
        recordings: Recording,
        weights: Float[Array, " n"],
        draws: Int[Array, " n"] | None = None,
    ) -> tuple[EstimatorState, FitInfo]:
        """Continue from `state`; scores in the Info are log densities in the units of θ, for one recording."""
        weights = jnp.where(recordings.diverged.any(-1), 0.0, weights)
        state = self._set_units(state, thetas, recordings, weights)
        z = (thetas - state.shift) / state.scale
        inputs = self._inputs(state, recordings)
        fold = (jnp.arange(z.shape[0]) if draws is None else draws) % self.folds
        size = recordings.valid.shape[1]
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), inputs)
        each_z, each_weight, each_fold = (jnp.repeat(leaf, size, axis=0) for leaf in (z, weights, fold))

        def member(args: Any) -> Any:
            index, key, params = args
            return fit(key, params, self._log_prob, flat, each_z, each_weight, each_fold == index, self.schedule)

        # one after the other: batched small matrix products are slower than a loop on a CPU
        keys = jax.random.split(key, self.members)
        params, infos = jax.lax.map(member, (jnp.arange(self.members), keys, state.params))
        state = replace(state, params=params)

        units = jnp.log(state.scale).sum()
        return state, FitInfo(
            log_q_train=infos.log_q_train.mean() - units,
            log_q_validation=infos.log_q_validation.mean() - units,
            best_epoch=infos.best_epoch.max(),
            epochs=infos.epochs.max(),
            overfit=infos.overfit.any(),
            nonfinite=infos.nonfinite.sum(),
        )

    def calibrate(
        self,
        key: PRNGKeyArray,
        state: EstimatorState,
        thetas: Float[Array, "n d"],
        recordings: Recording,
        observed: Recording,
        use: Bool[Array, " set"],
        box: Box,
        correct: bool = True,
    ) -> tuple[EstimatorState, CalibrationInfo, GaussianMixture]:
        """Measure the posterior of sets on sets that no network has seen, and take out what is wrong with it.

        Returns the posterior of the set observed, too: what `posterior` says of it after this.

        In what is reported the half of them whose posteriors sit nearest that of the set observed counts, the nearest
        most; and in the correction, where it is that of single recordings.
        """
        z = (thetas - state.shift) / state.scale
        every = jax.tree.map(lambda leaf, one: jnp.concatenate([leaf, one[None]]), recordings, observed)
        plain, seen = _last(jax.lax.map(lambda one: self._plain(state, one, use), every))
        weights = nearness(plain, seen)
        low, high = ((bound - state.shift) / state.scale for bound in (box.low, box.high))

        def levels(held: int) -> Float[Array, " held"]:
            first, truths = jax.tree.map(lambda leaf: leaf[:held], (plain, z))
            return credible_levels(key, first, truths, low, high, jnp.ones(1))[:, 0]

        if not correct:
            before = levels(z.shape[0])
            info = judge(before, before, weights, z.shape[1], jnp.ones(()))
            return state, info, state.correction.apply(seen).affine(state.shift, state.scale)
        if isinstance(state.correction, Readout):
            correction, after, skipped = read_sets(key, plain, z, low, high)
        else:
            (correction, after), skipped = recalibrate(key, plain, z, weights, low, high), jnp.array(0)
        corrected = correction.apply(seen)
        widen = _width(corrected) / _width(seen)
        info = judge(levels(after.size), after, by_number(weights[: after.size]), z.shape[1], widen, skipped)
        return replace(state, correction=correction), info, corrected.affine(state.shift, state.scale)

    def posterior(self, state: EstimatorState, recordings: Recording, use: Bool[Array, " set"]) -> GaussianMixture:
        """The mixture q(θ | recordings in use), for one set, in the units of θ."""
        plain = self._plain(state, recordings, use)
        if isinstance(state.correction, Recalibration) or recordings.diverged.size > 1:
            plain = state.correction.apply(plain)
        return plain.affine(state.shift, state.scale)

    def _log_prob(self, params: Any, inputs: Any, z: Float[Array, "n d"]) -> Float[Array, " n"]:
        return self.head.log_prob(params["head"], self.encoder.apply(params["encoder"], *inputs), z)

    def _inputs(self, state: EstimatorState, recordings: Recording) -> tuple[Array, Array]:
        x = jax.vmap(jax.vmap(self.features))(recordings)
        x = jnp.clip((x - state.feature_mean) / state.feature_scale, -10.0, 10.0)
        return jnp.where(recordings.valid[..., None], x, 0.0), recordings.valid

    def _plain(self, state: EstimatorState, recordings: Recording, use: Bool[Array, " set"]) -> GaussianMixture:
        """The networks' posterior of one set, in standardized θ; that of several recordings is one Gaussian."""
        x, valid = self._inputs(state, jax.tree.map(lambda leaf: leaf[None], recordings))
        use = use & ~recordings.diverged
        valid = valid[0] & use[:, None]

        def member(p: Any) -> GaussianMixture:
            return jax.vmap(lambda e: self.head.mixture(p["head"], e))(self.encoder.apply(p["encoder"], x[0], valid))

        each = jax.vmap(member, out_axes=1)(state.params)  # (set, members, K, …)
        each = jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0], -1, *leaf.shape[3:]), each)
        return jax.tree.map(lambda leaf: leaf[0], each) if use.size == 1 else combine_evidence(each, use)

    def _set_units(self, state: EstimatorState, thetas: Array, recordings: Recording, weights: Array) -> EstimatorState:
        x = jax.vmap(jax.vmap(self.features))(recordings)
        w = weights[:, None, None, None] * recordings.valid[..., None]
        total = jnp.maximum(w.sum(), 1e-12)
        mean = (w * x).sum((0, 1, 2)) / total
        scale = jnp.sqrt((w * (x - mean) ** 2).sum((0, 1, 2)) / total) + 1e-6
        share = weights[:, None] / jnp.maximum(weights.sum(), 1e-12)
        shift = (share * thetas).sum(0)
        spread = jnp.sqrt((share * (thetas - shift) ** 2).sum(0))
        keep = lambda old, new: jnp.where(state.fitted, old, new)  # noqa: E731
        head = jax.vmap(self.head.change_units, (0, None, None))(
            state.params["head"], (shift - state.shift) / state.scale, spread / state.scale
        )
        head = jax.tree.map(lambda new, old: jnp.where(state.fitted, new, old), head, state.params["head"])
        return replace(
            state,
            params=state.params | {"head": head},
            feature_mean=keep(state.feature_mean, mean),
            feature_scale=keep(state.feature_scale, scale),
            shift=shift,
            scale=spread,
            fitted=jnp.array(True),
        )


def _last(tree: Any) -> tuple[Any, Any]:
    """All but the last row, and the last row."""
    return jax.tree.map(lambda leaf: leaf[:-1], tree), jax.tree.map(lambda leaf: leaf[-1], tree)


def _width(mixture: GaussianMixture) -> Scalar:
    """Geometric mean of the standard deviations along the axes of its ellipsoid."""
    _, tril = moment_match(mixture)
    return jnp.exp(jnp.log(jnp.diagonal(tril)).mean())


def recurrent_mixture(
    encoder: str | Encoder = "pooled_lstm",
    components: int = 5,
    schedule: Schedule | None = None,
    features: Features = transition_features,
    **ensemble: int,
) -> MixtureDensity:
    """The paper's estimator: a recurrent encoder and a mixture of Gaussians, trained jointly.

    Source: Possas et al. 2020
    """
    encoder = lookup_encoder(encoder) if isinstance(encoder, str) else encoder
    return MixtureDensity(encoder, MixtureHead(components), schedule or Schedule(), features=features, **ensemble)


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
