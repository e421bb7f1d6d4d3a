"""Rules of batched teams: contacts, and what they refuse."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from builders.batched import jax, jnp

from vslam_env.config import EnvConfig
from vslam_env.presets import preset_config

episode = pytest.importorskip("vslam_env.batched.episode")
CONFIG = preset_config("standard").replace(world="fig5", num_robots=2, observation_keys=("pose", "scan"))
RULES = episode.Rules.of(CONFIG, 192)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("oracle_merge", True), ("comm_range", 5.0), ("action_type", "goal"), ("reward", {"time": 1.0}),
        ("sensor", "stereo"), ("observation_keys", ("pose", "global_grid")), ("stop_at_recall", 0.9),
    ],
)  # fmt: skip
def test_what_batched_teams_do_not_know_is_refused_by_name(name: str, value: Any) -> None:
    """Options beyond those that are simulated raise with their name."""
    with pytest.raises(ValueError, match=f"{name}: expected"):
        episode.Rules.of(EnvConfig(**{"observation_keys": "driver", name: value}), 100)


def test_contacts_fail_as_often_as_configured_and_robots_relay() -> None:
    """Of pairs alone the share in contact is 1 - loss; of three robots two links make all reach each other."""
    rules, lossy = RULES._replace(comm_loss=0.5), 0.5
    keys = jax.random.split(jax.random.key(0), 2000)
    meet = jax.jit(jax.vmap(partial(episode._in_contact, rules=rules), (None, 0)))
    pairs = np.asarray(meet(jnp.arange(2), keys))[:, 0, 1]
    assert abs(pairs.mean() - lossy) < 4.0 * np.sqrt(0.25 / len(keys))
    three = np.asarray(meet(jnp.arange(3), keys))
    assert abs(three[:, 0, 1].mean() - (lossy + lossy**3)) < 4.0 * np.sqrt(0.25 / len(keys))
    joined = np.asarray(meet(jnp.array([0, 1, 0]), keys))  # a group in contact through any of its robots
    assert abs(joined[:, 0, 1].mean() - (1.0 - lossy**2)) < 4.0 * np.sqrt(0.25 / len(keys))
