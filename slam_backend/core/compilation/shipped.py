"""Kernels shipped by the package `vslam-env-kernels`, compiled for portable levels of x86-64.

The package is installed like any other, and its files have the same trust. They are only read.
"""

import json
import logging
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
from numba.core.codegen import get_host_cpu_features

LOGGER = logging.getLogger("slam_backend")
CONFIG: Any = numba.config
PACKAGE = "vslam_env_kernels"
MANIFEST = "manifest.json"
# Processor features of each level, highest first, beyond those of all 64-bit processors.
V2 = frozenset({"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"})
V3 = V2 | {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"}
V4 = V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
LEVELS = {"x86-64-v4": V4, "x86-64-v3": V3}

_warned: set[str] = set()


@dataclass(frozen=True)
class ShippedKernels:
    """Shipped kernels of one level.

    Attributes:
        folder: Folder of the files.
        target: Triple, processor and features of the kernels, as the code generator names them.
    """

    folder: Path
    target: tuple[str, str, str]


@lru_cache
def shipped_kernels() -> ShippedKernels | None:
    """Return the installed kernels that this process can run; None: none, and it compiles all kernels."""
    spec = find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations or is_pinned():
        return None
    folder = Path(spec.submodule_search_locations[0])
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        why, level = reason_against(manifest, host_features())
    except (OSError, ValueError, KeyError, TypeError) as error:
        why, level = f"{MANIFEST} cannot be read: {error}", ""
    if why:
        warn_once("shipped", f"The kernels of vslam-env-kernels are not used ({why}): kernels are compiled here.")
        return None
    return ShippedKernels(folder / level, (manifest["triple"], level, ""))


def reason_against(manifest: Mapping[str, Any], features: Collection[str]) -> tuple[str, str]:
    """Return the reason why shipped kernels cannot be used, or their level for a processor.

    Args:
        manifest: Versions that the kernels were compiled with, and their levels.
        features: Features of the processor.

    Returns:
        Reason, empty if they can be used; level, empty if they cannot.
    """
    for name, here in versions().items():
        if manifest[name] != here:
            return f"built for {name} {manifest[name]}, this is {here}", ""
    for level, needed in LEVELS.items():
        if level in manifest["levels"] and needed <= set(features):
            return "", level
    return f"this processor is below {min(manifest['levels'])}", ""


def versions() -> dict[str, str]:
    """Return the versions that compiled kernels depend on besides their sources, by name in the manifest."""
    return {
        "python": f"{sys.implementation.name} {sys.version_info[0]}.{sys.version_info[1]}",
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "triple": llvmlite.binding.get_process_triple(),
    }


def host_features() -> set[str]:
    """Return the names of the processor features that numba may use."""
    flags = get_host_cpu_features().split(",")  # type: ignore[no-untyped-call]
    return {flag[1:] for flag in flags if flag.startswith("+")}


def is_pinned() -> bool:
    """Return whether the user chose the processor that kernels are compiled for."""
    return CONFIG.CPU_NAME is not None or CONFIG.CPU_FEATURES is not None


def warn_once(subject: str, text: str) -> None:
    """Log the first warning on a subject in this process."""
    if subject not in _warned:
        _warned.add(subject)
        LOGGER.warning(text)
