"""Study of the Gaussian belief: what it refuses."""

import pytest

from studies.gaussian import Config


def test_teams_are_refused() -> None:
    """The belief of the study merges no maps."""
    with pytest.raises(ValueError, match="robots: expected 1, got"):
        Config(robots=(3,))
