"""Process that compiles kernels: reads lines of a kernel's name and a signature, prints each when it is compiled.

python -m slam_backend.core.compile_kernels
"""

import sys

from slam_backend.core.kernel_compiler import compile_lines

if __name__ == "__main__":
    compile_lines(iter(sys.stdin.readline, ""), lambda line: print(line, flush=True))
