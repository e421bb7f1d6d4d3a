"""PettingZoo environment for multi-robot SLAM exploration: robots with unknown starts build one visual map.

Importing the package registers `vslam_env/Exploration-v0` and `-v1` with PettingZoo and `vslam_env/SoloExploration-v0`
and `-v1` with Gymnasium. Numerical modules are imported at the first use of a name.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

if TYPE_CHECKING:
    from vslam_env._warm_up import warm_up
    from vslam_env.belief.team_belief import Belief
    from vslam_env.config import EnvConfig
    from vslam_env.environment import ExplorationEnv
    from vslam_env.navigation import CANDIDATE_FEATURES, NUM_CANDIDATES, CandidateKind
    from vslam_env.presets import preset_config, stereo_belief
    from vslam_env.snapshots import load_state, save_state
    from vslam_env.world import World

try:
    __version__ = version("vslam-env")
except PackageNotFoundError:  # source files that are not installed
    __version__ = "unknown"

__all__ = [
    "CANDIDATE_FEATURES",
    "NUM_CANDIDATES",
    "Belief",
    "CandidateKind",
    "EnvConfig",
    "ExplorationEnv",
    "World",
    "__version__",
    "load_state",
    "preset_config",
    "save_state",
    "stereo_belief",
    "warm_up",
]

HOMES = {  # module of each name; `vslam --help` and the completion of a shell need none of them
    "CANDIDATE_FEATURES": "navigation",
    "NUM_CANDIDATES": "navigation",
    "Belief": "belief.team_belief",
    "CandidateKind": "navigation",
    "EnvConfig": "config",
    "ExplorationEnv": "environment",
    "World": "world",
    "load_state": "snapshots",
    "preset_config": "presets",
    "save_state": "snapshots",
    "stereo_belief": "presets",
    "warm_up": "_warm_up",
}
MODULES = (
    "belief",
    "config",
    "environment",
    "navigation",
    "presets",
    "rendering",
    "reward",
    "sensors",
    "solo",
    "world",
)


def __getattr__(name: str) -> Any:
    """Import the module of a name, or a module of the package, at first use."""
    if name in MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"{__name__}.{HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *MODULES})


for _version in (0, 1):
    if hasattr(pettingzoo, "register"):  # since 1.27
        _constructors = f"vslam_env.vslam_v{_version}"
        pettingzoo.register("parallel", f"vslam_env/Exploration-v{_version}", f"{_constructors}:parallel_env")
        pettingzoo.register("aec", f"vslam_env/Exploration-v{_version}", f"{_constructors}:env")
    gymnasium.register(
        f"vslam_env/SoloExploration-v{_version}",
        "vslam_env.solo:SoloExplorationEnv",
        kwargs={"version": _version},
    )
