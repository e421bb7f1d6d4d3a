"""One robot's part of a team whose robots run in processes of their own.

A robot runs a filter of its own and publishes its map and the graph of its smoother at intervals. It aligns its map
with those it has received (Sec. 3.1); a success is a *link*, which it publishes, too. Robots that links connect form a
group; each of them joins the graphs of its group at the common landmarks, and finds the same joint map. Nothing waits:
a robot that falls silent leaves its last map, and a link that later maps contradict is undone.
"""

import hashlib
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import FloatArray, argument_error, check_int, check_kind
from slam_backend.distributed.joint_map import JointMap, joint_map
from slam_backend.distributed.messages import MOST_NAME, ONE_ROBOT, Inbox, Link, SharedMap, messages_of, read_message
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import PoseEstimate, StepReport
from slam_backend.geometry import between, compose, rotate_covariances
from slam_backend.maps.alignment import align_maps
from slam_backend.maps.alignment_types import Alignment, AlignmentOptions, is_distinct
from slam_backend.maps.landmark_map import FIELDS, LandmarkMap, unchecked_map
from slam_backend.models.measurements import Measurements
from slam_backend.state import (
    MAX_INT,
    Child,
    Dict,
    Int,
    Maybe,
    Options,
    Record,
    Row,
    State,
    Text,
    accepted,
    restore,
    take,
)
from slam_backend.state.files import read_state, write_state

MAGIC = b"vslam robot state "
MOST_REFUSALS = 2  # refusals in succession after which a link is undone
Kind = Literal["linked", "moved", "kept", "refused", "undone"]
NEVER = (0, 0, 0, 0)  # step of an attempt, own number, life and number of the other
MOST_LOST = 1 << 20  # numbers of maps that a robot may have published after its state was saved


class LinkEvent(NamedTuple):
    """Outcome of an attempt to align the own map with that of another robot.

    Attributes:
        step: Number of steps of the own filter so far.
        other: Name of the other robot.
        kind: "linked", "moved" (another motion than before), "kept", "refused" or "undone".
        alignment: The alignment, or the refusal with its reason.
    """

    step: int
    other: str
    kind: Kind
    alignment: Alignment


