"""The paper's Figs. 3 and 4: two maps, what matches, the motion found; and what fusing does to the ellipses."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray, bad_argument, check_float, check_int
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.maps.alignment import Alignment, align_maps, candidate_matches
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.maps.fusion import fuse_maps, move_covariances
from slam_backend.maps.landmark_map import LandmarkMap
from training.bench.accuracy.runs import STEP
from training.experiments.config import PlainConfig
from training.experiments.tables import csv_text
from training.paper.map_pairs import Stage, map_alone, simulate_pair, true_motion

FIG3, FIG4 = "paper fig3", "paper fig4"
SHOWN = 3  # landmarks of Fig. 4


@dataclass(frozen=True, slots=True, kw_only=True)
class PairConfig(PlainConfig):
    """All that decides either figure.

    Attributes:
        length: That each of the two robots drives [m].
        landmarks: N of the office.
        particles: M of each robot's filter.
        seed: Of run and filters.
    """

    length: float = 30.0
    landmarks: int = 300
    particles: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        check_float("length", self.length, "Give metres.", at_least=STEP)
        check_int("landmarks", self.landmarks, 1, "An office without landmarks shows nothing.")
        check_int("particles", self.particles, 1, "Use at least one particle.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")


@dataclass(frozen=True, slots=True, eq=False)
class AlignedPair:
    """Two robots' own maps and the motion found between them.

    Attributes:
        stage: What they hold.
        candidates: (k, 2) rows (a, b) of landmarks that look alike.
        alignment: Successful.
        truth: (3,) True motion between the start frames [m, m, rad].
    """

    stage: Stage
    candidates: IntArray
    alignment: Alignment
    truth: FloatArray

    @property
    def maps(self) -> tuple[LandmarkMap, LandmarkMap]:
        """Both maps, own start frames."""
        return self.stage.maps

    def figures(self) -> dict[str, Any]:
        """Return how many landmarks match, how many of these truly, and how far the motion is off."""
        names_a, names_b = (own[rows] for own, rows in zip(self.stage.names, self.alignment.inliers.T, strict=True))
        error = self.alignment.transform - self.truth
        return {
            "landmarks": [len(own) for own in self.maps],
            "shared": self.stage.shared,
            "candidates": len(self.candidates),
            "inliers": len(self.alignment.inliers),
            "true_inliers": int(np.count_nonzero((names_a == names_b) & (names_a >= 0))),
            "transform": self.alignment.transform.tolist(),
            "sigmas": np.sqrt(np.diag(self.alignment.covariance)).tolist(),
            "translation_error_m": float(np.hypot(error[0], error[1])),
            "rotation_error_deg": abs(float(np.rad2deg(wrap_angle(error[2])))),
        }


def align_pair(config: PairConfig) -> AlignedPair:
    """Let two robots map alone for a while, and align their maps.

    Raises:
        ValueError: If these maps cannot be aligned.
    """
    run = simulate_pair(config.seed, config.length, config.landmarks)
    *_, stage = map_alone(run, config.particles, config.seed, config.length)
    found = align_maps(*stage.maps, rng=np.random.default_rng(config.seed))
    if not found.success:
        cure = "Let the robots drive farther, or take another seed."
        raise bad_argument("length", "maps that can be aligned", f"a refusal: {found.reason}", cure)
    return AlignedPair(stage, candidate_matches(*stage.maps, AlignmentOptions()), found, true_motion(run))


@dataclass(frozen=True, slots=True, eq=False)
class FusedLandmarks:
    """A few landmarks before and after fusion, frame of the first map.

    Attributes:
        names: (n,) true landmarks.
        means: (3, n, 3) float64 [m]. Of the first map, of the second one moved, and fused.
        covariances: (3, n, 3, 3) float64 [m^2]. Likewise; those moved hold the alignment's uncertainty, too.
    """

    names: IntArray
    means: FloatArray
    covariances: FloatArray


def fuse_pair(pair: AlignedPair, shown: int = SHOWN) -> FusedLandmarks:
    """Fuse both maps, and return the shared landmarks of which both together know least in the plane."""
    (map_a, map_b), found = pair.maps, pair.alignment
    rows_a, rows_b = found.inliers.T
    fused = fuse_maps(map_a, map_b, found)
    one, two = map_a.covariances[rows_a, :2, :2], map_b.covariances[rows_b, :2, :2]
    chosen = np.argsort(-np.linalg.det(one) * np.linalg.det(two), kind="stable")[:shown]
    a, b = rows_a[chosen], rows_b[chosen]
    return FusedLandmarks(
        names=pair.stage.names[0][a],
        means=np.array([map_a.means[a], transform_points(found.transform, map_b.means[b]), fused.means[a]]),
        covariances=np.array([
            map_a.covariances[a], move_covariances(found, map_b.means[b], map_b.covariances[b]), fused.covariances[a],
        ]),
    )  # fmt: skip


def matches_csv(pair: AlignedPair) -> str:
    """Return every inlier: where either map has it, and where the motion found puts that of the second."""
    headings = ["true_a", "true_b", "ax", "ay", "az", "bx", "by", "bz", "moved_x", "moved_y"]
    map_a, map_b = pair.maps
    rows = []
    for a, b in pair.alignment.inliers.tolist():
        moved = transform_points(pair.alignment.transform, map_b.means[b])
        names = int(pair.stage.names[0][a]), int(pair.stage.names[1][b])
        rows.append([*names, *(f"{v:.4f}" for v in (*map_a.means[a], *map_b.means[b], *moved[:2]))])
    return csv_text(headings, rows)


def ellipses_csv(fused: FusedLandmarks) -> str:
    """Return means and covariances before and after fusion."""
    headings = ["landmark", "which", "x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz"]
    upper = np.triu_indices(3)
    rows = []
    for i, name in enumerate(fused.names.tolist()):
        for kind, means, covariances in zip(("map 1", "map 2", "fused"), fused.means, fused.covariances, strict=True):
            rows.append([name, kind, *(f"{v:.3e}" for v in (*means[i], *covariances[i][upper]))])
    return csv_text(headings, rows)
