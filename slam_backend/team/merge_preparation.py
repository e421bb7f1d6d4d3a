"""Preparation of a merge of large maps beside the two groups, so that no step takes long.

Once the joint graph of two groups is certain enough, their joint filter is made from their present filters. While the
groups go on, it is smoothed in slices, checked, and filled with its landmarks part by part. Then it replays the inputs
since it was made, several in each step, and replaces the groups' filters when it has caught up, as after an undo.
"""

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from slam_backend.core.read_only import as_constant, with_constants
from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.maps.alignment import Alignment, AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.branches import Branch, ReplayedStep, replay
from slam_backend.team.filter_merging.merging import merge_filters, pair_filters
from slam_backend.team.group_merging import MergePlan, PreparedTrunk, joint_trunk, judge_trial
from slam_backend.team.groups import Group
from slam_backend.team.merge_scheduler import PairKey
from slam_backend.team.options import MergeOptions
from slam_backend.team.shared_records import SharedRecords

FIRST_WAIT = 10  # steps before the joint filter is made, so that the attempt does not fall into the same decision
PACE = 4  # steps from one piece of the work to the next
REPLAYED = 4  # steps of input that the joint filter replays in each step, which itself adds one
PATIENCE = 100  # steps out of contact, in all, beyond which the merge is given up
MOST_PAIRS = 500  # common landmarks by which particles are paired: the smoother then draws other paths anyway
SPARED_IDS = 1000  # landmarks that the first group may find meanwhile; ids of the joint map lie beyond theirs

Pair = tuple[Group, Group]
Maps = tuple[LandmarkMap, LandmarkMap]


