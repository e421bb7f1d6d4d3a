"""What the last bits of results depend on: numerical libraries, Python and packages."""

import platform
from functools import cache
from importlib.metadata import version

from training.experiments.machine.numerics import numerics

PACKAGES = ("vslam-env", "numpy", "scipy", "numba", "llvmlite", "opencv-python-headless", "pymunk")


@cache
def machine() -> str:
    """Return numerics, Python and package versions as one text; where it is the same, episodes repeat bit for bit."""
    packages = (f"{name} {version(name)}" for name in PACKAGES)
    return ", ".join([numerics(), f"python {platform.python_version()}", *packages])
