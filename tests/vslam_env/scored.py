"""What scores are asked with and how they are told apart."""

from types import SimpleNamespace

from slam_backend.errors import FloatArray
from slam_backend.standpoints import Standpoints
from vslam_env.reward import Standing


def standing_at(starts: FloatArray) -> Standpoints:
    """Return where robots with these starts (K, 3) stand: at the origin of their own frames, without doubt."""
    points = Standpoints.unwritten(len(starts))
    for array in points:
        array.fill(0.0)
    return points._replace(starts=starts)


def by_name(scores: FloatArray) -> SimpleNamespace:
    """Return scores (8, ...) by the names of `Standing`."""
    return SimpleNamespace(**dict(zip(Standing._fields, scores, strict=False)))
