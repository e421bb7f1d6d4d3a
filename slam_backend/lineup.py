"""`Lineup`: who goes by which filter, and what of the past its filters may still ask for; it changes seldom."""

from collections.abc import Sequence
from typing import NamedTuple, Self

from slam_backend.branches import Branch, Intake
from slam_backend.groups import Group


class Lineup(NamedTuple):
    """What the groups of a team come to, as long as no group, branch or watch of a merge begins or ends.

    Attributes:
        groups: The robots of each group, by ascending first robot.
        branches: Of all groups.
        intakes: Of each, how it takes in a step.
        places: Per robot its group, the branch that it goes by, and its place in that.
        members: Per robot those whose places its filter knows, itself included, ascending.
        mates: Per robot those that go by the same filter, itself included, ascending.
        maps: Per robot the number of the map that it goes by.
        numbers: Of all maps that are in use or may be taken up again.
        oldest: The first step that some filter may have to take in yet; None: there is none.
        is_split: Whether some robots are out of contact with their group's joint filter.
        is_watched: Whether some merge can still be undone, or is being taken back.
    """

    groups: tuple[tuple[int, ...], ...]
    branches: tuple[Branch, ...]
    intakes: tuple[Intake, ...]
    places: tuple[tuple[Group, Branch, int], ...]
    members: tuple[tuple[int, ...], ...]
    mates: tuple[tuple[int, ...], ...]
    maps: tuple[int, ...]
    numbers: frozenset[int]
    oldest: int | None
    is_split: bool
    is_watched: bool

    @classmethod
    def of(cls, groups: Sequence[Group]) -> Self:
        """Return that of these groups."""
        owned = [(group, branch) for group in groups for branch in group.branches]
        by_robot = {r: (group, branch, branch.robots.index(r)) for group, branch in owned for r in branch.live}
        places = tuple(by_robot[robot] for robot in sorted(by_robot))
        oldest = [step for group in groups for step in group.steps_unknown()]
        return cls(
            groups=tuple(group.robots for group in groups),
            branches=tuple(branch for _, branch in owned),
            intakes=tuple(Intake.of(branch, branch.live) for _, branch in owned),
            places=places,
            members=tuple(branch.robots for _, branch, _ in places),
            mates=tuple(branch.live for _, branch, _ in places),
            maps=tuple(branch.number for _, branch, _ in places),
            numbers=frozenset[int]().union(*(group.numbers() for group in groups)),
            oldest=min(oldest, default=None),
            is_split=len(owned) > len(groups),
            is_watched=any(branch.watches or group.undoing is not None for group, branch in owned),
        )
