"""The turns of a step: what each robot did and saw goes into all particles, and what became of it is summed up."""

from typing import TYPE_CHECKING

from slam_backend import _kernels
from slam_backend._filter_arrays import FilterArrays
from slam_backend._journal import LONGEST
from slam_backend._kernels import IDLE, PLACED
from slam_backend._kernels.layout import CREATED
from slam_backend.errors import FloatArray, IntArray
from slam_backend.geometry import compose
from slam_backend.input_log import Seats, StepInput

if TYPE_CHECKING:
    from slam_backend._filter_state import FilterState

# The most probable particle, how many landmarks not seen for long it matched, and seven numbers of a `StepReport`.
Summary = tuple[int, int, int, int, int, int, float, float, bool]


def place(arrays: FilterArrays, robot: int, exact: FloatArray) -> None:
    """Put a robot, in all particles, where it is told that it is: (3,) [m, m, rad] in its own start frame."""
    count = arrays.num_particles
    arrays._poses[robot, :, :count] = compose(arrays._starts[robot, :, :count].T.copy(), exact).T
    arrays._frame.fill(0.0)  # it is known now


def take_turns(
    slam: "FilterState", inputs: StepInput, seats: Seats, told: IntArray
) -> tuple[Summary, list[IntArray], int]:
    """Move all robots of a filter, match what they saw, weigh and update (Algorithm 1, l. 6-8), and sum it up.

    Where one did and saw nothing no random number is drawn. The step waits in the journal then.

    Args:
        slam: Its particles and their maps are changed, its estimates written.
        inputs: What these robots, and perhaps others, read.
        seats: Of its robots there.
        told: (2, n) int64, written: what becomes of their measurements, see `Findings`.

    Returns:
        What all of it came to; slots of landmarks that turned out not to exist, to be released when nothing asks for
        their ids; and the number of measurements that were used.
    """
    maps, journal = slam._maps, slam._journal
    active = used = 0
    for robot, row in seats.heard:
        act, begin, end, _, _, _ = inputs.turns[row]
        active, used = active + (act != IDLE), used + end - begin
        if act == PLACED:
            place(slam, robot, inputs.moves[row])
    if used:
        maps.make_room(used, inputs.descriptors.shape[1])
        if len(slam._found) < len(inputs.sightings):
            slam._make_room_for(len(inputs.sightings))
    if len(journal.steps) == LONGEST:
        slam._write_down()
    journal.make_room(used)
    now = 0 if slam._rejuvenation is None else slam._rejuvenation.steps + 1
    normals = slam._rng.standard_normal((active, maps.num_particles, 3))
    means, covariances = slam._estimates
    deserted: list[IntArray] = []
    for low, high, is_over in slam._spans:
        summary = _kernels.take_turns(
            low, high, is_over, now, slam._assumed, seats.array, inputs.table, inputs.moves, normals,
            slam._of_robots, slam._blind, slam._of_particles, slam._frame,
            maps.values, maps.counts, maps.odds, maps.table, maps.maps, maps.users, maps.free_rows, maps.tops,
            maps.descriptors, maps.heads, inputs.sightings, inputs.descriptors, inputs.names,
            slam._found, slam._distances, told, means, covariances,
            journal.noted[len(journal.steps)], journal.measured, journal.num_measured,
        )  # fmt: skip
        if slam._existence is not None and not is_over and (row := seats.rows[low]) >= 0:
            _, begin, end, _, _, count = inputs.turns[row]
            if count >= 0:
                found, new_slots = slam._found[begin:end], told[CREATED, begin:end]
                deserted.append(slam._existence.weigh(maps, slam._poses[low], slam._best, found, new_slots))
    journal.steps.append(slam._steps)
    journal.num_measured += used
    return summary, deserted, used
