"""Navigation: occupancy grids, frontiers, candidates and path planning, independent of simulator and sensors."""

from vslam_env.navigation.candidate_slots import CandidateSlots
from vslam_env.navigation.candidates import (
    CANDIDATE_FEATURES,
    NUM_CANDIDATES,
    CandidateGains,
    CandidateKind,
    TeamCandidates,
)
from vslam_env.navigation.looks import TeamLooks
from vslam_env.navigation.occupancy_grid import (
    CELL,
    FREE,
    GRID_SIZE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    cell_of,
    centre_of,
)
from vslam_env.navigation.planning import DistanceMap, Frontiers, distance_map, find_frontiers, follow_path, plan_path
from vslam_env.navigation.relations import cells_of, frontier_cells, lengths_between, rooms_of, sees
from vslam_env.navigation.team_grids import TeamGrids
from vslam_env.navigation.tours import open_tour, share_places, tour_length
from vslam_env.navigation.validation import ray_directions

SeenGrid = OccupancyGrid  # its former name

__all__ = [
    "CANDIDATE_FEATURES",
    "CELL",
    "FREE",
    "GRID_SIZE",
    "NUM_CANDIDATES",
    "OCCUPIED",
    "UNKNOWN",
    "CandidateGains",
    "CandidateKind",
    "CandidateSlots",
    "DistanceMap",
    "Frontiers",
    "OccupancyGrid",
    "SeenGrid",
    "TeamCandidates",
    "TeamGrids",
    "TeamLooks",
    "cell_of",
    "cells_of",
    "centre_of",
    "distance_map",
    "find_frontiers",
    "follow_path",
    "frontier_cells",
    "lengths_between",
    "open_tour",
    "plan_path",
    "ray_directions",
    "rooms_of",
    "sees",
    "share_places",
    "tour_length",
]
