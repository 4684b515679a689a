"""DR. Nav in JAX."""
