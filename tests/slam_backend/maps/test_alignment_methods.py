"""Methods of alignment find the motion among wrong matches, and refuse what is ambiguous."""

from dataclasses import replace

import numpy as np
import pytest
from builders.maps import D, blurred, unit

from slam_backend.geometry import between, inverse, transform_points
from slam_backend.maps import initial_estimates as proposals
from slam_backend.maps.alignment import (
    METHODS,
    REASONS,
    AlignmentOptions,
    align_maps,
    candidate_matches,
    propose_motion,
)
from slam_backend.maps.descriptor_matching import count_similar, similar_pairs
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.registration import drop_unverified, gauss_newton_step, largest_influence
from slam_backend.maps.verification import has_perceptual_alias, unexplained

TURNED = np.array([4.0, -3.0, 2.0])


def landmark_map(rng: np.random.Generator, points: np.ndarray, looks: np.ndarray | None = None) -> LandmarkMap:
    """Build a map of points known to 2 cm; without `looks` each looks different."""
    d = rng.standard_normal((len(points), D)) if looks is None else looks
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return LandmarkMap(points, np.tile(4e-4 * np.eye(3), (len(points), 1, 1)), d)


def seen_from(m: LandmarkMap, pose: np.ndarray, wrong: int, rng: np.random.Generator) -> LandmarkMap:
    """Return m in frame b, `pose` = a_from_b, with noise, and its last `wrong` landmarks anywhere in its area."""
    points = m.means.copy()
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    if wrong:
        points[-wrong:, :2] = rng.uniform(low, high, (wrong, 2))
    points += 0.02 * rng.standard_normal(points.shape)
    return replace(m, means=transform_points(inverse(pose), points))


def off(found: np.ndarray | None, truth: np.ndarray) -> float:
    """Return how far a motion is off [m + rad]."""
    assert found is not None
    return float(np.abs(between(truth, found)).sum())


@pytest.mark.parametrize(("method", "wrong"), [("icp", 8), ("impicp", 8), ("ransac", 85)])
def test_methods_find_the_motion_among_wrong_matches(method: str, wrong: int) -> None:
    """Of 100 matches so many may be wrong; the closed form alone is then far off."""
    for seed in range(5):
        rng = np.random.default_rng([seed, wrong])
        a = landmark_map(rng, rng.uniform(0.0, [20.0, 15.0, 1.5], (100, 3)))
        b = seen_from(a, TURNED, wrong, rng)
        assert off(propose_motion(a, b, "svd"), TURNED) > 0.2
        found = align_maps(a, b, method)
        assert found.success, found.reason
        assert off(found.transform, TURNED) < 0.05
        assert len(found.inliers) >= 100 - wrong


def test_closest_points_need_a_start_and_the_better_of_two_is_kept() -> None:
    """ICP from nearby ends at the motion; where all candidates start it off wrongly, the half most alike may not."""
    rng = np.random.default_rng(7)
    a = landmark_map(rng, rng.uniform(0.0, [20.0, 15.0, 1.5], (80, 3)))
    b = seen_from(a, TURNED, 0, rng)
    assert off(proposals.icp(a, b, np.add(TURNED, [0.3, -0.2, 0.02])), TURNED) < 0.02
    assert off(proposals.icp(a, b, np.add(TURNED, [0.0, 0.0, 2.0])), TURNED) > 0.5
    met = dict.fromkeys(("icp", "impicp"), 0)
    for seed in range(20):
        rng = np.random.default_rng([7, seed])
        a = landmark_map(rng, rng.uniform(0.0, [20.0, 15.0, 1.5], (80, 3)))
        b = seen_from(a, TURNED, 40, rng)
        looks = b.descriptors.copy()
        looks[40:] += 0.2 * rng.standard_normal((40, D)).astype(np.float32) / np.sqrt(np.float32(D))
        for method in met:
            met[method] += off(propose_motion(a, replace(b, descriptors=looks), method), TURNED) < 0.1
    assert met["impicp"] > met["icp"]
    assert met["impicp"] == 20


