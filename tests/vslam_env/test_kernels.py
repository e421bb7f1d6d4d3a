"""Kernels of the environment, and their warm-up."""

import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator

import pytest
from numba import types
from numba.core.dispatcher import Dispatcher

import slam_backend
import vslam_env
from slam_backend.warm_up import warm_up
from vslam_env.vslam_v0 import parallel_env

# Steps of a filter, a team and an environment; then how many arrays numba has made for them and how many it has freed.
COUNT_ARRAYS = """
import gc
from numba.core.runtime import _nrt_python, rtsys
from slam_backend.warm_up import warm_up
from vslam_env import vslam_v0

def play():
    warm_up(everything=True)
    env = vslam_v0.parallel_env()
    env.reset(seed=100)
    for _ in range(60):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    env.close()

play()
_nrt_python.memsys_enable_stats()
before = rtsys.get_allocation_stats()
play()
gc.collect()
after = rtsys.get_allocation_stats()
print(after.mi_alloc - before.mi_alloc, after.mi_free - before.mi_free)
"""


def kernels() -> Iterator[Dispatcher]:
    """All kernels of both packages, by whatever name they are imported; batched teams have none, and need jax."""
    for package in (slam_backend, vslam_env):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.startswith("vslam_env.batched."):
                found = vars(importlib.import_module(module.name)).values()
                yield from (thing for thing in found if isinstance(thing, Dispatcher))


def is_in_place(kernel: Dispatcher) -> bool:
    """Whether it is compiled without counters."""
    return kernel.targetoptions.get("_nrt") is False


def may_return_arrays(kernel: Dispatcher) -> bool:
    """Whether its annotation leaves that open, or it was compiled to do so."""
    annotation = str(inspect.signature(kernel.py_func).return_annotation)
    stated = "Array" in annotation or "ndarray" in annotation or "Any" in annotation
    return stated or any(holds_arrays(kernel.overloads[args].signature.return_type) for args in kernel.overloads)


def holds_arrays(kind: types.Type) -> bool:
    """Whether a compiled type is an array or has one within."""
    return isinstance(kind, types.Buffer) or any(map(holds_arrays, getattr(kind, "types", ())))


def called_by(kernel: Dispatcher) -> Iterator[Dispatcher]:
    """The kernels that one names in its code."""
    code, names = kernel.py_func.__code__, kernel.py_func.__globals__
    yield from (names[name] for name in code.co_names if isinstance(names.get(name), Dispatcher))


def test_kernels_that_work_in_place_neither_return_arrays_nor_call_kernels_that_do() -> None:
    """Nothing would free such an array: its counter would never come to zero."""
    warm_up(everything=True)
    env = parallel_env()
    env.reset(seed=100)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    env.close()
    those = [kernel for kernel in kernels() if is_in_place(kernel)]
    assert len(those) > 50
    for kernel in those:
        assert not may_return_arrays(kernel), kernel
        assert not any(may_return_arrays(callee) for callee in called_by(kernel)), kernel


def test_every_kernel_sets_all_options_that_it_could_inherit() -> None:
    """What numba passes on from the first caller to a kernel that leaves it unset would depend on the order."""
    every = list(kernels())
    assert len(every) > 150
    for kernel in every:
        assert kernel.targetoptions.keys() >= {"fastmath", "error_model", "forceinline", "_nrt", "nogil"}, kernel
        assert kernel.targetoptions["no_cfunc_wrapper"], kernel


def test_every_array_that_kernels_make_is_freed() -> None:
    """References that are not counted are missing nowhere."""
    done = subprocess.run([sys.executable, "-c", COUNT_ARRAYS], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    made, freed = map(int, done.stdout.split())
    assert made == freed > 1000


# What a process asks of environments after it has warmed up; each line of output is a kernel compiled or loaded late.
VARIED_USE = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from builders.environments import MEETING, small_env, turning, wander
from vslam_env import warm_up

def versions():
    modules = [m for name, m in list(sys.modules.items()) if name.startswith(("slam_backend", "vslam_env"))]
    kernels = {id(v): v for module in modules for v in vars(module).values() if isinstance(v, Dispatcher)}
    return {(kernel.py_func.__qualname__, str(s)) for kernel in kernels.values() for s in kernel.signatures}

warm_up()
before = versions()
assert before
rng = np.random.default_rng(0)
kinds = [{}, {"action_type": "goal"}, {"observation_type": "flat"}, {"oracle_pose": True}, {"oracle_association": True},
         {"comm_range": 3.0, "comm_line_of_sight": True, "comm_loss": 0.3}, {"num_robots": 3, "world": "office"}]
for kind in kinds:
    env = small_env(max_cycles=200, **kind)
    env.reset(seed=5, options={} if "world" in kind else {"start_poses": MEETING})
    circling = 100 if env.config.action_type == "continuous" else 0
    for step in range(circling + 20):
        env.step(turning(env.agents) if step < circling else wander(env, rng))
    assert "world" in kind or any(event.kind == "merge" for event in env.events), kind
    env.clone().state()
for late in sorted(versions() - before):
    print(*late)
"""


@pytest.mark.slow
def test_nothing_is_compiled_after_the_warm_up() -> None:
    """Environments that merge, with any kind of action and oracle, need no kernel that is not ready by then."""
    beside = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # where the small environment is
    done = subprocess.run([sys.executable, "-c", VARIED_USE], env=beside, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
