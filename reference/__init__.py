"""The same problem in stock Stone Soup 1.9.1: slow, obvious, and the oracle of the parity tests.

Nothing in `jaxtrack` or `train` imports this package. Every constant comes from
`jaxtrack.params`, so that no number is typed twice.
"""