def test_one_far_match_cannot_turn_the_others() -> None:
    """Where landmarks lie close together, a wrong match far away that turning makes fit leaves the motion as it is."""
    rng = np.random.default_rng(9)
    near = landmark_map(rng, rng.uniform(0.0, [4.0, 4.0, 1.5], (12, 3)))
    far_a, far_b = np.array([30.0, 2.0, 1.0]), np.array([30.0, 2.6, 1.0])  # 0.02 rad about the others
    looks = rng.standard_normal((1, D)).astype(np.float32)
    looks /= np.linalg.norm(looks)
    a, b = (
        LandmarkMap(
            np.vstack([near.means, far]), np.concatenate([near.covariances, near.covariances[:1]]),
            np.vstack([near.descriptors, looks]),
        )
        for far in (far_a, far_b)
    )  # fmt: skip
    found, without = align_maps(a, b), align_maps(near, near)
    np.testing.assert_allclose(found.transform, without.transform, atol=1e-6)
    np.testing.assert_allclose(found.covariance, without.covariance, rtol=1e-6)
    assert 12 not in found.inliers[:, 0]


def test_the_influence_of_a_match_is_what_leaving_it_out_does() -> None:
    """The largest step equals, to first order, the difference to the motion fitted without the worst match."""
    rng = np.random.default_rng(19)
    table = np.zeros((12, 18))
    table[:, 3:6] = rng.uniform(0.0, [6.0, 4.0, 1.5], (12, 3))
    table[:, :3] = transform_points(TURNED, table[:, 3:6]) + 0.05 * rng.standard_normal((12, 3))
    table[4, :2] += [0.3, -0.2]
    table[:, [6, 9, 11, 12, 15, 17]] = 0.0025

    def fit(members: np.ndarray) -> np.ndarray:
        pose = TURNED
        for _ in range(20):
            pose = gauss_newton_step(table, members, pose, 1e-8)
        return pose

    everyone = np.ones(12, np.bool_)
    pose = fit(everyone)
    steps = []
    for i in range(12):
        rest = everyone.copy()
        rest[i] = False
        steps.append(fit(rest) - pose)
    farthest, widest = largest_influence(table, everyone, pose, 1e-8)
    assert farthest == pytest.approx(max(np.hypot(*step[:2]) for step in steps), rel=0.05)
    assert widest == pytest.approx(max(abs(step[2]) for step in steps), rel=0.05)
    assert largest_influence(np.tile(table[:1], (3, 1)), np.ones(3, np.bool_), pose, 1e-8) == (np.inf, np.inf)


def test_a_motion_that_depends_on_one_match_is_refused() -> None:
    """Where leaving out one match would move the result by half of what makes an alignment false, it is refused."""
    rng = np.random.default_rng(20)
    points = rng.uniform([12.0, 0.0, 0.0], [15.0, 3.0, 1.5], (12, 3))
    points[0, :2] = [17.0, 1.5]
    a = landmark_map(rng, points)
    wide = replace(a, covariances=np.tile(0.01 * np.eye(3), (12, 1, 1)))
    moved = wide.means.copy()
    moved[0, 1] += 0.25
    b = replace(wide, means=transform_points(inverse(TURNED), moved))
    lax = AlignmentOptions(max_sigma_position=1.0, max_sigma_heading=0.2)
    assert align_maps(wide, wide.moved(inverse(TURNED)), options=lax).success
    assert align_maps(wide, b, options=lax).reason == "too uncertain"


