"""Beliefs in arrays of fixed shape, for batches of teams on an accelerator; needs the extra `jax`."""
