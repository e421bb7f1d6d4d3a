"""Worker process that compiles kernels.

Each input line names a kernel and a signature; it is printed when the kernel is compiled, with the processor time [s].

python -m slam_backend.core.compilation.worker PARENT   # number of the process with which it ends
"""

import gc
import os
import sys
import threading
import time

from slam_backend.core.compilation.compiler import compile_lines

COLLECT_EVERY = 50_000  # new objects: a compilation makes millions, few of them in cycles, and half a GB stays in use


def end_with(parent: int) -> None:
    """End this process, even amid a compilation, once its parent has ended."""
    while os.name != "posix" or os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=end_with, args=(int(sys.argv[1]),), daemon=True).start()
    gc.freeze()
    gc.set_threshold(COLLECT_EVERY, 20, 1000)
    compile_lines(iter(sys.stdin.readline, ""), lambda line, seconds: print(line, f"{seconds:.3f}", flush=True))
