"""Validation of environment states before they are restored."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam_backend.core import state_checks as check
from slam_backend.core.state import MAX_DESCRIPTOR, accepted
from slam_backend.frontend import StereoFrame
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.team.merge import branches_in
from slam_backend.team.reports import LandmarkIdMap, LandmarksCreated
from slam_backend.team.team import TeamSlam
from vslam_env.belief.readings import TeamReadings
from vslam_env.belief.rendezvous import Rendezvous
from vslam_env.belief.shared_grids import NEVER_MET, GridSnapshot, GridUpdate
from vslam_env.belief.team_belief import merge_options
from vslam_env.config import EnvConfig
from vslam_env.evaluation.coverage import CoverageCells, CoverageTracker
from vslam_env.evaluation.map_scores import UNUSED
from vslam_env.evaluation.recall_credits import RecallCredits
from vslam_env.evaluation.team_metrics import BeliefSummary, RobotCounts, RobotMetrics, TeamMetrics
from vslam_env.navigation._grid_kernels import LARGEST_HALF_WIDTH as HALF_WIDTH
from vslam_env.navigation._view_kernels import NUM_GAINS
from vslam_env.navigation.candidate_slots import NUM_SLOTS
from vslam_env.navigation.candidates import NUM_CANDIDATES, NUM_REVISITS
from vslam_env.navigation.looks import check_looks
from vslam_env.navigation.occupancy_grid import check_grid
from vslam_env.sensors import LandmarkSensor, RangeFinder, StereoSensor, TeamRenderedFrames, TeamSensorFrames
from vslam_env.simulation.episode import Episode, num_shared
from vslam_env.simulation.scenario import Scenario
from vslam_env.world import World

SLOT_COLUMNS = 5
AROUND = 1.0  # [m] tolerated distance of a robot outside the bounds of the walls
STREAMS = ("odometry", "sensor", "scan", "radio")
EPISODE = (
    "scenario", "tick", "simulator", "streams", "belief", "ground_truth", "coverage", "credits", "counts", "last",
    "paths",
)  # fmt: skip


class EpisodeCheck:
    """Validation of the state of one episode.

    Args:
        config: Configuration of the environment.
        own: Running episode of the environment, if any. Objects that it shares with the state are not checked again.

    Attributes:
        scenario: Scenario to restore, set by `check`. A foreign scenario is rebuilt from its parts, so that its sensors
            need not be trusted.
    """

    def __init__(self, config: EnvConfig, own: Episode | None) -> None:
        self._config, self._own, self._count = config, own, config.num_robots
        self._tick = 0
        self.scenario: Scenario | None = None if own is None else own.scenario

    def check(self, name: str, state: Any) -> None:
        """Raise unless a value is a state of an episode.

        Raises:
            ValueError: If a part is malformed; the message names it.
        """
        own, count = self._own, self._count
        check.keys(name, state, EPISODE)
        scenario = state["scenario"]
        if own is not None and scenario is own.given_scenario:
            scenario = own.scenario
        elif own is None or scenario is not own.scenario:
            self._check_scenario(f"{name}['scenario']", scenario)
            try:
                self.scenario = scenario = Scenario.from_parts(*scenario.to_parts())
            except Exception as error:  # any error of a constructor
                check.refuse(f"{name}['scenario']", "parts that fit together", f"'{error}'")
        check.integer(f"{name}['tick']", state["tick"])
        self._tick = tick = state["tick"]
        check.keys(f"{name}['simulator']", state["simulator"], ("poses", "bumped"))
        self._check_inside(f"{name}['simulator']['poses']", state["simulator"]["poses"], scenario.world)
        check.array(f"{name}['simulator']['bumped']", state["simulator"]["bumped"], check.BOOL, (count,))
        check_streams(f"{name}['streams']", state["streams"])
        self._check_belief(f"{name}['belief']", state["belief"], scenario)
        self._check_ground_truth(f"{name}['ground_truth']", state["ground_truth"], scenario, state["belief"]["team"])
        landmarks = int(np.count_nonzero(scenario.observable_landmarks))
        sizes = {"K": count, "CELLS": len(scenario.coverage.cells), "LANDMARKS": landmarks}
        for part, kind in (("coverage", CoverageTracker), ("credits", RecallCredits)):
            accepted(kind, f"{name}[{part!r}]", dict(state[part]), sizes)
        (of_collisions, collisions), *others = check.named_items(f"{name}['counts']", state["counts"], 3)
        check.integers(of_collisions, collisions)
        check.sequence(of_collisions, collisions, count)
        for where, of_robots in others:
            check.floats(where, of_robots, (count,), 0.0)
        check.sequence(f"{name}['last']", state["last"], 2)
        self._check_readings(f"{name}['last'][0]", state["last"][0])
        self._check_frames(f"{name}['last'][1]", state["last"][1], scenario)
        *paths, (of_merges, merges) = check.named_items(f"{name}['paths']", state["paths"], 3)
        known = ((), ()) if own is None else (own.true_path, own.estimated_path)
        for (where, path), mine in zip(paths, known, strict=True):
            check.sequence(where, path, tick + 1)
            for poses in path[num_shared(path, mine) :]:  # the first ones are the episode's own
                check.floats(where, poses, (count, 3), -1e9, 1e9)
        for where, merge in check.named_items(of_merges, merges):
            check.sequence(where, merge, 3)
            check.integer(where, merge[0], 0, tick)
            check.robots(where, merge[1], count)
            check.robots(where, merge[2], count)

    # ------------------------------------------------------------------ the world

    def _check_inside(self, name: str, poses: Any, world: World) -> None:
        """Raise unless poses (K, 3) lie in a world: far outside, the physics would not terminate."""
        check.positions(name, poses, (self._count, 3))
        x_min, y_min, x_max, y_max = world.bounds
        low, high = np.array([x_min, y_min]) - AROUND, np.array([x_max, y_max]) + AROUND
        if ((poses[:, :2] < low) | (poses[:, :2] > high)).any():
            check.refuse(name, "positions inside the world", "others")

    def _check_scenario(self, name: str, scenario: Any) -> None:
        """Raise unless a value is a scenario of this configuration."""
        config, count = self._config, self._count
        check.instance(name, scenario, Scenario)
        check.instance(f"{name}.world", scenario.world, World)
        landmarks = scenario.world.landmarks
        if landmarks is None:
            check.refuse(f"{name}.world", "one with landmarks", "none")
        check.floats(f"{name}.true_starts", scenario.true_starts, (count, 3), -1e8, 1e8)
        check.floats(f"{name}.bias", scenario.bias, (count, 2))
        check.instance(f"{name}.belief_seed", scenario.belief_seed, np.random.SeedSequence)
        check_streams(f"{name}.stream_states", scenario.stream_states)
        sensor, scan, coverage = scenario.sensor, scenario.scan, scenario.coverage
        kind, wanted = (StereoSensor, config.stereo) if config.sensor == "stereo" else (LandmarkSensor, None)
        check.instance(f"{name}.sensor", sensor, kind)
        if sensor.config != (config.landmark_sensor if wanted is None else wanted):
            check.refuse(f"{name}.sensor", "one with the environment's configuration", "another")
        if isinstance(sensor, StereoSensor):
            corners, faces = sensor.corners, 2 * len(scenario.world.walls)
            check.indices(f"{name}.sensor.corners.faces", corners.faces, (len(landmarks),), 0, faces - 1)
            check.floats(f"{name}.sensor.corners.offsets", corners.offsets, (len(landmarks), 2))
            if (np.diff(corners.faces) < 0).any():
                check.refuse(f"{name}.sensor.corners.faces", "faces in order", "others")
        check.instance(f"{name}.scan", scan, RangeFinder)
        if scan.config != config.scan or sensor.robot_radius != config.robot_radius:
            check.refuse(f"{name}.scan", "one with the environment's configuration", "another")
        check.instance(f"{name}.coverage", coverage, CoverageCells)
        check.floats(f"{name}.coverage.cells", coverage.cells, (None, 2), -1e9, 1e9)
        check.array(f"{name}.observable_landmarks", scenario.observable_landmarks, check.BOOL, (len(landmarks),))
        if not scenario.observable_landmarks.any():
            check.refuse(f"{name}.observable_landmarks", "at least one observable landmark", "none")

    # ------------------------------------------------------------------ beliefs

    def _check_belief(self, name: str, belief: Any, scenario: Scenario) -> None:
        check.keys(name, belief, ("tick", "team", "grids", "candidates", "rendezvous", "goals"))
        if belief["tick"] != self._tick or type(belief["tick"]) is not int:
            check.refuse(f"{name}['tick']", f"{self._tick}, the tick of the episode", belief["tick"])
        own = None if self._own is None else self._own.belief
        team = accepted(TeamSlam, f"{name}['team']", belief["team"], {"K": self._count, "STEPS": self._tick + 1})
        branches, merges = list(branches_in(team["merges"])), team["merges"]
        landmarks = scenario.world.landmarks
        assert landmarks is not None
        for branch in branches:
            descriptors, size = branch["filter"]["maps"].descriptors, landmarks.descriptors.shape[1]
            if self._config.sensor == "landmark" and len(descriptors) and descriptors.shape[1] != size:
                check.refuse(f"{name}['team']", f"descriptors of length {size}", descriptors.shape[1])
        config, schedule = self._config.belief, merges["schedule"]
        found = [branch["filter"]["options"] for branch in branches]
        given = *found, schedule["alignment"], schedule["options"], merges["merging"]
        attempts, merging = merge_options(config, not self._config.oracle_merge)
        if given != (*[config.filter] * len(found), config.alignment, attempts, merging):
            check.refuse(f"{name}['team']", "options of the environment's configuration", "others")
        updates = {} if own is None else own.grid_updates
        self._check_grids(f"{name}['grids']", belief["grids"], updates)
        check_candidates(f"{name}['candidates']", belief["candidates"], self._count)
        accepted(Rendezvous, f"{name}['rendezvous']", dict(belief["rendezvous"]), {"K": self._count})
        check_goals(f"{name}['goals']", belief["goals"], self._count)

    def _check_grids(self, name: str, grids: Any, known: Mapping[int, GridUpdate]) -> None:
        count = self._count
        check.keys(name, grids, ("grids", "looks", "mates", "parted", "kept", "strokes"))
        for where, looks in check.named_items(f"{name}['looks']", grids["looks"], count):
            check_looks(where, looks)
        for where, grid in check.named_items(f"{name}['grids']", grids["grids"], count):
            check_grid(where, grid)
        mates = grids["mates"]
        check.instance(f"{name}['mates']", mates, tuple)
        for robot, (where, group) in enumerate(check.named_items(f"{name}['mates']", mates, count)):
            check.robots(where, group, count)
            if robot not in group or any(mates[mate] != group for mate in group):
                check.refuse(where, "robots of one group", group)
        check.indices(f"{name}['parted']", grids["parted"], (count, count), NEVER_MET, self._tick + 1)
        for where, snapshot in check.named_items(f"{name}['kept']", grids["kept"]):
            check.instance(where, snapshot, GridSnapshot)
            check.integer(f"{where}.tick", snapshot.tick, 0, self._tick + 1)
            for where_side, side in check.named_items(f"{where}.sides", snapshot.sides, 2):
                check.robots(where_side, side, count)
            check.integers(f"{where}.maps", snapshot.maps)
            check.sequence(f"{where}.maps", snapshot.maps, 3)
            check.instance(f"{where}.grids", snapshot.grids, dict)
            robots = [*snapshot.sides[0], *snapshot.sides[1]]
            if set(snapshot.grids) != set(robots) or len(set(robots)) < len(robots):
                check.refuse(f"{where}.grids", f"the grid of each of {robots}", list(snapshot.grids))
            check.instance(f"{where}.looks", snapshot.looks, dict)
            if set(snapshot.looks) != set(robots):
                check.refuse(f"{where}.looks", f"the looks of each of {robots}", list(snapshot.looks))
            for robot, looks in snapshot.looks.items():
                check_looks(f"{where}.looks[{robot}]", looks)
            for grid in snapshot.grids.values():
                check_grid(f"{where}.grids", grid)
            self._check_strokes(f"{where}.updates", snapshot.updates, known)
        self._check_strokes(f"{name}['strokes']", grids["strokes"], known)

    def _check_strokes(self, name: str, history: Any, known: Mapping[int, GridUpdate]) -> None:
        """Raise unless a value is a sequence of grid updates in ascending order of ticks."""
        count, scan = self._count, self._config.scan
        check.instance(name, history, tuple)
        last = -1
        for update in history:
            if known.get(id(update)) is not update:
                check.instance(name, update, GridUpdate)
                check.integer(f"{name}.tick", update.tick, 0, self._tick)
                check.indices(f"{name}.shared", update.shared, (count, count), 0, 1)
                check.array(f"{name}.poses", update.poses, check.FLOAT64, (count, count, 3))
                near = (np.abs(update.poses) <= check.MAX_DISTANCE).all(axis=2)
                if not (near | (np.isnan(update.poses).any(axis=2) & (update.shared == 0))).all():
                    check.refuse(f"{name}.poses", "poses of the robots that share scans", "others")
                check.floats(f"{name}.scans", update.scans, (count, scan.num_rays), 0.0, scan.max_range)
                check.array(f"{name}.bumps", update.bumps, check.BOOL, (count,))
            if update.tick <= last:
                check.refuse(name, "updates in ascending order", "others")
            last = update.tick

    # ------------------------------------------------------------------ ground-truth association

    def _check_ground_truth(self, name: str, state: Any, scenario: Scenario, team: Mapping[str, Any]) -> None:
        """Raise unless a value is the ground-truth association of a team's maps, whose rows kernels index unchecked."""
        check.keys(name, state, ("claims", "row_of", "map_of", "seen"))
        claims, row_of, count = state["claims"], state["row_of"], self._count
        check.indices(
            f"{name}['claims']", claims, (None, None), UNUSED, int(np.count_nonzero(scenario.observable_landmarks)) - 1
        )
        check.int_dict(f"{name}['row_of']", row_of, check.LANDMARK, (0, len(claims) - 1))
        if len(set(row_of.values())) < len(row_of):
            check.refuse(f"{name}['row_of']", "a row for each map", row_of)
        check.integers(f"{name}['map_of']", state["map_of"])
        check.sequence(f"{name}['map_of']", state["map_of"], count)
        numbers: set[int] = set(team["numbers"])
        for branch in branches_in(team["merges"]):
            numbers.add(branch["number"])
            if branch["split_from"] in team["numbers"]:
                numbers.add(branch["split_from"])
            maps = branch["filter"]["maps"]
            needed = max(1 + maps.ids.max(initial=-1), maps.next_id - MOST_MEASURED * self._tick)
            if needed > claims.shape[1]:
                check.refuse(f"{name}['claims']", f"entries for {needed} landmarks", f"shape {claims.shape}")
        if lacking := numbers.union(state["map_of"]) - set(row_of):
            check.refuse(f"{name}['row_of']", f"a row for map {min(lacking)}", "none")
        seen = state["seen"]
        check.instance(f"{name}['seen']", seen, dict)
        check.integers(f"{name}['seen']", tuple(seen), 0, self._tick)
        for names in seen.values():
            self._check_names(f"{name}['seen']", names, len(scenario.observable_landmarks))
        for step, inputs in team["records"]["log"]["steps"].items():
            if step not in seen or any(
                count > len(names) for (*_, count), names in zip(inputs.inputs, seen[step], strict=True)
            ):
                check.refuse(f"{name}['seen']", f"all identities of step {step}", "fewer")
        for entry in team["records"]["entries"]:
            if isinstance(entry, LandmarksCreated) and (
                entry.step not in seen or len(entry.ids) > len(seen[entry.step][entry.robot])
            ):
                check.refuse(f"{name}['seen']", f"all identities of step {entry.step}", "fewer")
            if isinstance(entry, LandmarkIdMap) and len(entry.ids_b) and entry.ids_b.max() >= claims.shape[1]:
                check.refuse(f"{name}['claims']", "an entry for each landmark", f"shape {claims.shape}")

    def _check_names(self, name: str, names: Any, landmarks: int) -> None:
        """Raise unless a value holds the true landmarks seen by each robot."""
        if isinstance(names, np.ndarray):
            check.indices(name, names, (self._count, None), -1, landmarks - 1)
            return
        for where, each in check.named_items(name, names, self._count):
            check.indices(where, each, (None,), -1, landmarks - 1)

    # ------------------------------------------------------------------ the last tick

    def _check_readings(self, name: str, readings: Any) -> None:
        count, scan = self._count, self._config.scan
        check.instance(name, readings, TeamReadings)
        if readings.odometry is not None:
            check.floats(f"{name}.odometry", readings.odometry, (count, 3))
        self._check_measurements(f"{name}.measurements", readings.measurements)
        check.floats(f"{name}.scans", readings.scans, (count, scan.num_rays), 0.0, scan.max_range)
        check.array(f"{name}.bumps", readings.bumps, check.BOOL, (count,))
        if readings.poses is not None:
            check.floats(f"{name}.poses", readings.poses, (count, 3))
        if readings.identities is not None:
            for where, names in check.named_items(f"{name}.identities", readings.identities, count):
                check.indices(where, names, (None,), -1)
        if readings.contacts is not None:
            check.array(f"{name}.contacts", readings.contacts, check.BOOL, (count, count))
        if readings.images is not None:
            self._check_images(f"{name}.images", readings.images)
        if readings.goals is not None:
            check_goals(f"{name}.goals", readings.goals, count)

    def _check_measurements(self, name: str, frames: Any) -> None:
        if not isinstance(frames, TeamMeasurements):
            for where, frame in check.named_items(name, frames, self._count):
                check.instance(where, frame, Measurements)
            return
        n = check.floats(f"{name}.points", frames.points, (None, 3))
        check_descriptors(f"{name}.descriptors", frames.descriptors, n)
        check.indices(f"{name}.ends", frames.offsets, (self._count,), 0, n)
        if (np.diff(frames.offsets) < 0).any() or frames.offsets[-1] != n:
            check.refuse(f"{name}.ends", f"ascending offsets up to {n}", "others")

    def _check_images(self, name: str, images: Any) -> None:
        camera = self._config.stereo.camera
        for where, image in check.named_items(name, images, self._count):
            check.array(where, image, check.UINT8, (camera.height, camera.width))

    def _check_frames(self, name: str, frames: Any, scenario: Scenario) -> None:
        landmarks = scenario.world.landmarks
        assert landmarks is not None
        if self._config.sensor == "stereo":
            check.instance(name, frames, TeamRenderedFrames)
            self._check_measurements(f"{name}.measurements", frames.measurements)
            self._check_names(f"{name}.true_ids", frames.true_ids, len(landmarks))
            self._check_images(f"{name}.left", frames.left)
            self._check_images(f"{name}.right", frames.right)
            for where, seen in check.named_items(f"{name}.seen", frames.seen, self._count):
                check.instance(where, seen, StereoFrame)
            return
        check.instance(name, frames, TeamSensorFrames)
        self._check_measurements(f"{name}.measurements", frames.measurements)
        most = self._config.landmark_sensor.max_measurements
        check.indices(f"{name}.names", frames.names, (self._count, most), -1, len(landmarks) - 1)
        if not isinstance(frames.measurements, TeamMeasurements):
            check.refuse(f"{name}.measurements", "TeamMeasurements", "others")
        if np.diff(frames.measurements.offsets, prepend=0).max() > most:
            check.refuse(f"{name}.measurements", f"at most {most} per robot", "more")


