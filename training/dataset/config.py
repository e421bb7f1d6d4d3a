"""`RecordConfig`: configuration of a data set of episodes."""

from typing import TYPE_CHECKING, Literal

from training.episodes.config import RunConfig
from training.experiments.config import first_seed, option

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.dataset.recording import EpisodeTrial


class RecordConfig(RunConfig):
    """Configuration of a data set: that of a run, repeated with consecutive seeds."""

    episodes: int = option(100, "Number of episodes.", ge=1, hint="Record at least one episode.")
    observations: Literal["driver", "goal", "all"] | None = option(
        None, "Recorded keys of observations: driver, goal or all.", shown="goal with goal actions, else driver"
    )
    seed: int = first_seed()

    def trials(self) -> "list[EpisodeTrial]":
        """Return all episodes, in order."""
        from training.dataset.recording import EpisodeTrial

        return [EpisodeTrial(number, self.seed + number) for number in range(self.episodes)]

    def observation_keys(self) -> str | tuple[str, ...]:
        """Return the set of recorded keys.

        Raises:
            ValueError: If the policy reads others.
        """
        from slam_backend.core.validation import argument_error
        from vslam_env.belief.observation_keys import checked_keys, default_set

        chosen = self.observations or default_set(self.action_type)
        read = checked_keys(super().observation_keys(), self.action_type)
        if missing := [key for key in read if key not in checked_keys(chosen, self.action_type)]:
            expected = f"a set with all keys that the policy reads, such as {missing[0]!r}"
            raise argument_error("observations", expected, chosen, "Use --observations all.")
        return chosen
