"""`TeamSlam`: robots that start at unknown places, one filter each, until their maps can be aligned and merged.

A group is a set of robots that share a map frame and a joint filter (Sec. 4); at the start each robot is its own
group. The frame of a group is the start frame of its first robot, the one of lowest index. From time to time one pair
of groups tries to align its maps (Sec. 3.1); when that succeeds their filters are merged particle by particle
(Sec. 3.2). A merge can be refused, with a reason: a false merge is worse than a late one. For a while after a merge the
team watches whether its maps contradict each other, and if they do it undoes the merge. Robots that lose contact with
their group go on with a fork of the joint filter, which is told on their return what they have read meanwhile.
"""

from collections.abc import Sequence

from numpy.typing import ArrayLike

from slam_backend._step_input import check_step
from slam_backend.alignment import Alignment
from slam_backend.branches import take_in
from slam_backend.contacts import check_contacts, reach
from slam_backend.errors import FloatArray, IntArray, bad_argument
from slam_backend.findings import Findings
from slam_backend.group_changes import MergePlan, contradicted, merge_groups, undone
from slam_backend.groups import Group
from slam_backend.input_log import StepInput
from slam_backend.lineup import Lineup
from slam_backend.measurements import Measurements, TeamMeasurements
from slam_backend.merging import inverse_alignment
from slam_backend.reports import MapDropped, MergeEvent, RejuvenationReport, Renaming, TeamReport
from slam_backend.team_knowledge import TeamKnowledge
from slam_backend.trying import attempt
from slam_backend.undoing import Undoing

Rejuvenation = tuple[tuple[int, ...], RejuvenationReport]  # of a filter: who goes by it, and what came of it


