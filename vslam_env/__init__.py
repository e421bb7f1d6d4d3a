"""PettingZoo environment for multi-robot SLAM exploration: robots with unknown starts build one visual map.

Importing the package registers `vslam_env/Exploration-v0` with PettingZoo and `vslam_env/SoloExploration-v0` with
Gymnasium.
"""

from importlib.metadata import PackageNotFoundError, version

import gymnasium
import pettingzoo

from vslam_env.belief.team_belief import Belief
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.navigation import CANDIDATE_FEATURES, NUM_CANDIDATES, CandidateKind
from vslam_env.presets import preset_config, stereo_belief
from vslam_env.snapshots import load_state, save_state
from vslam_env.warm_up import warm_up
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

if hasattr(pettingzoo, "register"):  # since 1.27
    pettingzoo.register("parallel", "vslam_env/Exploration-v0", "vslam_env.vslam_v0:parallel_env")
    pettingzoo.register("aec", "vslam_env/Exploration-v0", "vslam_env.vslam_v0:env")
gymnasium.register("vslam_env/SoloExploration-v0", "vslam_env.solo:SoloExplorationEnv")
