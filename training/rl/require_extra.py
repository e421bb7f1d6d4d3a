"""What is told where the extra `train` is not installed."""

from importlib.util import find_spec

from slam_backend.core.validation import bad_argument

NEEDED = ("torch", "stable_baselines3", "sb3_contrib", "tensorboard")


def need_learner() -> None:
    """Refuse to go on without the packages that train.

    Raises:
        ValueError: If one is missing.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        cure = "Install them: pip install torch==2.13.0, which is small, then pip install '.[train]' in a checkout."
        raise bad_argument("train", "the packages of the extra 'train'", f"no {', '.join(missing)}", cure)