class RobotSlam:
    """FastSLAM of one robot among others, over any transport that carries bytes.

    Args:
        name: Name of the robot, unlike those of the others; at most 64 bytes.
        team: Word that all robots of the team share: messages of others are refused.
        life: Number of this start; larger after each restart with an empty memory, such as `time.time_ns()`.
        seed: Seed of the filter, see `FastSlam`.
        share_every: Steps between two publications of the map; it is published after the first rejuvenation.
        attempt_every: Steps between two attempts to align the map with one of those received.
        min_count: Least number of measurements of the landmarks that it publishes.
        copies: Number of times that each message is sent, spread over `share_every`, for transports that lose some.
        alignment: Options of alignments.
        **options: Fields of `FilterOptions`.

    Attributes:
        filter: Filter of this robot.
        events: Outcomes of all attempts since the robot was built or loaded, in order; yours to clear.
        refused: Number of messages refused so far.
        dropped: Number of messages of its own that were replaced by later ones before `outbox` returned them.

    Raises:
        ValueError: If an argument is unknown or out of its range; the text names it.
    """

    STATE = State(
        name=Text(), life=Int(), share_every=Int(1), attempt_every=Int(1), min_count=Int(1), copies=Int(1),
        alignment=Options(AlignmentOptions), filter=Child(FastSlam), inbox=Child(Inbox), own=Maybe(Record(SharedMap)),
        number=Int(), links=Dict(Text(), Record(Link)), refusals=Dict(Text(), Int()),
        tried=Dict(Text(), Row(Int(), Int(), Int(), Int())), refused=Int(), dropped=Int(),
    )  # fmt: skip

    def __init__(
        self, name: str, *, team: str = "team", life: int = 0, seed: int | np.random.SeedSequence = 0,
        share_every: int = 50, attempt_every: int = 25, min_count: int = 2, copies: int = 1,
        alignment: AlignmentOptions | None = None, **options: Any,
    ) -> None:  # fmt: skip
        if not isinstance(name, str) or not 0 < len(name.encode()) <= MOST_NAME:
            raise argument_error("name", f"a name of 1 to {MOST_NAME} bytes", name, "Give each robot a short name.")
        self.name, self.life = name, check_int("life", life, 0, "Give a larger number after each restart.", MAX_INT)
        self._key = _key(team)
        hint = "Give a number of steps."
        self._share_every = check_int("share_every", share_every, 1, hint)
        self._attempt_every = check_int("attempt_every", attempt_every, 1, hint)
        self._min_count = check_int("min_count", min_count, 1, "Use 1 to publish all landmarks.")
        hint = "Use 1 for a transport that loses nothing, at most share_every."
        self._copies = check_int("copies", copies, 1, hint, share_every)
        self._alignment = (
            AlignmentOptions() if alignment is None else check_kind("alignment", alignment, AlignmentOptions)
        )
        self.filter = FastSlam(1, seed=seed, **options)
        if self.filter.options.rejuvenate_every is None:
            hint = "Robots tell each other what their smoothers know: give a number of steps."
            raise argument_error("rejuvenate_every", "a smoother", None, hint)
        self._inbox = Inbox()
        self._own: SharedMap | None = None
        self._number = 0
        self._links: dict[str, Link] = {}
        self._joint_key: tuple[Any, ...] = ()
        self._joined: JointMap | None = None
        self._refusals: dict[str, int] = {}
        self._tried: dict[str, tuple[int, int, int, int]] = {}  # step, own number, life and number of the other
        self._messages: list[bytes] = []  # of the latest map
        self._outbox: list[bytes] = []
        self.events: list[LinkEvent] = []
        self.refused = self.dropped = 0

    # ------------------------------------------------------------------ one step

    def step(
        self, odometry: ArrayLike | None, measurements: Measurements | None, identities: ArrayLike | None = None
    ) -> StepReport:
        """Update the filter; at intervals publish its map, and align it with one of those received.

        Args:
            odometry: (3,) [m, m, rad]. Motion since the last step, previous robot frame; None: none.
            measurements: Frame of this step, or None.
            identities: (n,) int, see `FastSlam.step`.

        Raises:
            ValueError: If an argument is ill-formed; the robot is then unchanged.
        """
        names = None if identities is None else [identities]
        report = self.filter.step([odometry], [measurements], identities=names)
        steps = self.filter.next_step
        if steps % self._share_every == 0:
            self.share()
        elif any(steps % self._share_every == k * self._share_every // self._copies for k in range(1, self._copies)):
            self._outbox += self._messages
        if steps % self._attempt_every == 0:
            self.attempt()
        return report

    def share(self) -> None:
        """Publish the map now, if it has been smoothed once: `outbox` then returns it, and no older one."""
        smoother = self.filter.rejuvenation
        if smoother is None or smoother.graph is None:
            return
        self._number += 1
        self._own = SharedMap.of(
            self.name, self.life, self._number, self.filter.next_step, self.filter.pose(),
            self.filter.map(min_count=self._min_count), smoother.graph, tuple(self._links.values()),
        )  # fmt: skip
        self.dropped += len(self._outbox)
        self._messages = messages_of(self._own, self._key)
        self._outbox = self._messages.copy()

    def outbox(self) -> list[bytes]:
        """Return the messages to all others since the last call, of the latest map alone."""
        messages, self._outbox = self._outbox, []
        return messages

    def receive(self, message: bytes) -> str | None:
        """Read a message in any order, as often as it comes; return why it is refused, None if it is not."""
        part = read_message(message, self._key)
        if isinstance(part, str):
            why: str | None = part
        elif part.robot == self.name:
            is_own = (part.life, part.number) <= (self.life, self._number)  # some transports echo
            why = None if is_own else f"expected one robot named {self.name!r}, got two: rename one"
        else:
            why = self._inbox.add(part, self.filter.descriptor_size)
        self.refused += why is not None
        return why

    # ------------------------------------------------------------------ links

    def attempt(self) -> LinkEvent | None:
        """Align the published map with that of the robot whose last attempt is longest ago, if either is newer."""
        own, maps = self._own, self._inbox.maps
        if own is None or not len(own.ids):
            return None
        self._inbox.keep(own.descriptors.shape[1])
        waiting = {
            name: self._tried.get(name, NEVER)
            for name, shared in maps.items()
            if len(shared.ids) and self._tried.get(name, NEVER)[1:] != (own.number, shared.life, shared.number)
        }
        if not waiting:
            return None
        name = min(waiting, key=lambda name: (waiting[name][0], name))
        other = maps[name]
        self._tried[name] = (self.filter.next_step, own.number, other.life, other.number)
        found = align_maps(own.landmarks(), other.landmarks(), options=self._alignment)
        self.events.append(LinkEvent(self.filter.next_step, name, self._judge(other, found), found))
        return self.events[-1]

    def _judge(self, other: SharedMap, found: Alignment) -> Kind:
        """Make, keep, move or undo the link to another robot, and return which."""
        before = self._links.get(other.robot)
        if before is not None and before.life != other.life:
            before = None
            del self._links[other.robot]
        if found.success:
            self._refusals[other.robot] = 0
            rows = found.inliers
            assert self._own is not None
            pairs = np.column_stack([self._own.ids[rows[:, 0]], other.ids[rows[:, 1]]])
            self._links[other.robot] = Link(other=other.robot, life=other.life, motion=found.transform, pairs=pairs)
            if before is None:
                return "linked"
            return "moved" if is_distinct(between(before.motion, found.transform)) else "kept"
        if before is None:
            return "refused"
        self._refusals[other.robot] += 1
        if self._refusals[other.robot] < MOST_REFUSALS:
            return "refused"
        del self._links[other.robot]
        return "undone"

    def _known_links(self) -> dict[tuple[str, str], Link]:
        """Return the link of each pair of robots: that of the one whose name comes first, if it has one."""
        known = {name: shared for name, shared in self._inbox.maps.items() if len(shared.ids)}
        if self._own is not None:
            known[self.name] = self._own
        found: dict[tuple[str, str], Link] = {}
        for by in sorted(known, reverse=True):
            for link in known[by].links:
                if link.other in known and known[link.other].life == link.life:
                    pair = (by, link.other) if by < link.other else (link.other, by)
                    found[pair] = link if by < link.other else link.inverted(by, known[by].life)
        return found

    def _joint(self) -> JointMap | None:
        """Return the joint map of the group as published; None before the own map is."""
        if self._own is None:
            return None
        links = self._known_links()
        known = {self.name: self._own} | self._inbox.maps
        key = (*((name, known[name].life, known[name].number) for name in sorted(known)), *links)
        if key != self._joint_key:
            camera, smoothing = self.filter.packed_camera, self.filter.options.smoothing
            self._joint_key, self._joined = key, joint_map(self.name, known, links, camera, smoothing, self._alignment)
        return self._joined

    # ------------------------------------------------------------------ estimates

    @property
    def group(self) -> tuple[str, ...]:
        """Names of the robots whose maps are placed in the frame of this one, itself among them, in order."""
        return tuple(sorted(self.starts()))

    def starts(self) -> dict[str, FloatArray]:
        """Return the start poses (3,) [m, m, rad] of the group, start frame of this robot."""
        joint = self._joint()
        return {self.name: np.zeros(3)} if joint is None else {name: pose.copy() for name, pose in joint.starts.items()}

    def poses(self) -> dict[str, PoseEstimate]:
        """Return the poses of the group, start frame of this robot: its own, and the last that others told."""
        own, joint = self.filter.pose(), self._joint()
        if joint is None:
            return {self.name: own}
        told = {name: PoseEstimate(each.pose, each.pose_covariance) for name, each in self._inbox.maps.items()}
        told[self.name] = own
        return {
            name: PoseEstimate(compose(moved, told[name].mean), rotate_covariances(moved[2], told[name].covariance))
            for name, moved in joint.corrections.items()
        }

    def map(self, min_count: int = 1) -> LandmarkMap:
        """Return the map of the group, start frame of this robot: as published, with its own latest landmarks.

        Args:
            min_count: Least number of measurements of the latest landmarks.
        """
        present, joint = self.filter.map(min_count=min_count), self._joint()
        if joint is None or len(joint.starts) == 1:
            return present
        latest = present.subset(~np.isin(present.ids, joint.own_ids)).moved(joint.corrections[self.name])
        parts = [[getattr(each, name) for name in FIELDS] for each in (joint.landmarks, latest)]
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        (clash,) = np.isin(joint.landmarks.ids, latest.ids).nonzero()  # others' landmarks with an id used since
        joined[FIELDS.index("ids")][clash] = 1 + joined[FIELDS.index("ids")].max() + np.arange(len(clash))
        return unchecked_map(*joined)

    # ------------------------------------------------------------------ files

    def save(self, path: str | Path) -> None:
        """Write the state to a file, from which `load` makes the robot again after its process was killed.

        Raises:
            ValueError: If the file cannot be written; an earlier one is then unchanged.
        """
        self.filter.update_logs()
        write_state(path, MAGIC, RobotSlam, take(self))

    @classmethod
    def load(cls, path: str | Path, team: str = "team") -> Self:
        """Return the robot of a file, with the maps it had received; reading the file runs none of its content.

        Its next map counts as newer than those it published after the file was written; save at once, so that this
        holds the next time, too. What it drove since then is the caller's to tell: the next odometry.

        Args:
            path: File that `save` wrote.
            team: Word that all robots of the team share; it is not in the file.

        Raises:
            ValueError: If there is no such file, or it is damaged or of another version.
        """
        found = read_state(path, MAGIC, RobotSlam, "RobotSlam.save")
        state = accepted(RobotSlam, str(path), found, ONE_ROBOT)
        robot = cls(state["name"], team=team, life=state["life"])  # with options to be replaced
        restore(robot, state)
        robot._number += MOST_LOST
        return robot


def _key(team: str) -> bytes:
    """Return the key that seals the messages of a team."""
    return hashlib.sha256(check_kind("team", team, str, "Give a word that all robots share.").encode()).digest()
