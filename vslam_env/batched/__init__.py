"""Teams in arrays of fixed shape, for batches on an accelerator: world, belief and episodes; needs the extra `jax`."""