def check_descriptors(name: str, value: Any, n: int, size: int | None = None) -> int:  # bridge
    """Return the length of n descriptors, or refuse a wrong array or length."""
    check.floats(name, value, (n, size), -MAX_DESCRIPTOR, MAX_DESCRIPTOR, dtype=check.FLOAT32)
    return int(value.shape[1])


MOST_MEASURED = 1000  # most landmarks that all robots together create in a tick


def check_streams(name: str, streams: Any) -> None:
    """Raise unless a value holds the states of an episode's random streams."""
    check.keys(name, streams, STREAMS)
    if len(streams) != len(STREAMS):
        check.refuse(name, f"the streams {', '.join(STREAMS)}", list(streams))
    for stream, state in streams.items():
        check.generator(f"{name}[{stream!r}]", state)
        if state["bit_generator"] != "PCG64":
            check.refuse(f"{name}[{stream!r}]", "a stream of PCG64", state["bit_generator"])


def check_slots(name: str, slots: Any) -> None:
    """Raise unless a value is a state of `CandidateSlots`."""
    check.keys(name, slots, ("rows", "visits", "given_up"))
    check_rows(f"{name}['rows']", slots["rows"], (NUM_SLOTS,))
    check.indices(f"{name}['visits']", slots["visits"], (NUM_SLOTS,))
    check.floats(f"{name}['given_up']", slots["given_up"], (None, 2), -HALF_WIDTH, HALF_WIDTH)


