"""Programs whose number stays bounded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax._programs import bounded_jit


def compiled(caplog, function, sizes):
    """How often a function is compiled for arrays of these sizes."""
    given = [jax.device_put(np.ones(n, np.float32)) for n in sizes]
    caplog.clear()
    with jax.log_compiles():
        for x in given:
            function(x)
    made = (r.getMessage() for r in caplog.records)
    return sum("Finished XLA compilation of jit(halved)" in m for m in made)


def test_programs_are_kept_up_to_a_number(caplog):
    @bounded_jit(keep=2)
    def halved(x):
        return 0.5 * x

    assert compiled(caplog, halved, [1, 2, 1, 2, 1, 2]) == 2
    # The third takes the place of all.
    assert compiled(caplog, halved, [3, 1, 2, 3]) == 4


def test_transformed_and_nested_it_is_the_function():
    @bounded_jit(static_argnames=("power",), keep=2)
    def raised(x, power):
        return x**power

    x = jnp.arange(1.0, 4.0)
    np.testing.assert_allclose(raised(x, power=2), x * x)
    np.testing.assert_allclose(jax.vmap(lambda v: raised(v, power=3))(x), x**3, rtol=1e-6)
    assert float(jax.grad(lambda v: raised(v, power=2))(jnp.float32(3.0))) == 6.0
    np.testing.assert_allclose(jax.jit(lambda v: 2.0 * raised(v, power=2))(x), 2.0 * x * x)
    assert float(raised(3.0, power=2)) == 9.0


def test_own_options_within_a_program_would_be_refused():
    """Why nested calls have none."""
    options = {"xla_cpu_use_fusion_emitters": False}
    inner = jax.jit(lambda x: 0.5 * x, compiler_options=options)
    with pytest.raises(ValueError, match="compiler_options"):
        jax.jit(lambda x: inner(x) + 1.0)(jnp.ones(2))
