"""Worker process that compiles kernels.

Each input line names a kernel and a signature; it is printed when the kernel is compiled.

python -m slam_backend.core.compilation.worker
"""

import sys

from slam_backend.core.compilation.compiler import compile_lines

if __name__ == "__main__":
    compile_lines(iter(sys.stdin.readline, ""), lambda line: print(line, flush=True))
