"""How equal jaxtrack and stock Stone Soup are: `python -m reference.parity` measures and publishes it."""