def check_candidates(name: str, candidates: Any, count: int) -> None:
    """Raise unless a value is a state of the `TeamCandidates` of K robots."""
    check.keys(name, candidates, ("frontiers", "rows", "gains", "views", "lengths", "visits", "updates"))
    for where, slots in check.named_items(f"{name}['frontiers']", candidates["frontiers"], count):
        check_slots(where, slots)
    check_rows(f"{name}['rows']", candidates["rows"], (count, NUM_CANDIDATES - NUM_SLOTS))
    check.floats(f"{name}['gains']", candidates["gains"], (count, NUM_CANDIDATES, NUM_GAINS), 0.0)
    views = candidates["views"]
    check.array(f"{name}['views']", views, check.FLOAT64, (count, NUM_CANDIDATES, 3))
    if np.isinf(views).any():
        check.refuse(f"{name}['views']", "finite poses, or NaN", "others")
    lengths = candidates["lengths"]
    check.array(f"{name}['lengths']", lengths, check.FLOAT64, (count, NUM_CANDIDATES, count))
    if not (lengths >= 0.0).all():
        check.refuse(f"{name}['lengths']", "lengths >= 0", "others")
    check.indices(f"{name}['visits']", candidates["visits"], (count, NUM_REVISITS))
    check.integers(f"{name}['updates']", candidates["updates"])
    check.sequence(f"{name}['updates']", candidates["updates"], count)


