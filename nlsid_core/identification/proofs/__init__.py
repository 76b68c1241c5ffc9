"""The search for proofs that a model is stable; the kernel decides them."""
