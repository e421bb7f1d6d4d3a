import os
import subprocess
import sys

import pytest

# What a process asks of environments after it has warmed up; each line of output is a kernel compiled or loaded late.
VARIED_USE = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from small_env import MEETING, small_env, turning, wander
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
