"""Builder of the wheel `vslam-env-kernels`, with all kernels compiled for portable levels of x86-64.

    python -m slam_backend.core.compilation.wheel FOLDER PACKAGE ...   # packages whose kernels are compiled

The wheel holds files of the kernel cache and a manifest, and no program. It fits one minor version of Python and the
exact versions of numba and llvmlite that built it; the name of a kernel's file includes its stamp.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from base64 import urlsafe_b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.metadata import distribution, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from slam_backend.core.compilation.compiler import compile_kernels, decode_signature, find_kernel, recorded_signatures
from slam_backend.core.compilation.shipped import LEVELS, MANIFEST, PACKAGE, versions

DISTRIBUTION = "vslam-env"  # distribution with the sources of the kernels
COMPILE = "import sys; from slam_backend.core.compilation.wheel import compile_into; compile_into(*sys.argv[1:])"
INIT = '"""Compiled kernels of vslam_env: data only, read by `slam_backend.core.compilation.shipped`."""\n'
METADATA = """Metadata-Version: 2.4
Name: vslam-env-kernels
Version: {version}
Summary: Compiled kernels of vslam-env: with them nothing is compiled on the first run.
License-Expression: MIT
Requires-Python: ~={python}.0
Requires-Dist: numba=={numba}
Requires-Dist: llvmlite=={llvmlite}
"""
WHEEL = "Wheel-Version: 1.0\nGenerator: slam_backend.core.compilation.wheel\nRoot-Is-Purelib: false\nTag: {tag}\n"


def build_wheel(
    folder: Path, packages: Sequence[str], levels: Sequence[str] = tuple(LEVELS), only: str = "", workers: int = 0
) -> Path:
    """Compile the kernels of some packages for each level and write the wheel.

    Args:
        folder: Folder that gets the wheel.
        packages: Packages with recorded signatures.
        levels: Keys of `LEVELS`.
        only: Prefix of the dotted names of the kernels, to build a part of them.
        workers: Number of processes that compile; 0: one for each core.

    Returns:
        Path of the wheel.
    """
    files = {f"{PACKAGE}/__init__.py": INIT.encode()}
    with TemporaryDirectory() as scratch:
        for level in levels:
            target = {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": f"{scratch}/cache"}
            search = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            out = Path(scratch, level)
            out.mkdir()
            subprocess.run(
                [sys.executable, "-c", COMPILE, str(out), str(workers), only, *packages],
                env=os.environ | target | search, check=True,
            )  # fmt: skip
            files |= {f"{PACKAGE}/{level}/{file.name}": file.read_bytes() for file in sorted(out.iterdir())}
    about = versions() | {DISTRIBUTION: version(DISTRIBUTION)}
    files[f"{PACKAGE}/{MANIFEST}"] = json.dumps(about | {"levels": list(levels)}, indent=1).encode()
    return _pack(folder, files, about)


def compile_into(folder: str, workers: str, only: str, *packages: str) -> None:
    """Compile the kernels of some packages for the processor `NUMBA_CPU_NAME`, and copy their cache files."""
    recorded = recorded_signatures(*packages)
    signatures = {name: words for name, words in recorded.items() if name.startswith(only)}
    compile_kernels(signatures, int(workers) or None)
    for name, words in signatures.items():
        kernel: Any = find_kernel(name)
        for types in map(decode_signature, words):
            kernel.compile(types)
            cache = kernel._cache
            codegen = kernel.targetctx.codegen()
            shutil.copy(Path(cache.cache_path) / cache.file_name(types, codegen.magic_tuple()), folder)


def _pack(folder: Path, files: Mapping[str, bytes], about: Mapping[str, str]) -> Path:
    """Write a wheel; equal files give equal bytes."""
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    tag = f"{python}-{python}{getattr(sys, 'abiflags', '')}-{_platform()}"
    name = f"{PACKAGE}-{about[DISTRIBUTION]}"
    numbers = {"numba": about["numba"], "llvmlite": about["llvmlite"], "python": about["python"].split()[1]}
    metadata = METADATA.format(version=about[DISTRIBUTION], **numbers)
    info = {f"{name}.dist-info/METADATA": metadata.encode(), f"{name}.dist-info/WHEEL": WHEEL.format(tag=tag).encode()}
    everything = {**files, **info}
    record = "".join(f"{path},sha256={_digest(content)},{len(content)}\n" for path, content in everything.items())
    everything[f"{name}.dist-info/RECORD"] = f"{record}{name}.dist-info/RECORD,,\n".encode()
    folder.mkdir(parents=True, exist_ok=True)
    wheel = folder / f"{name}-{tag}.whl"
    with ZipFile(wheel, "w") as archive:
        for path, content in everything.items():
            entry = ZipInfo(path)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content, ZIP_DEFLATED, compresslevel=9)
    return wheel


def _platform() -> str:
    """Return the platform of the wheel: that of the wheel of llvmlite, without which no kernel is loaded."""
    lines = (distribution("llvmlite").read_text("WHEEL") or "").splitlines()
    tags = [line.rsplit("-", 1)[1] for line in lines if line.startswith("Tag: ")]
    return min(tags, default=sysconfig.get_platform().replace("-", "_").replace(".", "_"))


def _digest(content: bytes) -> str:
    return urlsafe_b64encode(sha256(content).digest()).rstrip(b"=").decode()


if __name__ == "__main__":
    built = build_wheel(Path(sys.argv[1]), sys.argv[2:])
    print(f"{built}: {built.stat().st_size / 1e6:.1f} MB")
