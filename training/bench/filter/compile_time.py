"""How long a fresh installation waits for the compiler, and how long later processes wait for the cache."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

WARM_UP = """
import json, time
begin = time.perf_counter()
from slam_backend import warm_up
ready = time.perf_counter()
compiling = warm_up(everything=True)
print(json.dumps({"import_s": ready - begin, "compile_s": compiling, "warm_up_s": time.perf_counter() - ready}))
"""


def time_compilation() -> dict[str, Any]:
    """Warm the backend up in two processes that share a cache of their own, empty at first.

    Returns:
        `"cold"` and `"cached"`, each with the seconds that the import, the compiler and the whole warm-up took, and the
        size of the cache in files and bytes.
    """
    with tempfile.TemporaryDirectory() as folder:
        cold, cached = _warm_up(folder), _warm_up(folder)
        sizes = [file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()]
    return {"cold": cold, "cached": cached, "cache_files": len(sizes), "cache_bytes": sum(sizes)}


def _warm_up(cache: str) -> dict[str, float]:
    """Warm up in a new process."""
    environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", WARM_UP]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    times: dict[str, float] = json.loads(done.stdout)
    return times
