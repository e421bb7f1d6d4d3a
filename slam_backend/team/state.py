"""All that a team holds, from the groups to the random stream: begun, kept and restored."""

import copy
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from slam_backend.core.state_checks import refusing
from slam_backend.core.validation import bad_argument, check_int, check_seed
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import MOST_ROBOTS, FilterOptions
from slam_backend.fastslam.reports import MergeEvent
from slam_backend.fastslam.step_input import StepInput
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.team.branches import Branch
from slam_backend.team.communication import reach
from slam_backend.team.groups import Group, Lineup
from slam_backend.team.merge_scheduler import AttemptOptions, AttemptSchedule
from slam_backend.team.options import MergeOptions
from slam_backend.team.shared_records import Records
from slam_backend.team.state_checks import TeamCheck


class TeamState:
    """What a team of K robots holds; the arguments are those of `TeamSlam`.

    Attributes:
        _groups: By ascending first robot.
        _records: What they write down in common.
        _events: All attempts, merges and undos so far, in order.
        lineup: Who goes by which filter; the same object until that changes.
        _is_stale: Whether the groups have changed since.
        _together: (K,) int64. Networks of robots that are all in contact.
        _numbers: Of all maps that are in use, as of the lineup `_last_lineup`.
        _step: Number of the next step.
        _epoch: How many merges and undos there were.
        _size: Length of the descriptors, 0 before it is known.
    """

    def __init__(
        self,
        num_robots: int,
        alignment: AlignmentOptions | None = None,
        seed: int | np.random.SeedSequence = 0,
        attempts: AttemptOptions | None = None,
        merging: MergeOptions | None = None,
        **fastslam_options: Any,
    ) -> None:
        count = check_int("num_robots", num_robots, 1, "A team has at least one robot.", MOST_ROBOTS)
        known = {field.name for field in fields(FilterOptions)}
        for name in fastslam_options:
            if name not in known:
                cure = f"Options of the filters are {', '.join(sorted(known))}."
                raise bad_argument(name, "a known argument", "a name that no option has", cure)
        options = FilterOptions(**fastslam_options)
        for name, value, kind in (
            ("alignment", alignment, AlignmentOptions),
            ("attempts", attempts, AttemptOptions),
            ("merging", merging, MergeOptions),
        ):
            if value is not None and not isinstance(value, kind):
                raise bad_argument(name, f"{kind.__name__} or None", value, f"Build one: {kind.__name__}(...).")
        if isinstance(seed, np.random.Generator):
            raise bad_argument("seed", "an int >= 0 or a SeedSequence", seed, "A team spawns a stream for each robot.")
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(check_seed(seed))
        own, *streams, of_forks = sequence.spawn(2 + count)
        self._rng = np.random.default_rng(own)
        self._alignment = AlignmentOptions() if alignment is None else alignment
        self._merging = MergeOptions() if merging is None else merging
        self._schedule = AttemptSchedule(AttemptOptions() if attempts is None else attempts, self._alignment)
        groups = [
            Group(Branch((robot,), (robot,), FastSlam.from_options(1, options, rng), {robot: -1}, robot))
            for robot, rng in enumerate(map(np.random.default_rng, streams))
        ]
        self._groups, self._records, self._num_robots = groups, Records(count, of_forks), count
        self._events: list[MergeEvent] = []
        self._together = reach(None, count)
        self._numbers = frozenset(range(count))
        self._settle()
        self._last_lineup: Lineup | None = None
        self._step = 0
        self._epoch = 0
        self._size = 0

    # ------------------------------------------------------------------ snapshots

    @property
    def kept_readings(self) -> Mapping[int, StepInput]:
        """Readings of the last steps that some filter may take in later, by step; to be looked at."""
        return self._records.log.kept

    @property
    def filter_options(self) -> FilterOptions:
        """What all filters assume, but for their number of particles."""
        return self._groups[0].trunk.filter.options

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the team goes on, random streams included.

        What is never written to (snapshots kept for an undo, readings, reports) is shared, all else is copied.
        """
        return {
            "step": self._step,
            "epoch": self._epoch,
            "rng": copy.deepcopy(self._rng.bit_generator.state),
            "events": tuple(self._events),
            "groups": [group.get_state() for group in self._groups],
            "numbers": sorted(self._numbers),
            "alignment": self._alignment,
            "merging": self._merging,
            "schedule": self._schedule.get_state(),
            "records": self._records.get_state(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the team that gave `state`.

        Raises:
            ValueError: If `state` is not one of `get_state`, or of a team of another size.
        """
        with refusing("state"):
            TeamCheck(self._num_robots, self.kept_readings, (self.filter_options,)).check("state", state)
        self._go_on_from(state)

    def _go_on_from(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that was checked."""
        self._step, self._epoch = state["step"], state["epoch"]
        self._rng.bit_generator.state = copy.deepcopy(state["rng"])
        self._events = list(state["events"])
        at_hand = {group.robots: group.trunk.filter for group in self._groups}  # filling is faster than building
        self._groups = [Group.from_state(group, at_hand) for group in state["groups"]]
        self._settle()
        self._last_lineup, self._size = None, 0
        self._numbers = frozenset(state["numbers"])
        self._alignment, self._merging = state["alignment"], state["merging"]
        self._schedule.set_state(state["schedule"])
        self._records.set_state(state["records"])

    # ------------------------------------------------------------------ within

    def _settle(self) -> None:
        """Find out who goes by which filter now."""
        self.lineup, self._is_stale = Lineup.of(self._groups), False
