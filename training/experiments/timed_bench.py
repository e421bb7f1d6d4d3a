"""What benches of times have in common: trials one after the other until Ctrl-C, and the machine that they ran on."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

BUSY = 1.2  # load of the last minute above which another process was running


def run_in_turn(
    trials: Sequence[tuple[str, Callable[[], object]]],
    on_trial: Callable[[str], None],
    should_stop: Callable[[], bool],
) -> bool:
    """Run named trials until all are done or the user stops; return whether all are done.

    Args:
        trials: Names and what runs under them.
        on_trial: Called with the name of each trial before it begins.
        should_stop: Asked before each trial.
    """
    for name, trial in trials:
        if should_stop():
            return False
        on_trial(name)
        trial()
    return True


def describe_machine() -> dict[str, Any]:
    """Return the processor, its number of cores, and the load of the last minute."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"processor": processor(), "cores": os.cpu_count(), "load_before": load}


def processor() -> str:
    """Return the processor's name, as far as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def print_caveats(console: Console, machine: Mapping[str, Any], complete: bool) -> None:
    """Say if the machine was busy, and if the user stopped the bench."""
    load = machine["load_before"]
    if load is not None and load > BUSY:
        console.print(f"The machine was busy (load {load:.1f}): times may be too long.", highlight=False)
    if not complete:
        console.print("Stopped early: the tables hold what was timed until then.", highlight=False)
