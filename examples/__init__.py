"""Short programs that use the environment from other people's libraries."""