def test_unexplained_residuals_widen_the_covariance() -> None:
    """Residuals three times as large as may be explained have a Birge ratio of nine; those of chance have one."""
    rng = np.random.default_rng(22)
    table = np.zeros((400, 18))
    table[:, 3:6] = rng.uniform(0.0, 9.0, (400, 3))
    everyone, none = np.ones(400, np.bool_), np.zeros(400, np.bool_)
    for factor, ratio in ((3.0, 9.0), (1.0, 1.0), (0.1, 1.0)):
        table[:, :3] = table[:, 3:6] + 0.1 * factor * rng.standard_normal((400, 3))
        # The median of 400 has a standard deviation of 6 %.
        assert unexplained(table, everyone, np.zeros(3), 0.01) == pytest.approx(ratio, rel=0.25)
    assert unexplained(table, none, np.zeros(3), 0.01) == 1.0


def test_members_without_extent_are_left_alone() -> None:
    """Coincident landmarks say nothing about the rotation, and none of them is taken out for it."""
    table = np.zeros((5, 18))
    table[:, 6] = table[:, 9] = table[:, 11] = 0.01
    members = np.ones(5, np.bool_)
    drop_unverified(table, members, np.zeros(3), 0.01)
    assert members.all()


def corridor(rng: np.random.Generator, low: int, high: int) -> LandmarkMap:
    """Draw landmarks on the two walls of a corridor 20 m long and 2.4 m wide."""
    points = rng.uniform(0.0, [20.0, 0.02, 1.5], (low + high, 3))
    points[low:, 1] += 2.4
    return landmark_map(rng, points)


@pytest.mark.parametrize("method", METHODS)
def test_mirrored_corridors_are_refused(method: str) -> None:
    """One wall of a mirrored corridor fits a motion; the image fits all. What is not mirrored is accepted."""
    rng = np.random.default_rng(10)
    a = corridor(rng, 60, 20)
    mirrored = replace(a, means=a.means * [1.0, -1.0, 1.0])
    assert not align_maps(a, mirrored, method).success
    assert align_maps(a, a.moved(TURNED), method).success
    assert align_maps(a, mirrored).reason == "mirrored"
    poor = corridor(rng, 95, 5)  # nearly all on one wall
    assert align_maps(poor, replace(poor, means=poor.means * [1.0, -1.0, 1.0])).reason == "mirrored"
    assert align_maps(poor, poor.moved(TURNED), method).success


def test_a_shared_cluster_makes_no_rival() -> None:
    """Turning a small cluster by some degrees is uncertainty, not another place: it is not refused as ambiguous."""
    rng = np.random.default_rng(11)
    for _ in range(10):
        a = landmark_map(rng, np.vstack([
            rng.uniform(0.0, [3.0, 3.0, 1.5], (20, 3)), rng.uniform(-15.0, [15.0, 15.0, 1.5], (120, 3)),
        ]))  # fmt: skip
        assert align_maps(a, seen_from(a, TURNED, 120, rng)).reason != "ambiguous"


