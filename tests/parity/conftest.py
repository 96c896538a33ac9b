from collections.abc import Iterator

import jax
import pytest


@pytest.fixture(scope="package", autouse=True)
def float64() -> Iterator[None]:
    """Parity is measured in double precision, as Stone Soup computes; other tests keep float32."""
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)
