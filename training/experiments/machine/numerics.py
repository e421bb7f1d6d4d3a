"""What the last bits of results depend on beside versions: vector instructions of NumPy, kernels of OpenBLAS, libm.

All three choose code by the processor. Compiled kernels were not seen to matter: no sum is reordered, and lane kernels
fuse the same products and sums on all processors that can. The first two choices can be made otherwise by variables of
the environment, so that a process on a newer processor gives the bits of an older one.
"""

import platform
from functools import cache

import numpy as np

DISABLED = "NPY_DISABLE_CPU_FEATURES"  # variables that are read when NumPy and OpenBLAS are loaded
CORE = "OPENBLAS_CORETYPE"
NEEDED_BY_CORE = {"Haswell": "X86_V3", "SkylakeX": "X86_V4"}  # kernels that can be asked for safely
PORTABLE = "SIMD X86_V3, OpenBLAS Haswell"  # of all processors with AVX2


@cache
def numerics() -> str:
    """Return what the last bits of this process depend on, as `SIMD X86_V3, OpenBLAS Haswell, glibc 2.36`."""
    system = " ".join(platform.libc_ver()).strip() or f"{platform.system()} {platform.release()}"
    return f"SIMD {' '.join(_vector_instructions())}, OpenBLAS {' '.join(_blas_cores()) or 'none'}, {system}"


def variables_for(wanted: str) -> dict[str, str]:
    """Return variables of the environment with which a new process has the numerics of another machine.

    Args:
        wanted: Text that begins as `numerics` does.

    Returns:
        Variables by name; none where this processor cannot do it, or gives the same without.
    """
    parts = dict(part.partition(" ")[::2] for part in wanted.split(", "))
    instructions, core = parts.get("SIMD", "").split(), parts.get("OpenBLAS", "")
    here = _vector_instructions()
    if not instructions or not set(instructions) <= set(here):
        return {}
    settings = {}
    if more := [name for name in here if name not in instructions]:
        settings[DISABLED] = " ".join(more)
    if core in NEEDED_BY_CORE and NEEDED_BY_CORE[core] in here and _blas_cores() != [core]:
        settings[CORE] = core
    return settings


def _vector_instructions() -> list[str]:
    """Return the vector instructions beyond the least that NumPy uses here."""
    return list(np.show_config(mode="dicts")["SIMD Extensions"].get("found", ()))


def _blas_cores() -> list[str]:
    """Return the processors for which NumPy's and SciPy's copies of OpenBLAS were chosen: one, if they agree.

    OpenCV has a copy of its own, which is loaded later; no recorded result depends on it.
    """
    import scipy.linalg  # noqa: F401  # loads its copy
    from threadpoolctl import threadpool_info

    blas = [library for library in threadpool_info() if "opencv" not in library["filepath"]]
    return sorted({str(library["architecture"]) for library in blas if "architecture" in library})
