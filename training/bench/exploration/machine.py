"""What the last bits of results depend on: processor, Python and packages."""

import hashlib
import platform
from functools import cache
from importlib.metadata import version

PACKAGES = ("vslam-env", "numpy", "scipy", "numba", "llvmlite", "opencv-python-headless", "pymunk")


@cache
def machine() -> str:
    """Return processor, Python and package versions as one text; where it is the same, episodes repeat bit for bit."""
    import llvmlite.binding

    features = hashlib.sha256(llvmlite.binding.get_host_cpu_features().flatten().encode()).hexdigest()[:8]
    processor = f"{llvmlite.binding.get_host_cpu_name()}/{features}"
    packages = (f"{name} {version(name)}" for name in PACKAGES)
    return ", ".join([processor, f"python {platform.python_version()}", *packages])
