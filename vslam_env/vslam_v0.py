"""Version 0 of the environment: `vslam_v1` with all keys of observations by default."""

from functools import wraps
from inspect import signature
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from vslam_env import vslam_v1
from vslam_env.environment import ExplorationEnv


@wraps(vslam_v1.parallel_env, assigned=())  # only the signature
def parallel_env(*args: Any, **kwargs: Any) -> ExplorationEnv:
    """Make the parallel environment; see `vslam_v1.parallel_env` for the arguments."""
    given = signature(vslam_v1.parallel_env).bind(*args, **kwargs).arguments
    if given.get("observation_keys") is None and given.get("config") is None:
        given["observation_keys"] = "all"
    return vslam_v1.parallel_env(**given)


@wraps(parallel_env, assigned=())
def raw_env(*args: Any, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based (AEC) environment, unwrapped; see `parallel_env` for the arguments."""
    return vslam_v1.turn_based(parallel_env(*args, **kwargs))


@wraps(parallel_env, assigned=())
def env(*args: Any, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based (AEC) environment with PettingZoo's check of the call order."""
    return OrderEnforcingWrapper(raw_env(*args, **kwargs))
