"""Signatures of the kernels that Python calls: they are compiled in advance, by several processes.

    python tests/regression/kernel_signatures.py --record   # after a change of a kernel's arguments

Wrong ones would only cost time: a kernel is compiled when it is called with others.
"""

import json
import subprocess
import sys
from pathlib import Path

from slam_backend.core.compilation.compiler import SIGNATURES, compiled_signatures
from vslam_env._warm_up import warm_up

ROOT = Path(__file__).parents[2]
PACKAGES = ("slam_backend", "vslam_env")


def main() -> int:
    """Compare the recorded signatures with those of a warm-up in this process, or record these."""
    # What is compiled here calls kernels that Python never calls; what comes from the cache brings none along.
    subprocess.run(
        [sys.executable, "-c", "import vslam_env; vslam_env.warm_up(everything=True, workers=1)"], check=True
    )
    warm_up(everything=True, workers=1)
    differs = False
    for package in PACKAGES:
        file = ROOT / package / SIGNATURES
        found = json.dumps(compiled_signatures(package), indent=1) + "\n"
        if "--record" in sys.argv:
            file.write_text(found, encoding="utf-8")
        elif file.read_text(encoding="utf-8") != found:
            differs = True
            print(f"{file.name} of {package} is not what a warm-up compiles.")
    return int(differs)


if __name__ == "__main__":
    sys.exit(main())