class TeamSlam(TeamKnowledge):
    """Visual FastSLAM for a team whose robots do not know where they start.

    Args:
        num_robots: K.
        alignment: When two maps are believed to fit together.
        attempts: When a pair of groups tries.
        merging: How filters are merged, and when a merge is undone.
        seed: Of all random streams of the team: an int or a `numpy.random.SeedSequence`.
        **fastslam_options: Of each filter; the fields of `FilterOptions`.

    Raises:
        ValueError: If an argument is unknown or out of its range; the text names it.
    """

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: FloatArray | Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None] | TeamMeasurements,
        contacts: ArrayLike | None = None,
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> TeamReport:
        """Let robots lose and find each other, step each filter, weigh the last merges, and let one pair of groups try.

        Robots pass on what they hear: who reaches another through others is in contact with it. Where robots of a
        group lose contact, the largest part (of equal ones that with the lowest robot) keeps the joint filter; each
        other part goes on with a fork of it, and the joint filter holds their poses. On return the joint filter takes
        in what they have read meanwhile, at most 20 steps of it per step; until it has caught up they go by their
        fork. Parts that meet away from the joint filter join likewise. Only the robots that keep the joint filter
        align and merge.

        Args:
            odometry: Per robot (3,) [m, m, rad], or None; see `FastSlam.step`. (K, 3) where all have moved.
            measurements: Per robot its frame, or None; or the frames of all in one piece.
            contacts: (K, K) bool, symmetric: who hears whom now; the diagonal means nothing. None = all.
            identities: Per robot (n_i,) int, see `FastSlam.step`.
            poses: Per robot (3,), see `FastSlam.step`.

        Raises:
            ValueError: If an argument is ill-formed; the team is then as before.
        """
        count, networks = self._num_robots, self._together
        if contacts is not None:
            networks = reach(check_contacts(contacts, count), count)
        lineup, size = self.lineup, self._size or self._descriptor_size()
        camera = lineup.branches[0].filter.options.camera
        inputs = check_step(count, size, camera, odometry, measurements, identities, poses)
        records, before = self._records, len(self._events)
        if contacts is not None or lineup.is_split:
            lineup = self._regrouped(networks)
        if lineup.oldest is not None:
            records.log.record(self._step, inputs)
        findings, rejuvenations = self._advance(lineup, inputs)
        if lineup.is_watched:
            self._doubt()
        renamings = self._attempt(networks) if self._schedule.is_due(self._step) else ()
        if self._is_stale:
            self._settle()
            lineup = self.lineup
        oldest = self._step + 1 if lineup.oldest is None else lineup.oldest
        if lineup is not self._last_lineup:
            self._note_dropped(lineup)
            records.log.forget_before(oldest)
        events, entries = tuple(self._events[before:]), tuple(records.entries)
        report = TeamReport(
            self._step, findings, lineup.groups, events, renamings, lineup.maps, entries, oldest, rejuvenations
        )
        records.entries.clear()
        self._step += 1
        return report

    def _regrouped(self, networks: IntArray) -> Lineup:
        """Let robots of each group lose and find each other, and return who goes by which filter then."""
        was_split = self.lineup.is_split
        for group in self._groups:
            group.regroup(networks, self._records)
        if was_split or any(len(group.branches) > 1 for group in self._groups):
            self._settle()
        return self.lineup

    def _advance(self, lineup: Lineup, inputs: StepInput) -> tuple[Findings, tuple[Rejuvenation, ...]]:
        """Step all filters with what their robots have just read; return what `TeamReport` tells of it."""
        step, records, findings = self._step, self._records, Findings.none_yet(inputs)
        rejuvenations: tuple[Rejuvenation, ...] = ()
        for branch, intake in zip(lineup.branches, lineup.intakes, strict=True):
            report = take_in(branch, step, intake, inputs, findings)
            if report.num_created:
                records.note_created(branch.number, step, report)
            if len(intake.robots) > 1:  # a robot that nobody hears sends nothing
                records.exchange.record_step(report, branch.filter.descriptor_size)
            if report.rejuvenation is not None:
                rejuvenations += ((intake.robots, report.rejuvenation),)
        findings.close()
        return findings, rejuvenations

    def merge(self, robot_a: int, robot_b: int, alignment: Alignment, known: bool = False) -> Renaming:
        """Merge the joint filters of two robots' groups with a given alignment, unasked whether it is right.

        The merge is then watched like any other; `MergeOptions(watch_steps=0)` makes it final.

        Args:
            robot_a: A robot of one group that goes by its joint filter.
            robot_b: Such a robot of the other.
            alignment: Motion from the map frame of b's group to that of a's; `inliers` are rows of `map(robot_a)` and
                `map(robot_b)`, none if the landmarks in common are not known.
            known: The motion is drawn from the alignment's covariance as it stands. Else the landmarks in common
                correct it, for each pair of particles by itself, and the covariance counts where they are few.

        Returns:
            How landmark ids changed; `robots_a` is the group whose frame stays, the one with the lowest robot.

        Raises:
            ValueError: If the robots share a group already, or one is out of contact with its joint filter, or the
                alignment is a refusal or names rows that do not exist or the same one twice; the team is then as
                before.
        """
        groups = self._group_of(robot_a), self._group_of(robot_b)
        if groups[0] is groups[1]:
            expected = f"a robot outside the group {groups[0].robots}"
            raise bad_argument("robot_b", expected, robot_b, "They share a map already.")
        for name, robot, group in zip(("robot_a", "robot_b"), (robot_a, robot_b), groups, strict=True):
            if robot not in group.trunk.live:
                cure = "Merge through a robot that goes by the joint filter."
                raise bad_argument(name, f"one of {group.trunk.live}", robot, cure)
        if not isinstance(alignment, Alignment) or not alignment.success:
            got = f"a refusal ({alignment.reason})" if isinstance(alignment, Alignment) else alignment
            raise bad_argument("alignment", "a successful Alignment", got, "Align the two maps first.")
        if groups[1].robots < groups[0].robots:
            groups, alignment = groups[::-1], inverse_alignment(alignment)
        renaming = self._merge(MergePlan.of(*groups, alignment), known)
        self._settle()
        return renaming

    def _merge(self, plan: MergePlan, known: bool = False) -> Renaming:
        """Merge two groups as planned, and write it down."""
        epoch = self._epoch + 1
        joint, renaming = merge_groups(plan, self._merging, self._records, self._rng, epoch, known)
        self._epoch = epoch
        self._events.append(MergeEvent(self._step, "merge", renaming.robots_a, renaming.robots_b, plan.alignment))
        self._replace(plan.groups, [joint])
        return renaming

    def _replace(self, old: Sequence[Group], new: Sequence[Group]) -> None:
        """Put some groups in the place of others."""
        self._groups = [group for group in self._groups if all(group is not other for other in old)] + list(new)
        self._groups.sort(key=lambda group: group.robots)
        self._is_stale = True

    def _doubt(self) -> None:
        """Weigh the evidence about the merges that can still be undone, and undo what contradicts itself."""
        due = self._step % self._merging.watch_every == 0
        for group in list(self._groups):
            if due and group.undoing is None:
                false = contradicted(group.trunk, self._merging, self._alignment)
                group.undoing = None if false is None else Undoing.of(group.trunk, false.number)
            if group.undoing is not None:
                self._undo(group, group.undoing)
                continue
            for branch in group.branches:
                while branch.watches and branch.watches[0].steps >= self._merging.watch_steps:
                    branch.watches.pop(0)
                    self._is_stale = True

    def _undo(self, group: Group, undoing: Undoing) -> None:
        """Go on with taking back a merge; it is done when all sides have caught up and are in contact."""
        merges = undoing.merges(group.trunk)
        if not merges:  # the joint filter is another one now, whose window is over
            group.undoing, self._is_stale = None, True
            return
        caught_up = undoing.catch_up(group.trunk, self._records.log)
        if not caught_up or not all(watch.together(group.trunk.live) for watch in merges):
            return
        self._epoch += 1
        self._replace([group], undone(group, undoing, self._records, self._epoch))
        for watch in merges:
            pair = (watch.sides[0].robots, watch.sides[1].robots)
            self._events.append(MergeEvent(self._step, "undo", *pair, watch.alignment))
        self._schedule.bar(pair, self._step + self._merging.barred_steps)

    def _attempt(self, networks: IntArray) -> tuple[Renaming, ...]:
        """Let a pair of groups try, and merge those whose attempt is a success."""
        options = self._schedule, self._alignment, self._merging
        tried = attempt(self._groups, networks, self._step, *options, self._records, self._rng)
        if tried is None:
            return ()
        self._events.append(tried.event)
        return () if tried.plan is None else (self._merge(tried.plan),)

    def _note_dropped(self, lineup: Lineup) -> None:
        """Write down which maps are gone since the last lineup."""
        self._records.entries += [MapDropped(number) for number in sorted(self._numbers - lineup.numbers)]
        self._last_lineup, self._numbers = lineup, lineup.numbers

    def _descriptor_size(self) -> int:
        """Return the length of the descriptors in use, 0 before the first one; it stays the same from there on."""
        self._size = max([branch.filter.descriptor_size for branch in self.lineup.branches])
        return self._size
