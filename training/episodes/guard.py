"""`GuardedTeam`: the policies of an episode, with errors of one line and a record of the time of each decision."""

import signal
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from agents.goal_choice import DrivingPolicy
from agents.policy import Policy
from agents.team import TeamPolicy
from slam_backend.core.validation import FloatArray
from vslam_env.actions import checked_actions
from vslam_env.belief.team_belief import Belief

COMPILES = 3  # decisions at the beginning of an episode that may compile kernels
COMPILE_S = 60.0  # limit for each of these [s]


class PolicyError(ValueError):
    """Failure of a policy: it raised, returned no action of the space, or took too long. The message is one line."""


class _OutOfTimeError(BaseException):
    """Raised within a policy that takes too long; not an Exception, which the policy might catch."""


class GuardedTeam:
    """Team policy that runs another one and turns its failures into errors of one line.

    Args:
        team: Team policy, or the policy of each agent.
        name: Name of the policy in messages.
        action_type: Action type of the environment.
        limit: Longest time of a decision of a robot, or of a team policy for all of them [s]; None: no limit.

    Attributes:
        seconds: Processor time of each decision so far [s].
    """

    def __init__(
        self, team: TeamPolicy | Mapping[str, Policy], name: str, action_type: str, limit: float | None = None
    ) -> None:
        self._team, self._name, self._action_type, self._limit = team, name, action_type, limit
        self.seconds: list[float] = []
        self._decisions = 0

    def reset(self) -> None:
        """Reset the policies."""
        self._decisions = 0
        for policy in self._team.values() if isinstance(self._team, Mapping) else [self._team]:
            with self._guarded("reset()", None):
                policy.reset()

    def act_all(
        self,
        observations: Mapping[str, Any],
        beliefs: Mapping[str, Belief],
        rngs: Mapping[str, np.random.Generator],
        team_rng: np.random.Generator,
    ) -> dict[str, Any]:
        """Return a valid action for each agent.

        Raises:
            PolicyError: If the policy fails.
        """
        self._decisions += 1
        if isinstance(self._team, Mapping):
            actions = {}
            for agent, belief in beliefs.items():
                with self._guarded("act()", self._limit):
                    actions[agent] = self._team[agent].act(observations[agent], belief, rngs[agent])
        else:
            with self._guarded("act()", self._limit):
                actions = self._team.act(observations, beliefs, team_rng)
        try:
            checked_actions(actions, list(beliefs), self._action_type)
        except ValueError as error:
            raise PolicyError(f"policy {self._name!r}: {error}") from error
        return actions

    def goals(self) -> dict[str, FloatArray | None]:
        """Return the place (2,) [m] to which each robot drives, start frame, of policies that plan paths themselves."""
        policies = self._team if isinstance(self._team, Mapping) else {}
        return {agent: policy.goal for agent, policy in policies.items() if isinstance(policy, DrivingPolicy)}

    @contextmanager
    def _guarded(self, method: str, limit: float | None) -> Iterator[None]:
        """Turn exceptions and overlong decisions within the block into errors of one line."""
        allowed = max(limit, COMPILE_S) if limit is not None and self._decisions <= COMPILES else limit
        begin, used = time.monotonic(), time.thread_time()
        try:
            with _time_limit(allowed):
                yield
        except _OutOfTimeError:
            taken = allowed
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            what = " ".join(f"{type(error).__name__}: {error}".split())
            raise PolicyError(
                f"policy {self._name!r}: expected {method} to return, got {what} "
                f"({Path(last.filename).name}, line {last.lineno}). Correct the policy."
            ) from error
        else:
            taken = time.monotonic() - begin
            self.seconds.append(time.thread_time() - used)
        if allowed is not None and taken is not None and taken >= allowed:
            raise PolicyError(
                f"policy {self._name!r}: expected decisions within {allowed:g} s, got one of at least {taken:.1f} s. "
                "Make it faster, or raise decision_limit."
            )


@contextmanager
def _time_limit(seconds: float | None) -> Iterator[None]:
    """Raise `_OutOfTimeError` in the block after a time; without effect outside the main thread, or without SIGALRM."""
    if seconds is None or threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise _OutOfTimeError

    former = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, former)
