import jax
import jax.numpy as jnp
import pytest

from bayessim_jax.inference.encoders import ENCODERS, Attention, Lstm, lookup_encoder, pool

STEPS, FEATURES, BATCH = 12, 3, 5


def _data(key=0):
    x_key, m_key = jax.random.split(jax.random.key(key))
    x = jax.random.normal(x_key, (BATCH, STEPS, FEATURES))
    lengths = jax.random.randint(m_key, (BATCH,), 3, STEPS + 1)
    return x, jnp.arange(STEPS) < lengths[:, None]


def _naive_lstm(params, x, valid):
    """The textbook recurrence, differentiated by JAX."""
    h = jnp.zeros((x.shape[0], params["u"].shape[0]))
    s = total = h
    for t in range(x.shape[1]):
        i, f, o, c = jnp.split(x[:, t] @ params["w"] + params["b"] + h @ params["u"], 4, axis=-1)
        s_new = jax.nn.sigmoid(f) * s + jax.nn.sigmoid(i) * jnp.tanh(c)
        h_new = jax.nn.sigmoid(o) * jnp.tanh(s_new)
        on = valid[:, t, None]
        h, s = jnp.where(on, h_new, h), jnp.where(on, s_new, s)
        total = total + jnp.where(on, h, 0.0)
    return total / valid.sum(1, keepdims=True)


def test_lstm_and_its_gradient_equal_the_textbook_recurrence():
    x, valid = _data()
    encoder = Lstm(size=7)
    params = encoder.init(jax.random.key(1), FEATURES)
    target = jax.random.normal(jax.random.key(2), (BATCH, 7))
    slopes = lambda f: jax.jit(jax.value_and_grad(lambda p, x: (f(p, x, valid) * target).sum(), (0, 1)))(params, x)  # noqa: E731
    ours, naive = slopes(encoder.apply), slopes(_naive_lstm)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(naive), strict=True):
        assert jnp.allclose(a, b, atol=2e-5)


@pytest.mark.parametrize("name", sorted(ENCODERS))
def test_what_comes_after_the_end_does_not_change_the_embedding(name):
    x, valid = _data()
    encoder = lookup_encoder(name)
    params = encoder.init(jax.random.key(1), FEATURES)
    clean = jnp.where(valid[..., None], x, 0.0)
    longer = jnp.pad(clean, ((0, 0), (0, 6), (0, 0)))
    longer_valid = jnp.pad(valid, ((0, 0), (0, 6)))
    a = encoder.apply(params, clean, valid)
    b = encoder.apply(params, longer, longer_valid)
    assert jnp.allclose(a, b, atol=1e-6)
    assert a.shape[0] == BATCH


def test_frames_are_means_over_their_valid_steps():
    x, valid = _data()
    means, on = pool(x, valid, 5)
    assert means.shape == (BATCH, 3, FEATURES)
    for i, k in [(0, 0), (1, 1), (2, 2)]:
        kept = x[i, 5 * k : 5 * k + 5][valid[i, 5 * k : 5 * k + 5]]
        assert jnp.allclose(means[i, k], kept.mean(0) if len(kept) else 0.0, atol=1e-6)
        assert bool(on[i, k]) == bool(len(kept))


def test_layers_that_read_each_step_come_before_the_recurrence():
    x, valid = _data()
    deep, plain = Lstm(size=7, widths=(6,)), Lstm(size=7)
    params = deep.init(jax.random.key(3), FEATURES)
    (layer,) = params["read"]
    read = jax.nn.gelu(x @ layer["w"] + layer["b"])
    assert jnp.allclose(deep.apply(params, x, valid), plain.apply(params | {"read": []}, read, valid), atol=1e-6)


def test_attention_can_weigh_independent_estimates_by_their_precisions():
    """The mean of a Gaussian given estimates of it that differ in precision, and the precision of the mean."""
    estimates = jax.random.normal(jax.random.key(0), (BATCH, 9))
    precisions = jax.random.uniform(jax.random.key(1), (BATCH, 9), minval=0.1, maxval=4.0)
    valid = jnp.arange(9) < 3 + jnp.arange(BATCH)[:, None]
    encoder = Attention(widths=(), heads=1, values=1)
    params = {
        "read": [],
        "score": {"w": jnp.array([[0.0], [1.0]]), "b": jnp.zeros(1)},
        "value": {"w": jnp.array([[1.0], [0.0]]), "b": jnp.zeros(1)},
    }
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(jnp.shape, encoder.init(jax.random.key(2), 2))
    mean, total = encoder.apply(params, jnp.stack([estimates, jnp.log(precisions)], -1), valid).T
    precisions = jnp.where(valid, precisions, 0.0)
    assert jnp.allclose(mean, (precisions * estimates).sum(1) / precisions.sum(1), atol=1e-5)
    assert jnp.allclose(jnp.exp(total), precisions.sum(1), rtol=1e-5)


def test_unknown_encoder_names_the_near_miss():
    with pytest.raises(ValueError, match="did you mean 'lstm'"):
        lookup_encoder("lstmm")