def check_rows(name: str, rows: Any, shape: tuple[int, ...]) -> None:
    """Raise unless a value is rows of candidates, NaN in empty slots."""
    check.array(name, rows, check.FLOAT64, (*shape, SLOT_COLUMNS))
    empty = np.isnan(rows)
    held = rows[~empty[..., 0]]
    check.floats(name, held, (len(held), SLOT_COLUMNS))
    if (empty != empty[..., :1]).any() or (held.size and np.abs(held[:, :2]).max() > HALF_WIDTH):
        check.refuse(name, "positions in the grid, or NaN", "others")


def check_goals(name: str, goals: Any, count: int) -> None:
    """Raise unless a value is the goals (K, 2) of K robots, NaN where they have none."""
    check.array(name, goals, check.FLOAT64, (count, 2))
    held = goals[~np.isnan(goals[:, 0])]
    check.floats(name, held, (len(held), 2), -HALF_WIDTH, HALF_WIDTH)


def check_team_metrics(name: str, metrics: Any, count: int, with_beliefs: bool) -> None:
    """Raise unless a value is the metrics of a team of K robots, with their beliefs if these are needed."""
    check.instance(name, metrics, TeamMetrics)
    check.instance(f"{name}.per_robot", metrics.per_robot, RobotMetrics)
    for figure, row in metrics.per_robot._asdict().items():
        for where, number in check.named_items(f"{name}.per_robot.{figure}", row, count):
            check.number(where, number)
    check.instance(f"{name}.counts", metrics.counts, RobotCounts)
    for counted, numbers in metrics.counts._asdict().items():
        check.integers(f"{name}.counts.{counted}", numbers)
        check.sequence(f"{name}.counts.{counted}", numbers, count)
    check.number(f"{name}.coverage", metrics.coverage, 0.0, 1.0)
    check.integer(f"{name}.merges", metrics.merges)
    check.number(f"{name}.time", metrics.time, 0.0)
    if with_beliefs or metrics.beliefs != ():
        for where, belief in check.named_items(f"{name}.beliefs", metrics.beliefs, count):
            check.instance(where, belief, BeliefSummary)
            check.floats(f"{where}.pose_covariance", belief.pose_covariance, (3, 3))
            landmarks = check.indices(f"{where}.landmark_counts", belief.landmark_counts, (None,))
            check.floats(f"{where}.landmark_covariances", belief.landmark_covariances, (landmarks, 3, 3))
            check.array(f"{where}.landmark_claims", belief.landmark_claims, check.INT64, (landmarks,))


def check_drivers(name: str, drivers: Any, count: int) -> None:
    """Raise unless a value holds the states of the robots' goal controllers."""
    for where, driver in check.named_items(name, drivers, count):
        check.keys(where, driver, ("goal", "heading", "path"))
        if driver["goal"] is not None:
            check.floats(f"{where}['goal']", driver["goal"], (2,), -HALF_WIDTH, HALF_WIDTH)
        check.number(f"{where}['heading']", driver["heading"])
        if driver["path"] is not None:
            check.floats(f"{where}['path']", driver["path"], (None, 2), -2.0 * HALF_WIDTH, 2.0 * HALF_WIDTH)
            if not len(driver["path"]):
                check.refuse(f"{where}['path']", "at least one point", "none")
