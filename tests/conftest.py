"""What all tests share: small scenarios, builders of records, and double precision on demand."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from jax._src import compiler

from jaxtrack import Params, StaticParams, Tracks, Truths

jax.config.update("jax_default_matmul_precision", "highest")

# The fixture x64 may stay on over all examples of a property.
settings.register_profile(
    "jaxtrack",
    deadline=None,
    max_examples=25,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.register_profile("thorough", settings.get_profile("jaxtrack"), max_examples=1000)
settings.load_profile("jaxtrack")


@pytest.fixture(scope="module", autouse=True)
def frozen():
    """What a module leaves in JAX's caches is not searched for garbage again and again by the next ones."""
    yield
    gc.freeze()


@pytest.fixture
def x64():
    """Double precision while the test runs."""
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(scope="session")
def quick_code():
    """Compiler options for XLA's older generator of code, three times quicker than its new one."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:  # a version without this option
        return {}
    return options


@pytest.fixture(scope="module")
def quick_compilation(quick_code):
    """Compiles without optimising, for programs that run for milliseconds."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    # No setting of JAX holds options for all that is compiled, so they are added where it collects them.
    collect = getattr(compiler, "get_compile_options", None)

    def collect_more(*arguments, env_options_overrides=None, **named):
        options = quick_code | (env_options_overrides or {})
        return collect(*arguments, env_options_overrides=options, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "get_compile_options", collect_more, raising=False)
        yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="session")
def static():
    """Shapes small enough to compile quickly, all different so that none is mistaken for another."""
    return StaticParams(num_truths=3, max_tracks=5, max_detections=4, max_clutter=2, map_size=12, num_looks=7)


@pytest.fixture(scope="session")
def params():
    """The paper's numbers."""
    return Params()


@pytest.fixture(scope="session")
def tracks_at():
    """Builds a track list `[max_tracks]` with one live track per mean; the other slots are empty."""

    def build(means, max_tracks, position_sigma=10.0, velocity_sigma=20.0, **fields):
        means = jnp.asarray(means, dtype=float).reshape(-1, 6)
        sigmas = np.array([position_sigma, velocity_sigma] * 3)
        count = means.shape[0]
        empty = Tracks.empty(max_tracks)
        return empty.replace(
            mean=empty.mean.at[:count].set(means),
            covariance=empty.covariance.at[:count].set(jnp.diag(jnp.asarray(sigmas**2, dtype=float))),
            active=jnp.arange(max_tracks) < count,
            **fields,
        )

    return build


@pytest.fixture(scope="session")
def truths_at():
    """Builds truths `[N]` at positions `[N, 3]` with zero velocity."""

    def build(positions, alive=None):
        positions = jnp.asarray(positions, dtype=float).reshape(-1, 3)
        state = jnp.zeros((positions.shape[0], 6)).at[:, 0::2].set(positions)
        alive = jnp.ones(positions.shape[0], dtype=bool) if alive is None else jnp.asarray(alive)
        return Truths(state=state, alive=alive)

    return build
