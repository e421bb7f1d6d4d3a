"""Teams in arrays of fixed shape, for batches on an accelerator: world, belief and episodes; needs the extra `jax`."""

from importlib.util import find_spec

if find_spec("jax") is None:
    raise ModuleNotFoundError(
        'jax: expected the package jax, got none. Install the extra: pip install "vslam-env[jax]".', name="jax"
    )
