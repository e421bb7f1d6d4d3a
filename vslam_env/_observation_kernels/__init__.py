"""The compiled inner loops of observations: what robots believe and scan, as the arrays that agents are handed."""

from vslam_env._observation_kernels.numbers import FAR, MAP_STATS_LIMIT, MOST_TEAMMATES, POSE_LIMIT
from vslam_env._observation_kernels.pictures import CHANNELS, MARK, SIZE
from vslam_env._observation_kernels.teams import observe_team

__all__ = ["CHANNELS", "FAR", "MAP_STATS_LIMIT", "MARK", "MOST_TEAMMATES", "POSE_LIMIT", "SIZE", "observe_team"]