@dataclass(slots=True, eq=False)
class MergePreparation:
    """Merge of two groups in preparation. It counts steps in which the groups are in contact.

    Attributes:
        pair: Robots of the groups.
        numbers: Numbers of both joint filters' maps; the preparation ends if they change.
        maps: Maps of both joint filters when it began, with mixture covariances.
        alignment: Motion from b's map frame to a's, by the joint graph; after the trial, by the joint filter.
        unsmoothed: Alignment of the maps before they were smoothed, if they were.
        wait: Steps until the next piece of the work.
        apart: Steps out of contact so far.
        joint: Branch of the joint filter; None until it is made, and after a refusal.
        renamed: (n, 2) int64 rows (id in b, id in the joint map) of the landmarks that b had then; None until then.
        end_of_common: First id that was not given to a landmark of a then; the next `SPARED_IDS` are left to a.
        oldest: First step that the joint filter has to replay; None until it is made.
        uncertainty: Relative uncertainty of the motion by the trial, see `transform_uncertainty`; NaN before it.
        replayed: Steps replayed by the joint filter so far.
        ahead: Pieces of the work that were done ahead of time, for a snapshot.
    """

    pair: PairKey
    numbers: tuple[int, int]
    maps: Maps
    alignment: Alignment
    unsmoothed: Alignment | None
    wait: int = FIRST_WAIT
    apart: int = 0
    joint: Branch | None = None
    renamed: IntArray | None = None
    end_of_common: int = 0
    oldest: int | None = None
    uncertainty: float = math.nan
    replayed: list[ReplayedStep] = field(default_factory=list)
    ahead: int = 0
    _work: Generator[None, None, None] = field(default_factory=lambda: (None for _ in ()))

    @classmethod
    def of(cls, plan: MergePlan, unsmoothed: Alignment | None) -> Self:
        """Begin to prepare a merge."""
        a, b = plan.groups
        return cls((a.robots, b.robots), (a.trunk.number, b.trunk.number), plan.maps, plan.alignment, unsmoothed)

    # ------------------------------------------------------------------ one step

    def advance(
        self, pair: Pair, in_contact: bool, merging: MergeOptions, options: AlignmentOptions, records: SharedRecords,
        rng: np.random.Generator,
    ) -> bool:  # fmt: skip
        """Do the work of one step, and return whether the preparation is over.

        Then `joint` has caught up with the groups, or is None: the trial has shown that the motion is uncertain, or,
        with an uncertainty of NaN, the merge was given up.

        Args:
            pair: The two groups.
            in_contact: Whether they are in contact.
            merging, options: Options of merges and alignments.
            records: Records of the team.
            rng: Generator for the draws.
        """
        if not in_contact:
            self.apart += 1
            return self.apart > PATIENCE and self.give_up()
        if self.wait > 1:
            self.wait -= 1
            return False
        if self.renamed is None:
            self._join(pair, merging, options, records, rng)
            self.wait = PACE
            return False
        if self._do_piece():
            self.wait = PACE
            return False
        return self.joint is None or self._catch_up(pair, self.joint, records)

    def plan(self, pair: Pair) -> MergePlan:
        """Return the plan of the merge of two groups with which the joint filter has caught up."""
        assert self.joint is not None
        assert self.renamed is not None
        maps = pair[0].trunk.filter.map("mixture"), pair[1].trunk.filter.map("mixture")
        prepared = PreparedTrunk(self.joint, self.renamed, self.end_of_common, tuple(self.replayed))
        return MergePlan(pair, maps, _with_rows_of(maps, self.alignment, self.maps), prepared=prepared)

    def give_up(self) -> bool:
        """End without a merge and without a result of the trial; returns True."""
        self._work.close()
        self.joint, self.uncertainty = None, math.nan
        return True

    # ------------------------------------------------------------------ the joint filter

    def _join(
        self, pair: Pair, merging: MergeOptions, options: AlignmentOptions, records: SharedRecords,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Make the joint filter of both groups as they are now, and begin its trial."""
        a, b = (group.trunk.filter for group in pair)
        pairs = np.column_stack([self.maps[i].ids[self.alignment.inliers[:, i]] for i in range(2)])
        held = np.isin(pairs[:, 0], a.state.maps.ids) & np.isin(pairs[:, 1], b.state.maps.ids)
        pairs = pairs[held]
        some = pairs[:: max(-(-len(pairs) // MOST_PAIRS), 1)]
        pairing = pair_filters(a, b, self.alignment, some, rng, merging.merged_particles)
        joint, self.renamed = merge_filters(
            a, b, self.alignment, pairs, rng, pairing=pairing, on_trial=True, spared=SPARED_IDS
        )
        self.end_of_common = a.state.maps.next_id
        self.joint = joint_trunk(pair, joint, self.renamed, records.new_number())
        self.oldest = 1 + min(self.joint.last_steps.values())
        self._work = self._trial(joint, self.renamed, merging, options)

    def _trial(
        self, joint: FastSlam, renamed: IntArray, merging: MergeOptions, options: AlignmentOptions
    ) -> Generator[None, None, None]:
        """Smooth and check the joint filter and write its landmarks, a piece of the work before each of the yields."""
        joint.request_rejuvenation()
        smoother, report = joint.state.rejuvenation, None
        assert smoother is not None
        while report is None:
            report = joint.state.rejuvenate(smoother)
            yield
        self.uncertainty = math.inf
        if not report.reason:
            self.alignment, self.uncertainty = judge_trial(
                joint, len(self.pair[0]), self.maps, renamed, self.alignment, merging, options
            )
        if merging.min_sigmas * self.uncertainty > merging.prepared_uncertainty:
            self.joint = None
            return
        joint.reorder(np.argsort(self.pair[0] + self.pair[1]))
        yield
        yield from joint.state.landmarks_in_parts()

    def _do_piece(self) -> bool:
        """Do a piece of the trial, if it was not done ahead of time; return whether one was left."""
        if self.ahead:
            self.ahead -= 1
            return True
        for _ in self._work:
            return True
        return False

    def _catch_up(self, pair: Pair, joint: Branch, records: SharedRecords) -> bool:
        """Replay steps that the groups have processed, and return whether the joint filter is up to date."""
        a, b = (group.trunk for group in pair)
        if a.filter.state.maps.next_id > self.end_of_common + SPARED_IDS:
            return self.give_up()
        known = a.last_steps | b.last_steps
        wanted = {robot: last for robot, last in known.items() if last > joint.last_steps[robot]}
        done = replay(joint, records.log, wanted, REPLAYED)
        records.exchange.record_replay(done)
        self.replayed += done
        return all(joint.last_steps[robot] >= last for robot, last in wanted.items())

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return the complete state; a trial in progress is finished for it, which does not change what follows."""
        for _ in self._work:
            self.ahead += 1
        return {
            "pair": self.pair,
            "numbers": self.numbers,
            "maps": self.maps,
            "alignment": self.alignment,
            "unsmoothed": self.unsmoothed,
            "counts": (self.wait, self.apart, self.ahead, self.end_of_common),
            "oldest": self.oldest,
            "joint": None if self.joint is None else self.joint.get_state(),
            "renamed": None if self.renamed is None else as_constant(self.renamed),
            "uncertainty": self.uncertainty,
            "replayed": tuple(self.replayed),
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Make copies and pickles, for which a trial in progress is finished."""
        return MergePreparation.from_state, (self.get_state(),)

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """Build a preparation from `get_state`."""
        wait, apart, ahead, end_of_common = state["counts"]
        joint = None if state["joint"] is None else Branch.from_state(state["joint"])
        renamed = None if state["renamed"] is None else as_constant(state["renamed"])
        return cls(
            state["pair"], state["numbers"], state["maps"], state["alignment"], state["unsmoothed"], wait, apart, joint,
            renamed, end_of_common, state["oldest"], state["uncertainty"], list(with_constants(state["replayed"])),
            ahead,
        )  # fmt: skip


def _with_rows_of(now: Maps, alignment: Alignment, before: Maps) -> Alignment:
    """Return an alignment of earlier maps of two groups, with rows of the present ones as inliers."""
    inliers = alignment.inliers
    ids = np.column_stack([landmarks.ids[inliers[:, side]] for side, landmarks in enumerate(before)])
    is_present = np.isin(ids[:, 0], now[0].ids) & np.isin(ids[:, 1], now[1].ids)
    rows = [np.searchsorted(landmarks.ids, ids[is_present, side]) for side, landmarks in enumerate(now)]
    return replace(alignment, inliers=np.column_stack(rows))
