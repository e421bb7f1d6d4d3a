"""Batched teams on an accelerator: rate, numbers that are none, and a policy learned in four minutes; nine in all.

python -m studies.batched.on_gpu runs/gpu
"""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

COMMANDS: dict[str, Sequence[str]] = {  # in the order of what matters; folders are those of the run
    "rate": ("bench", "speed", "batched", "--batches", "1024", "--plays", "10", "--beside", "16"),
    "driver": ("train-batched", "--world", "office", "--batch", "1024", "--minutes", "4"),
    "evaluation": ("evaluate", "{folder}/driver", "--policies", "frontier,random_walk", "--workers", "16"),
}


def commands(folder: Path) -> list[list[str]]:
    """Return the commands, each with its own run folder."""
    return [
        [sys.executable, "-m", "training", *(word.format(folder=folder) for word in words), "--out", str(folder / name)]
        for name, words in COMMANDS.items()
    ]


def main(folder: Path) -> int:
    """Run all commands, whatever fails, and return how many failed; the tables are in the run folders, too."""
    failed = 0
    for command in commands(folder):
        begin = time.perf_counter()
        failed += subprocess.run(command, check=False).returncode != 0
        print(f"{' '.join(command[3:])}: {time.perf_counter() - begin:.0f} s\n", flush=True)
    return failed


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("Name a folder for the results: python -m studies.batched.on_gpu runs/gpu")
    sys.exit(main(Path(sys.argv[1])))
