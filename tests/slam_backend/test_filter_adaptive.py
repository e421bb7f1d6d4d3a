"""The number of particles follows what is known: many after a blind way, few once the pose is known again."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from same_bits import assert_same
from stereo_world import StereoWorld

from slam_backend.adaptation import AdaptiveParticles, next_num_particles
from slam_backend.filter import FastSlam
from slam_backend.geometry import compose
from slam_backend.motion import OdometryModel

NOISY = OdometryModel(sigma_along=0.3, sigma_across=0.2, sigma_heading=0.2)
ADAPTIVE = AdaptiveParticles(min_particles=40, max_particles=700, bin_position=0.05, bin_heading=0.02)
MOVE = np.array([0.25, 0.02, 0.3])


def run(slam: FastSlam, steps: int, blind: range = range(0), seed: int = 1) -> list[int]:
    """Drive a robot in a ring of landmarks; return the number of particles after each step."""
    world = StereoWorld(np.random.default_rng(seed))
    pose, numbers = np.zeros(3), []
    for step in range(steps):
        pose = compose(pose, MOVE)
        odometry = MOVE + world.rng.standard_normal(3) * NOISY.sigmas(MOVE)
        frame = None if step in blind else world.measure(pose, world.visible(pose))
        slam.step([odometry], [frame])
        numbers.append(slam.num_particles)
    return numbers


def adaptive_filter(**choices: Any) -> FastSlam:
    """Build a filter that resamples whenever it measures."""
    choices = {"adaptive": ADAPTIVE} | choices
    return FastSlam(num_particles=60, motion=NOISY, resample_threshold=1.0, seed=3, **choices)


def test_it_asks_for_what_the_bound_says() -> None:
    """After each resampling there are as many particles as KLD-sampling asks for, by the weights before it."""
    slam = adaptive_filter(proposal="fastslam1")
    wanted: list[int] = []
    resample = slam._resample

    def watched() -> None:
        poses = np.array([slam.particles(0)[0]])
        wanted.append(next_num_particles(ADAPTIVE, poses, slam.weights))
        resample()

    slam._resample = watched  # type: ignore[method-assign]
    numbers = run(slam, 25, range(5, 12))
    assert wanted == [n for step, n in enumerate(numbers) if step not in range(5, 12)]
    assert len(set(wanted)) > 3


def test_many_when_lost_few_when_found() -> None:
    """A blind way with the motion model alone asks for more particles than steady sight does."""
    wide = replace(ADAPTIVE, bin_position=0.5, bin_heading=0.25)
    slam = adaptive_filter(adaptive=wide)
    numbers = run(slam, 30, range(8, 20))
    assert numbers[20] > 2 * min(numbers[5:8]), "the first look after twelve blind steps"
    assert numbers[20] > 2 * max(numbers[21:])
    assert wide.min_particles <= min(numbers) <= max(numbers) <= wide.max_particles


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_new_particles_are_copies_of_their_ancestors(proposal: Any) -> None:
    """Growing or shrinking changes nothing but how many copies there are of each particle: poses, weights, maps."""
    slam = FastSlam(num_particles=37, motion=NOISY, proposal=proposal, resample_threshold=0.0, seed=5)
    run(slam, 6)
    ids, means, covariances, counts = slam._dense()
    poses = slam.particles(0)[0]
    for size in (90, 5):
        ancestors = np.sort(np.random.default_rng(size).integers(37, size=size))
        other = FastSlam()
        other.set_state(slam.get_state())
        other._become(ancestors)
        assert other.num_particles == size
        np.testing.assert_array_equal(other.particles(0)[0], poses[ancestors])
        np.testing.assert_allclose(other.weights, 1.0 / size)
        held = (counts[:, ancestors] > 0).any(axis=1)
        found = other._dense()
        np.testing.assert_array_equal(found[0], ids[held])
        np.testing.assert_array_equal(found[3], counts[held][:, ancestors])
        np.testing.assert_array_equal(found[1], means[held][..., ancestors])
        np.testing.assert_array_equal(found[2], covariances[held][..., ancestors])
        run(other, 4)


def test_a_fixed_number_is_a_special_case() -> None:
    """With min = max = M the filter does bit for bit what it does without."""
    fixed = AdaptiveParticles(min_particles=60, max_particles=60)
    one = FastSlam(num_particles=60, motion=NOISY, resample_threshold=1.0, seed=3, adaptive=fixed)
    other = FastSlam(num_particles=60, motion=NOISY, resample_threshold=1.0, seed=3)
    run(one, 10)
    run(other, 10)
    state = one.get_state()
    assert_same(
        {k: v for k, v in state.items() if k != "options"},
        {k: v for k, v in other.get_state().items() if k != "options"},
    )
    assert replace(state["options"], adaptive=None) == other.options


def test_a_snapshot_remembers_how_many_there_were() -> None:
    """A filter restored in the midst of growing goes on bit for bit."""
    slam = adaptive_filter()
    run(slam, 12, range(4, 9))
    restored = FastSlam()
    restored.set_state(slam.get_state())
    assert restored.num_particles == slam.num_particles
    run(slam, 6, range(2), seed=9)
    run(restored, 6, range(2), seed=9)
    assert_same(restored.get_state(), slam.get_state())


def test_it_has_to_be_a_rule() -> None:
    """What is no AdaptiveParticles is refused."""
    with pytest.raises(ValueError, match="adaptive: expected AdaptiveParticles or None, got 7"):
        FastSlam(adaptive=7)  # type: ignore[arg-type]