def threefold(rng: np.random.Generator, n: int, shared: int) -> tuple[LandmarkMap, LandmarkMap]:
    """Draw two maps of n landmarks, of which `shared` are common and of all of which three always look the same."""
    points = rng.uniform(0.0, [20.0, 15.0, 1.5], (2 * n - shared, 3))
    classes = rng.standard_normal((len(points) // 3 + 1, D))
    looks = (classes / np.linalg.norm(classes, axis=1, keepdims=True))[rng.permutation(len(points)) // 3]
    a, b = (
        landmark_map(rng, points[rows], looks[rows] + 0.15 * rng.standard_normal((n, D)) / np.sqrt(D))
        for rows in (slice(n), slice(n - shared, None))
    )
    return a, seen_from(b, TURNED, 0, rng)


def test_similar_pairs_are_those_within_the_gate() -> None:
    """All pairs within the gate, but none of a landmark with more of them than are allowed: as a plain search says."""
    rng = np.random.default_rng(16)
    a, b = threefold(rng, 90, 45)
    distances = np.linalg.norm(a.descriptors[:, None].astype(float) - b.descriptors[None].astype(float), axis=2)
    within = distances <= 0.45
    for most in (2, 3):
        kept = within & (within.sum(axis=1) <= most)[:, None] & (within.sum(axis=0) <= most)
        assert similar_pairs(a.descriptors, b.descriptors, 0.45, most).tolist() == np.argwhere(kept).tolist()
        assert kept.sum() > 10
    assert similar_pairs(a.descriptors[:0], b.descriptors, 0.45, 3).shape == (0, 2)


@pytest.mark.parametrize("size", [1, 6, 40, 46, 64])
@pytest.mark.parametrize("length", [1.0, 10.0])
def test_near_descriptors_are_found_whatever_their_first_components(size: int, length: float) -> None:
    """Descriptors of any size and length within the gate are found, whichever components differ."""
    rng = np.random.default_rng(size)
    a = length * rng.normal(size=(70, size)) / np.sqrt(size)
    shift = rng.normal(size=(300, size)) * (rng.random((300, size)) < rng.random((300, 1)))
    shift *= 0.9 * rng.random((300, 1)) / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-9)
    a, b = a.astype(np.float32), (a[rng.integers(0, 70, 300)] + shift).astype(np.float32)
    distances = np.linalg.norm(a[:, None].astype(float) - b[None].astype(float), axis=2)
    surely, maybe = (np.count_nonzero(distances <= 0.45 + off) for off in (-2e-5 * length**2, 2e-5 * length**2))
    assert surely <= count_similar(a, b, 0.45) <= maybe
    assert surely > 100


def test_geometry_distinguishes_similar_landmarks() -> None:
    """Where three of all landmarks look the same hardly any stands out, and yet nearly all common ones are found."""
    a, b = threefold(np.random.default_rng(17), 120, 50)
    assert align_maps(a, b, options=AlignmentOptions(max_similar=0)).reason == "too few candidates"
    found = align_maps(a, b)
    assert found.success, found.reason
    assert off(found.transform, TURNED) < 0.05
    assert 48 <= len(found.inliers) <= 51
    assert len(np.unique(found.inliers[:, 0])) == len(np.unique(found.inliers[:, 1])) == len(found.inliers)


def test_similar_landmarks_elsewhere_are_not_matched() -> None:
    """Without a common landmark similar ones agree only by chance, and the alignment is refused."""
    for seed in range(20):
        a, b = threefold(np.random.default_rng([18, seed]), 150, 0)
        assert len(candidate_matches(a, b, AlignmentOptions())) > 40
        assert align_maps(a, b).reason == "too few inliers"


def test_maps_are_aligned_by_geometry_alone() -> None:
    """Where all landmarks look the same, any two of one height may be the same, and each is taken once."""
    rng = np.random.default_rng(12)
    a = landmark_map(rng, rng.uniform(0.0, [15.0, 10.0, 0.0], (16, 3)), np.ones((16, 1)))
    b = seen_from(a, TURNED, 2, rng)
    assert align_maps(a, b).reason == "too few candidates"
    options = AlignmentOptions(appearance=False)
    assert len(candidate_matches(a, b, options)) == 256
    found = align_maps(a, b, options=options)
    assert found.success, found.reason
    assert off(found.transform, TURNED) < 0.05
    assert len(found.inliers) == 14
    assert len(np.unique(found.inliers[:, 0])) == len(np.unique(found.inliers[:, 1])) == 14


def test_a_symmetric_place_is_ambiguous_by_geometry_alone() -> None:
    """A ring of equal landmarks fits itself turned by one place as well."""
    angles = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    ring = np.column_stack([5.0 * np.cos(angles), 5.0 * np.sin(angles), np.ones(12)])
    a = landmark_map(np.random.default_rng(13), ring, np.ones((12, 1)))
    found = align_maps(a, a.moved(TURNED), options=AlignmentOptions(appearance=False))
    assert found.reason == "ambiguous"
    assert found.ratio > 0.9


@pytest.mark.parametrize("method", ["gnc", "clique"])
def test_removed_methods_name_their_replacement(method: str) -> None:
    """Methods of version 0.3 that are gone are refused with what replaces them."""
    a = landmark_map(np.random.default_rng(0), np.eye(3))
    with pytest.raises(ValueError, match=r"method: expected one of .* ransac replaces it"):
        align_maps(a, a, method)


POOR_MAPS = {
    "empty": np.empty((0, 3)),
    "one": np.ones((1, 3)),
    "two": np.eye(3)[:2],
    "one place": np.ones((15, 3)),
    "collinear": np.column_stack([np.linspace(0.0, 9.0, 15), np.zeros((15, 2))]),
    "two places": np.repeat([[0.0, 0.0, 1.0], [7.0, 1.0, 1.0]], 8, axis=0),
    "far away": np.add(np.random.default_rng(0).uniform(0.0, 9.0, (15, 3)), [1e6, -1e6, 0.0]),
}


@pytest.mark.parametrize("name", POOR_MAPS)
@pytest.mark.parametrize("method", METHODS)
def test_poor_maps_are_refused_or_aligned_rightly(method: str, name: str) -> None:
    """For any method, descriptors and covariances, degenerate maps raise no error; accepted alignments are right."""
    rng = np.random.default_rng(21)
    points = POOR_MAPS[name]
    for looks in (None, np.ones((len(points), 3))):
        for variance in (4e-4, 0.0):
            a = landmark_map(rng, points, looks)
            a = replace(a, covariances=np.tile(variance * np.eye(3), (len(points), 1, 1)))
            for options in (AlignmentOptions(), AlignmentOptions(appearance=False, min_inliers=3, min_spread=0.0)):
                found = align_maps(a, a.moved(inverse(TURNED)), method, options=options)
                assert found.success == (found.reason == "")
                if found.success:
                    apart = transform_points(found.transform, transform_points(inverse(TURNED), points)) - points
                    assert np.abs(apart).max() < 1e-3
                else:
                    assert found.reason in REASONS
    if name in ("empty", "one", "two", "one place"):
        assert not found.success


def test_large_maps_without_appearance_are_refused() -> None:
    """Pairs of 20,000 landmarks that all look the same are too many to try, and are not tried."""
    n = 20_000
    rng = np.random.default_rng(14)
    huge = LandmarkMap(rng.uniform(0.0, 300.0, (n, 3)), np.tile(0.01 * np.eye(3), (n, 1, 1)), np.ones((n, 1)))
    options = AlignmentOptions(appearance=False)
    assert align_maps(huge, huge, options=options).reason == "too many candidates"
    with pytest.raises(ValueError, match="map_b: expected at most 10000 pairs of landmarks without appearance"):
        candidate_matches(huge, huge, options)


def test_proposals_are_raw_and_need_two_candidates() -> None:
    """What a method begins with is given even where an alignment is refused, but not from fewer than two matches."""
    rng = np.random.default_rng(15)
    a = landmark_map(rng, rng.uniform(0.0, [4.0, 3.0, 1.5], (3, 3)))
    b = a.moved(inverse(TURNED))
    for method in METHODS:
        assert propose_motion(a.subset([0]), b, method) is None
        if method != "ransac":
            assert off(propose_motion(a, b, method), TURNED) < 1e-6
    assert off(propose_motion(a, b, "ransac", options=AlignmentOptions(min_inliers=3)), TURNED) < 1e-6


SHARED, OTHERS = 24, 80
DOUBLE = np.array([9.0, -4.0, 1.2])  # where a constellation hangs a second time
A_FROM_B = np.array([3.0, -7.0, 2.0])
SIGMA = 0.03  # [m]


def mapped(rng: np.random.Generator, points: np.ndarray, descriptors: np.ndarray) -> LandmarkMap:
    """Return the map of a robot that has measured points with `SIGMA` and descriptors with a noise of 0.17."""
    seen = blurred(rng, descriptors)
    noise = SIGMA * rng.standard_normal(points.shape)
    return LandmarkMap(points + noise, np.tile(SIGMA**2 * np.eye(3), (len(points), 1, 1)), seen)


def maps_with_doubles(seed: int, doubles: int, scattered: bool = False) -> tuple[LandmarkMap, LandmarkMap]:
    """Return two maps with 24 landmarks in common, of which so many have a double in map a.

    Args:
        seed: Seed of all draws.
        doubles: Number of landmarks with a double; b has seen no double.
        scattered: Each double hangs anywhere, at its own height; if not, all of them by one motion.
    """
    rng = np.random.default_rng([seed, 5])
    size = [5.0, 4.0, 1.5]
    points, shapes = rng.uniform(0.0, size, (SHARED, 3)), unit(rng, SHARED)
    again = transform_points(DOUBLE, points[:doubles])
    if scattered:
        again[:, :2] = rng.uniform([6.0, -10.0], [16.0, 10.0], (doubles, 2))
    own_a, own_b = (rng.uniform([-10.0, -12.0, 0.0], [0.0, 12.0, 1.5], (OTHERS, 3)) for _ in range(2))
    map_a = mapped(
        rng, np.concatenate([points, again, own_a]), np.concatenate([shapes, shapes[:doubles], unit(rng, OTHERS)])
    )
    map_b = mapped(rng, np.concatenate([points, own_b]), np.concatenate([shapes, unit(rng, OTHERS)]))
    return map_a, map_b.moved(inverse(A_FROM_B))


@pytest.mark.parametrize("seed", range(5))
def test_a_shared_constellation_that_recurs_in_one_map_is_refused(seed: int) -> None:
    """Half of the shared landmarks hang a second time in one map, as a group: refused, from either side."""
    map_a, map_b = maps_with_doubles(seed, doubles=12)
    for pair in ((map_a, map_b), (map_b, map_a)):
        found = align_maps(*pair)
        assert (found.success, found.reason) == (False, "ambiguous")
        assert found.ratio < AlignmentOptions().max_ratio  # the rival in the other map alone would not have refused it


@pytest.mark.parametrize(("doubles", "scattered"), [(0, False), (4, False), (24, True)])
@pytest.mark.parametrize("seed", range(5))
def test_single_duplicates_do_not_refuse_an_alignment(seed: int, doubles: int, scattered: bool) -> None:
    """A sixth of the landmarks may recur as a group, and all of them each for itself: the motion is found."""
    found = align_maps(*maps_with_doubles(seed, doubles, scattered))
    assert found.success
    np.testing.assert_allclose(found.transform, A_FROM_B, atol=0.1)


def test_recurrence_does_not_depend_on_the_frame() -> None:
    """Moving the map changes nothing, and the double recurs as the original does."""
    options, rows = AlignmentOptions(), np.arange(12)
    map_a, _ = maps_with_doubles(7, doubles=12)
    for landmarks in (map_a, map_a.moved(np.array([5.0, 2.0, -2.5]))):
        assert has_perceptual_alias(landmarks, rows, SIGMA**2, options)
        assert has_perceptual_alias(landmarks, rows + SHARED, SIGMA**2, options)
        assert not has_perceptual_alias(landmarks, np.arange(12, SHARED), SIGMA**2, options)


def test_a_map_of_identical_descriptors_has_no_recurring_constellation() -> None:
    """Among a hundred landmarks of one look at random places no constellation is said to recur."""
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, [20.0, 20.0, 1.5], (100, 3))
    same = np.repeat(unit(rng, 1), 100, axis=0)
    landmarks = LandmarkMap(points, np.tile(SIGMA**2 * np.eye(3), (100, 1, 1)), same)
    for _ in range(5):
        assert not has_perceptual_alias(landmarks, rng.choice(100, 20, replace=False), SIGMA**2, AlignmentOptions())
