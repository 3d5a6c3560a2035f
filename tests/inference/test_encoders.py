import jax
import jax.numpy as jnp
import pytest

from bayessim_jax.inference.encoders import ENCODERS, Lstm, frames, lookup_encoder

STEPS, FEATURES, BATCH = 12, 3, 5


def _data(key=0):
    x_key, m_key = jax.random.split(jax.random.key(key))
    x = jax.random.normal(x_key, (BATCH, STEPS, FEATURES))
    lengths = jax.random.randint(m_key, (BATCH,), 3, STEPS + 1)
    return x, jnp.arange(STEPS) < lengths[:, None]


def _naive_lstm(params, x, valid):
    """The textbook recurrence, differentiated by JAX."""
    h = jnp.zeros((x.shape[0], params["u"].shape[0]))
    s = h
    for t in range(x.shape[1]):
        i, f, o, c = jnp.split(x[:, t] @ params["w"] + params["b"] + h @ params["u"], 4, axis=-1)
        s_new = jax.nn.sigmoid(f) * s + jax.nn.sigmoid(i) * jnp.tanh(c)
        h_new = jax.nn.sigmoid(o) * jnp.tanh(s_new)
        on = valid[:, t, None]
        h, s = jnp.where(on, h_new, h), jnp.where(on, s_new, s)
    return h


def test_lstm_and_its_gradient_equal_the_textbook_recurrence():
    x, valid = _data()
    encoder = Lstm(size=7)
    params = encoder.init(jax.random.key(1), STEPS, FEATURES)
    target = jax.random.normal(jax.random.key(2), (BATCH, 7))
    ours = jax.value_and_grad(lambda p, x: (encoder.apply(p, x, valid) * target).sum(), (0, 1))(params, x)
    naive = jax.value_and_grad(lambda p, x: (_naive_lstm(p, x, valid) * target).sum(), (0, 1))(params, x)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(naive), strict=True):
        assert jnp.allclose(a, b, atol=2e-5)


@pytest.mark.parametrize("name", sorted(ENCODERS))
def test_what_comes_after_the_end_does_not_change_the_embedding(name):
    x, valid = _data()
    encoder = lookup_encoder(name)
    params = encoder.init(jax.random.key(1), STEPS, FEATURES)
    clean = jnp.where(valid[..., None], x, 0.0)
    longer = jnp.pad(clean, ((0, 0), (0, 6), (0, 0)))
    longer_valid = jnp.pad(valid, ((0, 0), (0, 6)))
    a = encoder.apply(params, clean, valid)
    b = encoder.apply(params, longer, longer_valid)
    assert jnp.allclose(a, b, atol=1e-6)
    assert a.shape[0] == BATCH


def test_frames_join_successive_steps():
    x, valid = _data()
    tokens, on = frames(x, valid, 5)
    assert tokens.shape == (BATCH, 3, 5 * FEATURES)
    assert jnp.array_equal(tokens[:, 0].reshape(BATCH, 5, FEATURES), x[:, :5])
    assert jnp.array_equal(on, jnp.stack([valid[:, :5].any(1), valid[:, 5:10].any(1), valid[:, 10:].any(1)], 1))


def test_unknown_encoder_names_the_near_miss():
    with pytest.raises(ValueError, match="did you mean 'lstm'"):
        lookup_encoder("lstmm")
